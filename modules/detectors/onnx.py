"""Scenes by an image classifier in ONNX format, run by OpenCV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path, read_text
from sceneslam.types.observation import UNSURE, Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor

Classes = Sequence[int | str]


class Onnx:
    """Votes for the scene with the largest sum of class probabilities.

    `scenes` maps each scene to classes of the network: their numbers or, with a file of `labels`,
    patterns of their names (`kitchen`, `*room*`). It votes at `rate_hz` (null: on every image) and
    is UNSURE in between, and if no scene has the probability `probability_min`.
    """

    quantity = "probability of the scene"
    requires = (frozenset({Sensor.IMAGE}),)
    feature_settings = (
        "path",
        "size_wh",
        "colour_order",
        "mean",
        "standard_deviation",
        "output",
        "rate_hz",
    )

    def __init__(
        self,
        path: str,
        scenes: dict[str, list[int | str]],
        labels: str | None,
        size_wh: tuple[int, int],
        colour_order: Literal["RGB", "BGR"],
        mean: tuple[float, float, float],
        standard_deviation: tuple[float, float, float],
        output: Literal["logits", "probabilities"],
        rate_hz: float | None,
        probability_min: float,
    ) -> None:
        if rate_hz is not None and not 0 < rate_hz < np.inf:
            raise ConfigError("rate_hz", rate_hz, "a number above 0, or null for every image")
        if not 0 <= probability_min <= 1:
            raise ConfigError("probability_min", probability_min, "0 to 1")
        if min(size_wh) < 1:
            raise ConfigError("size_wh", list(size_wh), "[width, height] [px], each above 0")
        if not min(standard_deviation) > 0:
            raise ConfigError("standard_deviation", list(standard_deviation), "numbers above 0")
        self._network = _read_network(path)
        self._size_wh = (int(size_wh[0]), int(size_wh[1]))
        self._is_rgb = colour_order == "RGB"
        self._mean = np.array(mean, np.float32)
        self._standard_deviation = np.array(standard_deviation, np.float32)
        self._output = output
        self._period_ns = 0 if rate_hz is None else round(1e9 / rate_hz)
        self._probability_min = probability_min
        names = [] if labels is None else _read_labels(given_path(labels))
        self._count = self._classify(np.zeros((8, 8, 3), np.uint8)).size
        if names and len(names) != self._count:
            raise ConfigError("labels", labels, f"a file of {self._count} lines, one per class")
        self._members = _members(scenes, names, self._count)
        self.scenes = tuple(scenes)
        self._asked_ns: int | None = None

    def activate(self, rig: Rig) -> None:
        """Start; the next image gets a vote."""
        self._asked_ns = None

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the most probable scene."""
        return self.decide(observation.stamp_ns, self.get_features(observation))

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return the classes' probabilities (C,), None if no vote is due."""
        if observation.image_bgr is None:
            return None
        since_ns = self._period_ns
        if self._asked_ns is not None:
            since_ns = observation.stamp_ns - self._asked_ns
        if 0 < since_ns < self._period_ns:
            return None
        self._asked_ns = observation.stamp_ns
        return self._classify(observation.image_bgr)

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the most probable scene for class probabilities (C,), as likelihoods of scenes."""
        if features is None:
            return SceneVote(stamp_ns=stamp_ns, scene=UNSURE)
        shares = self._members @ features
        best = int(np.argmax(shares))
        probability = float(shares[best])
        if probability < self._probability_min or not probability > 0:
            return SceneVote(stamp_ns=stamp_ns, scene=UNSURE, value=probability)
        return SceneVote(
            stamp_ns=stamp_ns,
            scene=self.scenes[best],
            value=probability,
            likelihoods=dict(zip(self.scenes, shares.tolist(), strict=True)),
        )

    def shutdown(self) -> None:
        """Do nothing."""

    def _classify(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Return the classes' probabilities (C,) for an image."""
        small = cv2.resize(image_bgr, self._size_wh, interpolation=cv2.INTER_AREA)
        pixels = np.asarray(small[..., ::-1] if self._is_rgb else small, np.float32)
        pixels = (pixels - self._mean) / self._standard_deviation
        try:
            self._network.setInput(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]))
            scores = np.asarray(self._network.forward(), np.float64).ravel()
        except cv2.error as error:
            size = list(self._size_wh)
            raise ConfigError("size_wh", size, "[width, height] that the network takes") from error
        if self._output == "logits":
            scores = np.exp(scores - scores.max())
            scores /= scores.sum()
        return scores


def _read_network(path: str) -> cv2.dnn.Net:
    """Return the network; raises InputError if OpenCV cannot read it."""
    file = given_path(path)
    if not file.is_file():
        raise InputError(f"network not found, expected an ONNX file: {path}")
    try:
        return cv2.dnn.readNetFromONNX(str(file))
    except cv2.error as error:
        raise InputError(f"network: OpenCV cannot read it as ONNX: {path}") from error


def _read_labels(path: Path) -> Sequence[str]:
    """Return the classes' names, one per line, in the network's order."""
    if not path.is_file():
        raise InputError(f"labels not found, expected a file with one class per line: {path}")
    return [line.strip() for line in read_text(path).splitlines() if line.strip()]


def _members(
    scenes: Mapping[str, Classes], names: Sequence[str], count: int
) -> NDArray[np.float64]:
    """Return (S, C), 1 if a class belongs to a scene; raises ConfigError for `scenes`."""
    members = np.zeros((len(scenes), count))
    for row, (scene, classes) in enumerate(scenes.items()):
        if scene in ("", UNSURE) or not classes:
            raise ConfigError(f"scenes.{scene}", list(classes), f"not {UNSURE}; one class or more")
        for one in classes:
            found = _places(one, names, count)
            if not found:
                allowed = f"numbers from 0 to {count - 1}" + (
                    ", or patterns of labels" if names else "; or give a file of labels"
                )
                raise ConfigError(f"scenes.{scene}", one, allowed)
            members[row, found] = 1.0
    if len(scenes) < 2 or (members.sum(axis=0) > 1).any():
        raise ConfigError("scenes", dict(scenes), "two scenes or more, no class in two of them")
    return members


def _places(one: int | str, names: Sequence[str], count: int) -> list[int]:
    if isinstance(one, str):
        return [place for place, name in enumerate(names) if fnmatch(name, one)]
    return [one] if 0 <= one < count else []
