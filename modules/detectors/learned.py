"""A detector with a trained model: `python -m sceneslam.scenes train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.types.errors import InputError
from sceneslam.types.observation import UNSURE, Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor

from .image_features import ImageFeatures

_SHIPPED = Path(__file__).with_name("bright_dark.yaml")
_KEYS = ("scenes", "features", "mean", "scale", "weights", "bias")


class Learned:
    """Votes for the most probable scene by softmax regression of a few features.

    `path` is a model, a small YAML file; null: the built-in one for Bright and Dark.
    """

    quantity = "probability of the scene"
    feature_settings = ("path",)

    def __init__(self, path: str | None) -> None:
        file = _SHIPPED if path is None else Path(path)
        model = _read(file)
        try:
            self.scenes: tuple[str, ...] = tuple(map(str, model["scenes"]))
            self._features = ImageFeatures(model["features"])
            scale = np.array(model["scale"], np.float64)
            weights = np.array([model["weights"][scene] for scene in self.scenes], np.float64)
            bias = np.array([model["bias"][scene] for scene in self.scenes], np.float64)
            # Logits are W (f - mean) / scale + bias, here as one matrix and one offset.
            self._weights = weights / scale
            self._offset = bias - self._weights @ np.array(model["mean"], np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"model: its {_KEYS} do not fit each other: {file}") from error

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
        """Return the most probable scene for features (F,), with equal prior probabilities."""
        if features is None or np.isnan(features).any():
            return SceneVote(stamp_ns=stamp_ns, scene=UNSURE)
        scores = self._weights @ features + self._offset
        shares = np.exp(scores - scores.max())
        shares /= shares.sum()
        best = int(np.argmax(shares))
        return SceneVote(
            stamp_ns=stamp_ns,
            scene=self.scenes[best],
            value=float(shares[best]),
            likelihoods=dict(zip(self.scenes, shares.tolist(), strict=True)),
        )

    def shutdown(self) -> None:
        """Do nothing."""


def _read(path: Path) -> dict[str, Any]:
    """Return the contents of a model's file; raises InputError if it is invalid."""
    if not path.is_file():
        raise InputError(f"model not found (python -m sceneslam.scenes train makes one): {path}")
    try:
        model = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"model: expected YAML: {path}") from error
    missing = [key for key in _KEYS if not isinstance(model, dict) or key not in model]
    if missing:
        raise InputError(f"model: it has no {', '.join(missing)}: {path}")
    return dict(model)
