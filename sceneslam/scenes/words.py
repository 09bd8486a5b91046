"""Parsing of examples on the command line: SCENE=PATH, or a file of labels."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from sceneslam.config.check import check_keys
from sceneslam.config.resolve import resolved
from sceneslam.scenes.examples import Example, Stretch, group_of
from sceneslam.scenes.label import BestModuleSpan, Labels
from sceneslam.types.errors import InputError
from sceneslam.types.observation import UNSURE

_WORD = re.compile(r"(?P<scene>[^=:]+)(:(?P<group>[^=]+))?=(?P<rest>.+)")
_SPAN = re.compile(r"(?P<path>.+)@(?P<start>[0-9.]+):(?P<end>[0-9.]+)")
_USAGE = (
    "SCENE=PATH, SCENE:GROUP=PATH or 'SCENE=PATH@FROM:TO effects=...', seconds; "
    "or a file of labels, *.yaml"
)


def read_words(words: Sequence[str]) -> list[Example]:
    """Return the examples of all words; raises InputError."""
    return [example for word in words for example in _read(word)]


def _read(word: str) -> Iterator[Example]:
    if "=" not in word and word.endswith((".yaml", ".yml")):
        yield from _labelled(Labels.read(Path(word)))
    else:
        yield read_word(word)


def _labelled(labels: Labels) -> Iterator[Example]:
    """Yield an example per recording and scene."""
    for one in labels.recordings:
        for scene in dict.fromkeys(span.scene for span in one.spans):
            yield Example(
                scene=scene,
                group=one.group,
                name=one.name,
                parts=[_stretch(span) for span in one.spans if span.scene == scene],
                config=one.config,
                is_weighted=True,
            )


def _stretch(span: BestModuleSpan) -> Stretch:
    weight_per_s = span.gain_m / (span.end_s - span.start_s)
    return Stretch(start_s=span.start_s, end_s=span.end_s, weight_per_s=weight_per_s)


def read_word(word: str) -> Example:
    """Return the example of a word SCENE=PATH; raises InputError."""
    found = _WORD.fullmatch(word)
    if not found or found["scene"] == UNSURE:
        raise InputError(f"example: got {word!r}, allowed: {_USAGE}")
    try:
        given, *overrides = shlex.split(found["rest"])
        span = _SPAN.fullmatch(given)
        start_s, end_s = (float(span[k]) for k in ("start", "end")) if span else (0.0, np.inf)
    except ValueError:  # an open quotation, an empty path, or a time such as 1.2.3
        raise InputError(f"example: got {word!r}, allowed: {_USAGE}") from None
    path = span["path"] if span else given
    name = " ".join([given, *overrides])
    return Example(
        scene=found["scene"],
        group=found["group"] or group_of(path),
        name=name,
        parts=[Stretch(start_s=start_s, end_s=end_s)],
        config=_config(path, overrides, name),
    )


def _config(path: str, overrides: Sequence[str], name: str) -> Mapping[str, Any]:
    source = [f"source={_kind(Path(path))}"]
    if any(word.startswith("source=") for word in overrides):
        source = []
    words = [*source, f"source.path={_quoted(path)}", *overrides]
    try:
        with initialize_config_module("sceneslam.conf", version_base="1.3"):
            config: Mapping[str, Any] = resolved(compose("config", overrides=words))
    except (HydraException, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"example: {reason}: {name}") from error
    check_keys(config)
    return config


def _kind(path: Path) -> str:
    """Return the name of the source that reads a path."""
    if (path / "rgb.txt").is_file():
        return "tum_rgbd"
    is_bag = (path / "metadata.yaml").is_file() or path.suffix in (".bag", ".mcap")
    return "rosbag" if is_bag else "video"


def _quoted(path: str) -> str:
    return "'" + path.replace("\\", "\\\\").replace("'", "\\'") + "'"
