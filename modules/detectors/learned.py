"""A detector with a trained model: `python -m sceneslam.scenes train`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path
from sceneslam.types.observation import UNSURE, Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.scene_model import read_scene_model

from .image_features import ImageFeatures

_SHIPPED = Path(__file__).with_name("bright_dark.yaml")


class Learned:
    """Votes for the most probable scene by softmax regression of a few features.

    `path` is a model, a small YAML file; null: the built-in one for Bright and Dark.
    """

    quantity = "probability of the scene"
    feature_settings = ("path",)

    def __init__(self, path: str | None) -> None:
        file = _SHIPPED if path is None else given_path(path)
        model = read_scene_model(file)
        self.scenes = model.scenes
        try:
            self._features = ImageFeatures(model.features)
        except ConfigError as error:
            got = f"got {error.value}, allowed: {error.allowed}"
            raise InputError(f"model: its features: {got}: {file}") from error
        # As one matrix and one offset.
        self._weights = model.weights / model.scale
        self._offset = model.bias - self._weights @ model.mean
        self._prior = model.prior

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sensors of the model's features."""
        return self._features.requires

    def activate(self, rig: Rig) -> None:
        """Do nothing: the detector has no state."""

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the most probable scene, UNSURE if a sensor is missing."""
        return self.decide(observation.stamp_ns, self.get_features(observation))

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return the model's features (F,), None if a sensor is missing."""
        return self._features.get_features(observation)

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the most probable scene for features (F,), with the training's prior.

        The likelihoods of the vote are without it: a policy has a prior of its own.
        """
        if features is None or np.isnan(features).any():
            return SceneVote(stamp_ns=stamp_ns, scene=UNSURE)
        scores = self._weights @ features + self._offset
        shares = np.exp(scores - scores.max())
        shares /= shares.sum()
        best = int(np.argmax(shares))
        likelihoods = shares / self._prior
        likelihoods /= likelihoods.sum()
        return SceneVote(
            stamp_ns=stamp_ns,
            scene=self.scenes[best],
            value=float(shares[best]),
            likelihoods=dict(zip(self.scenes, likelihoods.tolist(), strict=True)),
        )

    def shutdown(self) -> None:
        """Do nothing."""
