"""A scene classifier by softmax regression, as a small YAML file stores it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text

_KEYS = ("scenes", "features", "mean", "scale", "weights", "bias")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneModel:
    """Logits are W (f - mean) / scale + bias of the features f (F,), one per scene."""

    scenes: tuple[str, ...]
    features: tuple[str, ...]
    mean: NDArray[np.float64]  # (F,)
    scale: NDArray[np.float64]  # (F,), above 0
    weights: NDArray[np.float64]  # (S, F)
    bias: NDArray[np.float64]  # (S,)
    prior: NDArray[np.float64]  # (S,), above 0: the probabilities of the scenes without any feature


def read_scene_model(path: Path) -> SceneModel:
    """Return the model in a file; without `prior`, all scenes are equally probable.

    Raises InputError if it is missing or invalid.
    """
    if not path.is_file():
        raise InputError(f"model not found (python -m sceneslam.scenes train makes one): {path}")
    try:
        node: Any = yaml.safe_load(read_text(path))
    except yaml.YAMLError as error:
        raise InputError(f"model: expected YAML: {path}") from error
    missing = [key for key in _KEYS if not isinstance(node, dict) or key not in node]
    if missing:
        raise InputError(f"model: it has no {', '.join(missing)}: {path}")
    try:
        scenes = tuple(map(str, node["scenes"]))
        prior = node.get("prior") or dict.fromkeys(scenes, 1.0 / len(scenes))
        model = SceneModel(
            scenes=scenes,
            features=tuple(map(str, node["features"])),
            mean=np.array(node["mean"], np.float64),
            scale=np.array(node["scale"], np.float64),
            weights=np.array([node["weights"][scene] for scene in scenes], np.float64),
            bias=np.array([node["bias"][scene] for scene in scenes], np.float64),
            prior=np.array([prior[scene] for scene in scenes], np.float64),
        )
        _check(model)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"model: its {_KEYS} do not fit each other: {path}") from error
    return model


def _check(model: SceneModel) -> None:
    """Raise ValueError for other shapes than declared, or values without probabilities."""
    scenes, features = len(model.scenes), len(model.features)
    is_shaped = (
        model.mean.shape == model.scale.shape == (features,)
        and model.weights.shape == (scenes, features)
        and model.bias.shape == model.prior.shape == (scenes,)
    )
    numbers = (model.mean, model.scale, model.weights, model.bias, model.prior)
    is_finite = all(np.isfinite(one).all() for one in numbers)
    is_positive = (model.scale > 0).all() and (model.prior > 0).all()
    if not (is_shaped and is_finite and is_positive and len(set(model.scenes)) == scenes):
        raise ValueError("shapes, or numbers that are not finite")
