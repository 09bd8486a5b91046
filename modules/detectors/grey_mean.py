"""The paper's scene detector: the mean of grey against a threshold (Sec. III-B)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor


class GreyMean:
    """Votes for the first scene if the mean of S = .299 R + .587 G + .114 B exceeds the threshold.

    Else it votes for the second; the paper's are Bright and Dark. With hysteresis there are two
    thresholds: the vote changes only if the mean is beyond the threshold by `hysteresis`, so that
    noise near the threshold does not change it.
    """

    quantity = "mean of grey"
    requires = (frozenset({Sensor.IMAGE}),)
    feature_settings: tuple[str, ...] = ()

    def __init__(self, threshold: float, hysteresis: float, scenes: Sequence[str]) -> None:
        if not 0 <= threshold <= 255:
            raise ConfigError("threshold", threshold, "a grey value from 0 to 255")
        limit = min(threshold, 255 - threshold)  # larger values would make a change impossible
        if not 0 <= hysteresis <= limit:
            raise ConfigError("hysteresis", hysteresis, f"grey values from 0 to {limit:g}")
        if len(scenes) != 2 or scenes[0] == scenes[1] or UNSURE in scenes:
            allowed = f"two names, of above and below the threshold, other than {UNSURE}"
            raise ConfigError("scenes", list(scenes), allowed)
        self._threshold, self._hysteresis = threshold, hysteresis
        self._voted: str | None = None
        self.scenes = (scenes[0], scenes[1])

    def activate(self, rig: Rig) -> None:
        """Reset the last vote."""
        self._voted = None

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the scene with the mean of grey, UNSURE without an image."""
        return self.decide(observation.stamp_ns, self.get_features(observation))

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return (1,): the mean of grey."""
        if observation.image_bgr is None:
            return None
        return np.array([grey_mean(observation.image_bgr)])

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the vote for features (1,) by threshold and hysteresis."""
        if features is None:
            return SceneVote(stamp_ns=stamp_ns, scene=UNSURE)
        mean = float(features[0])
        towards = {None: 0.0, self.scenes[0]: -1.0, self.scenes[1]: 1.0}[self._voted]
        scene = self.scenes[0 if mean > self._threshold + towards * self._hysteresis else 1]
        self._voted = scene
        return SceneVote(stamp_ns=stamp_ns, scene=scene, value=mean)

    def shutdown(self) -> None:
        """Do nothing."""


def grey_mean(image_bgr: NDArray[np.uint8]) -> float:
    """Return the mean of S over an (H, W, 3) BGR image, in [0, 255].

    The mean is linear, so it is computed from the sums of the channels, without rounding per pixel:
    one pass over the image instead of a conversion and a second pass.
    """
    blue, green, red, _ = cv2.sumElems(image_bgr)
    pixels = image_bgr.shape[0] * image_bgr.shape[1]
    return float((0.299 * red + 0.587 * green + 0.114 * blue) / pixels)
