"""Train a detector on recordings of known scenes, and test it on others.

`python -m sceneslam.scenes train OUT.yaml Bright=FOLDER Dark=FOLDER ...`
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneslam.config.component import Builder
from sceneslam.scenes.examples import Example, FeatureSource, Seen, look
from sceneslam.scenes.model import Model
from sceneslam.scenes.score import table, write_sheet
from sceneslam.scenes.train import Judged, judge, train
from sceneslam.types.errors import InputError, SceneSlamError

# The upper half of grey follows the light; the lower one, the shadows, whatever lies in them.
_FEATURES = "q50,q75,q90,q98"
_FEATURES_TARGET = "sceneslam.modules.detectors.image_features.Features"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code (2 for input that cannot be used)."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    options = _parser().parse_args(words)
    try:
        _train(options, words) if options.command == "train" else _test(options)
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _train(options: argparse.Namespace, words: Sequence[str]) -> None:
    names = options.features.split(",")
    seen = _look(options, names)
    trained = train(seen, names)
    for line in _told(trained.held_out, "not calibrated: no recording could be held out"):
        print(line)
    held_out = [one.is_right for one in trained.held_out]
    share = f"{100 * np.concatenate(held_out).mean():.1f} %" if held_out else "unknown"
    comment = [
        f"Made by: {shlex.join(['python', '-m', 'sceneslam.scenes', *words])}",
        f"Right on recordings that it was not trained on: {share}. Its scores were divided by",
        f"{trained.temperature:.3g}, so that its probabilities are right there.",
    ]
    trained.model.write(options.model, comment)
    print(f"model    {options.model} (detector=learned detector.path={options.model})")


def _test(options: argparse.Namespace) -> None:
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


def _look(options: argparse.Namespace, names: Sequence[str]) -> list[Seen]:
    examples = [Example.of(word) for word in options.examples]
    node = {"_target_": _FEATURES_TARGET, "names": list(names)}
    features = Builder({"features": node}).make("features", FeatureSource)
    return [look(example, features, options.images) for example in examples]


def _told(judged: Sequence[Judged], otherwise: str) -> list[str]:
    return list(table(judged)) or [otherwise]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.scenes", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, help_ in (("train", "fit a model"), ("test", "how well does a model do?")):
        command = commands.add_parser(name, help=help_)
        command.add_argument("model", type=Path, help="YAML file of the model")
        command.add_argument(
            "examples",
            nargs="+",
            help="SCENE=PATH of a film, folder or bag; SCENE:GROUP=PATH holds out together what "
            "was recorded together; 'SCENE=PATH@FROM:TO effects=lights_out' takes seconds and keys",
        )
        command.add_argument("--images", type=int, default=200, help="of each example (200)")
    commands.choices["train"].add_argument(
        "--features", default=_FEATURES, help=f"by commas ({_FEATURES})"
    )
    commands.choices["test"].add_argument(
        "--sheet", type=Path, default=Path("wrong.png"), help="the wrong images (wrong.png)"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
