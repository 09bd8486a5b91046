"""Train a detector on recordings of known scenes, and test it on others.

`train MODEL Bright=FOLDER Dark=FOLDER ...` fits a model, `test MODEL ...` scores it. `label LABELS
RUNS` writes time spans with the best module of each, as examples for training.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from sceneslam.config.component import ComponentBuilder
from sceneslam.scenes.examples import FeatureSource, MeasuredExample, look
from sceneslam.scenes.label import Table, label
from sceneslam.scenes.model import Model
from sceneslam.scenes.runs import read_runs
from sceneslam.scenes.score import table, write_sheet
from sceneslam.scenes.train import Judged, Trained, judge, train
from sceneslam.scenes.words import read_words
from sceneslam.streams import secure_streams
from sceneslam.types.errors import InputError, SceneSlamError, text_of

# The upper half of grey values depends on the light, the lower half on shadows.
_FEATURES = "q50,q75,q90,q98"
_FEATURES_TARGET = "sceneslam.modules.detectors.image_features.ImageFeatures"
_CHANGE_M = 0.02  # error of wheel odometry over the half metre between two modules' poses
_COMMAND = ("python", "-m", "sceneslam.scenes")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (2: invalid input)."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(words)
    try:
        if options.command == "train":
            _train(options, words)
        elif options.command == "test":
            _test(options)
        else:
            _label(options, words)
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {text_of(error)}", file=sys.stderr)
        return 2
    return 0


def _train(options: argparse.Namespace, words: Sequence[str]) -> None:
    _check_writable(options.model, "model", "a YAML file")
    names = options.features.split(",")
    seen = _look(options, names)
    trained = train(seen, names)
    for line in _told(trained.held_out, "not calibrated: no recording could be held out"):
        print(line)
    results = _results(trained)
    if trained.never_held_out:
        print(results[-1])
    trained.model.write(options.model, [f"Made by: {shlex.join([*_COMMAND, *words])}", *results])
    print(f"model    {options.model} (detector=learned detector.path={options.model})")


def _results(trained: Trained) -> list[str]:
    """Return lines on the results on held-out recordings, the last one on the scenes without."""
    held_out, never = [one.is_right for one in trained.held_out], trained.never_held_out
    share = "unknown" if never else f"{100 * np.concatenate(held_out).mean():.1f} %"
    lines = [f"Right on recordings that it was not trained on: {share}."]
    if held_out:
        divided = f"Its scores were divided by {trained.temperature:.3g}"
        lines.append(f"{divided}, so that its probabilities are right there.")
    if never:
        lines.append(f"never held out: {', '.join(never)}")
    return lines


def _check_writable(path: Path, name: str, kind: str) -> None:
    """Raise InputError or OSError for a file that cannot be written, before hours are spent on it.

    What is missing of its folder is made.
    """
    if path.is_dir():
        raise InputError(f"{name}: got {path}, a folder, allowed: {kind}")
    path.parent.mkdir(parents=True, exist_ok=True)
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise InputError(f"{name}: got {path}, allowed: a file that can be written")


def _test(options: argparse.Namespace) -> None:
    if not cv2.haveImageWriter(str(options.sheet)):
        raise InputError(f"--sheet: got {options.sheet}, allowed: an image, such as wrong.png")
    _check_writable(options.sheet, "--sheet", "an image")
    model = Model.read(options.model)
    seen = _look(options, model.features)
    for one in seen:
        if one.example.scene not in model.scenes:
            known = ", ".join(model.scenes)
            raise InputError(f"example: got {one.example.scene!r}, the model knows: {known}")
    judged = [judge(model, one) for one in seen]
    for line in _told(judged, ""):
        print(line)
    wrong = write_sheet(judged, options.sheet)
    print(f"wrong    {wrong} images" + (f": {options.sheet}" if wrong else ""))


def _look(options: argparse.Namespace, names: Sequence[str]) -> list[MeasuredExample]:
    if options.images < 1:
        raise InputError(f"--images: got {options.images}, allowed: 1 or more")
    examples = read_words(options.examples)
    node = {"_target_": _FEATURES_TARGET, "names": list(names)}
    features = ComponentBuilder({"features": node}).make("features", FeatureSource)
    return look(examples, features, options.images)


def _label(options: argparse.Namespace, words: Sequence[str]) -> None:
    if not options.change_m >= 0:
        raise InputError(f"--change-m: got {options.change_m}, allowed: 0 or more [m]")
    labels = label(read_runs(options.runs), options.change_m)
    labels.write(options.labels, shlex.join([*_COMMAND, *words]))
    for one in labels.recordings:
        stays = [next(found) for _, found in groupby(one.spans, key=lambda span: span.scene)]
        print(f"{one.name}: {', '.join(f'{s.scene} from {s.start_s:g} s' for s in stays)}")
    print(f"table    {_table(labels.table)}")
    print(f"labels   {options.labels} (train MODEL.yaml {options.labels})")


def _table(table: Table) -> str:
    """Return the scene table as an override of the configuration."""
    rows = ",".join(f"{scene}:[{','.join(modules)}]" for scene, modules in table.items())
    return f'"+scenes={{{rows}}}"'


def _told(judged: Sequence[Judged], otherwise: str) -> list[str]:
    return list(table(judged)) or [otherwise]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.scenes", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, help_ in (("train", "fit a model"), ("test", "measure how well a model works")):
        command = commands.add_parser(name, help=help_)
        command.add_argument("model", type=Path, help="YAML file of the model")
        command.add_argument(
            "examples",
            nargs="+",
            help="SCENE=PATH of a film, folder or bag; SCENE:GROUP=PATH holds out together what "
            "was recorded together; 'SCENE=PATH@FROM:TO effects=lights_out' takes seconds and "
            "keys; or a file that `label` wrote",
        )
        command.add_argument(
            "--images", type=int, default=200, help="of each example, or up to twice as many (200)"
        )
    commands.choices["train"].add_argument(
        "--features", default=_FEATURES, help=f"by commas ({_FEATURES})"
    )
    commands.choices["test"].add_argument(
        "--sheet", type=Path, default=Path("wrong.png"), help="the wrong images (wrong.png)"
    )
    command = commands.add_parser("label", help="find the best module for each time span")
    command.add_argument("labels", type=Path, help="YAML file of the labels")
    command.add_argument(
        "runs",
        type=Path,
        nargs="+",
        help="folders of runs, each of one module alone; of every recording one per module",
    )
    command.add_argument(
        "--change-m",
        type=float,
        default=_CHANGE_M,
        help=f"error of a change of module ({_CHANGE_M})",
    )
    return parser


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
