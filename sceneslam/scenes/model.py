"""A trained scene classifier, stored as a small YAML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError
from sceneslam.types.scene_model import SceneModel, read_scene_model

_DIGITS = 5  # significant digits in the file
_PRIOR_MIN = 1e-6  # of a scene whose labels gain nothing: it has no weight


class Model(SceneModel):
    """A softmax regression on features that are normalised to mean 0 and standard deviation 1."""

    __slots__ = ()

    def scores(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scenes' logits (N, S) for features (N, F)."""
        return np.asarray((features - self.mean) / self.scale @ self.weights.T + self.bias)

    def cooled(self, temperature: float) -> Model:
        """Return the model with its logits divided by a temperature (below 1: more certain)."""
        prior = self.prior ** (1.0 / temperature)
        return Model(
            scenes=self.scenes,
            features=self.features,
            mean=self.mean,
            scale=self.scale,
            weights=self.weights / temperature,
            bias=self.bias / temperature,
            prior=prior / prior.sum(),
        )

    def write(self, path: Path, comment: Sequence[str]) -> None:
        """Write a readable YAML file."""
        node = {
            "scenes": list(self.scenes),
            "features": list(self.features),
            "mean": _rounded(self.mean),
            "scale": _rounded(self.scale),
            "weights": {
                scene: _rounded(row) for scene, row in zip(self.scenes, self.weights, strict=True)
            },
            "bias": dict(zip(self.scenes, _rounded(self.bias), strict=True)),
            "prior": dict(zip(self.scenes, _rounded(self.prior), strict=True)),
        }
        text = "".join(f"# {line}\n" for line in comment)
        text += yaml.safe_dump(node, sort_keys=False, default_flow_style=None, width=100)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    @classmethod
    def read(cls, path: Path) -> Model:
        """Return the model in a file; raises InputError if it is missing or invalid."""
        found = read_scene_model(path)
        return cls(**{each.name: getattr(found, each.name) for each in fields(found)})


def shares(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the probabilities (N, S) of scenes by their logits (N, S)."""
    powers = np.exp(scores - scores.max(axis=1, keepdims=True))
    return np.asarray(powers / powers.sum(axis=1, keepdims=True))


def fit(
    features: NDArray[np.float64],
    labels: Sequence[str],
    weights: NDArray[np.float64],
    names: Sequence[str],
) -> Model:
    """Return the model for features (N, F) with a scene and a weight each.

    Its prior is each scene's share of the weight.

    Raises ConfigError if scikit-learn is not installed.
    """
    try:
        from sklearn.linear_model import LogisticRegression
    except ImportError as error:
        allowed = "what the extra installs: pip install 'sceneslam[learn]'"
        raise ConfigError("scikit-learn", "nothing", allowed) from error
    mean = np.average(features, axis=0, weights=weights)
    scale = np.sqrt(np.average((features - mean) ** 2, axis=0, weights=weights))
    # The mean of a constant feature is rounded, so that its deviation is not exactly 0.
    scale = np.where(np.ptp(features, axis=0) > 0, scale, 1.0)
    regression: Any = LogisticRegression(max_iter=5000)  # type: ignore[no-untyped-call]
    regression.fit((features - mean) / scale, np.array(labels), sample_weight=weights)
    rows, bias = np.asarray(regression.coef_), np.asarray(regression.intercept_)
    if len(rows) == 1:  # with two scenes it fits the logit of the second only
        rows, bias = np.concatenate([-rows, rows]) / 2, np.concatenate([-bias, bias]) / 2
    totals = np.array([weights[np.array(labels) == scene].sum() for scene in regression.classes_])
    return Model(
        scenes=tuple(map(str, regression.classes_)),
        features=tuple(names),
        mean=mean,
        scale=scale,
        weights=rows,
        bias=bias,
        prior=np.maximum(totals / totals.sum(), _PRIOR_MIN),
    )


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values.tolist()]
