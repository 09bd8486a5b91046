"""Recordings of known scenes, and what a detector measures of them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from hydra import compose, initialize_config_module
from hydra.errors import HydraException
from numpy.typing import NDArray
from omegaconf.errors import OmegaConfBaseException

from sceneslam.config.build import make_source
from sceneslam.config.check import check_keys
from sceneslam.config.component import Builder
from sceneslam.config.resolve import resolved
from sceneslam.interfaces import Source
from sceneslam.types.errors import InputError
from sceneslam.types.observation import UNSURE, Observation

_WORD = re.compile(r"(?P<scene>[^=:]+)(:(?P<group>[^=]+))?=(?P<rest>.+)")
_SPAN = re.compile(r"(?P<path>.+)@(?P<start>[0-9.]+):(?P<end>[0-9.]+)")
_USAGE = "SCENE=PATH, SCENE:GROUP=PATH or 'SCENE=PATH@FROM:TO effects=...', seconds"
_THUMBNAIL_PX = 160  # wide


class FeatureSource(Protocol):
    """Measures numbers of an observation."""

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return (F,), None where a sensor that it needs was silent."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """A recording, or a part of it, that shows one scene."""

    scene: str
    group: str  # what was recorded together: one path, unless it was given
    path: str
    start_s: float
    end_s: float
    overrides: tuple[str, ...]  # of the configuration: a source, effects

    @classmethod
    def of(cls, word: str) -> Example:
        """Return what a word of the command line says; raises InputError."""
        found = _WORD.fullmatch(word)
        if not found or found["scene"] == UNSURE:
            raise InputError(f"example: got {word!r}, allowed: {_USAGE}")
        path, *overrides = shlex.split(found["rest"])
        span = _SPAN.fullmatch(path)
        try:
            start_s, end_s = (float(span[k]) for k in ("start", "end")) if span else (0.0, np.inf)
        except ValueError:
            raise InputError(f"example: got {word!r}, allowed: {_USAGE}") from None
        path = span["path"] if span else path
        return cls(
            scene=found["scene"],
            group=found["group"] or path.rstrip("/"),
            path=path,
            start_s=start_s,
            end_s=end_s,
            overrides=tuple(overrides),
        )

    @property
    def name(self) -> str:
        """Return the path, with what was made of it."""
        span = "" if np.isinf(self.end_s) else f"@{self.start_s:g}:{self.end_s:g}"
        return " ".join([f"{self.path}{span}", *self.overrides])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What was measured of an example."""

    example: Example
    features: NDArray[np.float64]  # (N, F)
    thumbnails: Sequence[NDArray[np.uint8]]  # N, empty where the source has no images


def look(example: Example, features: FeatureSource, images: int) -> Seen:
    """Return the features of up to so many observations, evenly over the example.

    Raises ConfigError or InputError where the recording cannot be read or holds none.
    """
    source = _source(example)
    step = max(1, (source.length or images) // images)
    rows, thumbnails = [], []
    for observation in islice(_within(source, example), 0, None, step):
        row = features.get_features(observation)
        if row is None or np.isnan(row).any():
            continue
        rows.append(row)
        if observation.image_bgr is not None:
            thumbnails.append(_thumbnail(observation.image_bgr))
    if not rows:
        raise InputError(
            f"example: no observation of {example.scene} has all features: {example.name}"
        )
    return Seen(example=example, features=np.array(rows), thumbnails=thumbnails)


def _within(source: Source, example: Example) -> Iterator[Observation]:
    first_ns: int | None = None
    for observation in source:
        first_ns = observation.stamp_ns if first_ns is None else first_ns
        time_s = (observation.stamp_ns - first_ns) * 1e-9
        if time_s >= example.end_s:
            return
        if time_s >= example.start_s:
            yield observation


def _source(example: Example) -> Source:
    overrides = [f"source={_kind(Path(example.path))}", f"source.path={_quoted(example.path)}"]
    if any(word.startswith("source=") for word in example.overrides):
        overrides = overrides[1:]
    try:
        with initialize_config_module("sceneslam.conf", version_base="1.3"):
            config: Mapping[str, Any] = resolved(
                compose("config", overrides=[*overrides, *example.overrides])
            )
    except (HydraException, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"example: {reason}: {example.name}") from error
    check_keys(config)
    return make_source(config, Builder(config))


def _kind(path: Path) -> str:
    """Return the source that reads a path."""
    if (path / "rgb.txt").is_file():
        return "tum_rgbd"
    is_bag = (path / "metadata.yaml").is_file() or path.suffix in (".bag", ".mcap")
    return "rosbag" if is_bag else "video"


def _quoted(path: str) -> str:
    return "'" + path.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _thumbnail(image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image_bgr.shape[:2]
    size = (_THUMBNAIL_PX, max(1, round(height * _THUMBNAIL_PX / width)))
    return np.asarray(cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), np.uint8)
