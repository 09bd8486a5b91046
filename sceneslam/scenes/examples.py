"""Recordings of known scenes, and their detector features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.config.build import make_source
from sceneslam.config.component import ComponentBuilder
from sceneslam.types.errors import InputError
from sceneslam.types.input_files import given_path
from sceneslam.types.observation import Observation

_THUMBNAIL_PX = 160  # wide


class FeatureSource(Protocol):
    """Computes features of an observation."""

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return the features (F,), None if a required sensor is missing."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A part of a recording, [from, to) in seconds after the first observation."""

    start_s: float
    end_s: float
    weight_per_s: float = 1.0


_WHOLE = Stretch(start_s=0.0, end_s=np.inf)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Example:
    """The parts of a recording that show one scene."""

    scene: str
    group: str  # examples of one group are held out together in cross-validation
    name: str
    parts: Sequence[Stretch]
    config: Mapping[str, Any]  # of the source and its effects
    is_weighted: bool = False  # by its parts; else all examples of a scene have the same weight

    def weight(self, time_s: float) -> float | None:
        """Return the weight of a time after the first observation, None outside the parts."""
        inside = (part for part in self.parts if part.start_s <= time_s < part.end_s)
        found = next(inside, None)
        return None if found is None else found.weight_per_s


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredExample:
    """The features of an example."""

    example: Example
    features: NDArray[np.float64]  # (N, F)
    weights: NDArray[np.float64]  # (N,)
    thumbnails: Sequence[NDArray[np.uint8] | None]  # (N,), None for an observation without an image


def group_of(path: str) -> str:
    """Return the group of a recording, the same for all its paths."""
    return str(given_path(path).resolve())


def look(
    examples: Sequence[Example], features: FeatureSource, images: int
) -> list[MeasuredExample]:
    """Return the features of every n-th observation of each example.

    n is such that an example has at least `images`, if its parts are long enough, and less than
    twice as many. Consecutive examples of one recording are read together. Raises ConfigError or
    InputError if a recording cannot be read, or an example has no observation.
    """
    seen: list[MeasuredExample] = []
    for _, found in groupby(examples, key=lambda example: id(example.config)):
        seen += _look(list(found), features, images)
    return seen


@dataclass(slots=True)
class _Collected:
    """The data of an example while its recording is read."""

    example: Example
    step: int = 1
    count: int = 0
    rows: list[NDArray[np.float64]] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)
    thumbnails: list[NDArray[np.uint8] | None] = field(default_factory=list)

    def take(self, observation: Observation, weight: float, features: FeatureSource) -> None:
        row = features.get_features(observation)
        if row is None or np.isnan(row).any():
            return
        self.rows.append(row)
        self.weights.append(weight)
        image_bgr = observation.image_bgr
        self.thumbnails.append(None if image_bgr is None else _thumbnail(image_bgr))

    def thin_out(self) -> None:
        """Keep every second observation, of later ones, too."""
        self.step *= 2
        for kept in (self.rows, self.weights, self.thumbnails):
            del kept[1::2]

    def seen(self) -> MeasuredExample:
        if not self.rows:
            scene, name = self.example.scene, self.example.name
            raise InputError(f"example: no observation of {scene} has all features: {name}")
        return MeasuredExample(
            example=self.example,
            features=np.array(self.rows),
            weights=self._scaled(),
            thumbnails=self.thumbnails,
        )

    def _scaled(self) -> NDArray[np.float64]:
        """Return the weights (N,); those of a weighted example add up to that of its parts."""
        weights, parts = np.array(self.weights), self.example.parts
        if not self.example.is_weighted or not weights.any():
            return weights
        total = sum(part.weight_per_s * (part.end_s - part.start_s) for part in parts)
        return np.asarray(weights * (total / weights.sum()))


def _look(
    examples: Sequence[Example], features: FeatureSource, images: int
) -> list[MeasuredExample]:
    """Return the features of examples of one recording."""
    source = make_source(examples[0].config, ComponentBuilder(examples[0].config))
    end_s = max(part.end_s for example in examples for part in example.parts)
    whole_step = max(1, (source.length or images) // images)
    collected = [
        _Collected(example, step=whole_step if _WHOLE in example.parts else 1)
        for example in examples
    ]
    first_ns: int | None = None
    for observation in source:
        first_ns = observation.stamp_ns if first_ns is None else first_ns
        time_s = (observation.stamp_ns - first_ns) * 1e-9
        if time_s >= end_s:
            break
        for one in collected:
            weight = one.example.weight(time_s)
            if weight is not None:
                if one.count % one.step == 0:
                    one.take(observation, weight, features)
                    if len(one.rows) == 2 * images:
                        one.thin_out()
                one.count += 1
    return [one.seen() for one in collected]


def _thumbnail(image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image_bgr.shape[:2]
    size = (_THUMBNAIL_PX, max(1, round(height * _THUMBNAIL_PX / width)))
    return np.asarray(cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), np.uint8)
