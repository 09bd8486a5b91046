"""Fast image features for learned detectors: all together take a tenth of a millisecond.

They are computed on a grid of about 100 rows for any image size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

from .features import FEATURES

_ROWS = 96  # of the grid
_FLOOR = 4.0  # grey values of read noise: ratios of smaller values are meaningless
_DARK, _WHITE = 16, 250  # grey values: below noise, or nearly saturated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Grid:
    """The pixels on the grid and their cumulative distribution."""

    image_bgr: NDArray[np.uint8]  # (h, w, 3)
    grey: NDArray[np.uint8]  # (h, w)
    shares: NDArray[np.float64]  # (256,), cumulative distribution of grey values


Measure = Callable[[_Grid], float]


def _quantile(share: float, grid: _Grid) -> float:
    """Return a quantile of grey values as log2 relative to white."""
    grey = float(np.searchsorted(grid.shares, share))
    return float(np.log2((grey + _FLOOR) / (255.0 + _FLOOR)))


def _gradient(grid: _Grid) -> float:
    """Return the logarithm of the mean difference of neighbours on the grid: texture, sharpness."""
    steps = cv2.absdiff(grid.grey[:, 1:], grid.grey[:, :-1])
    return float(np.log2(1.0 + cv2.mean(steps)[0]))


def _dark(grid: _Grid) -> float:
    return float(grid.shares[_DARK])


def _white(grid: _Grid) -> float:
    return float(1.0 - grid.shares[_WHITE])


def _colour(grid: _Grid) -> float:
    """Return the mean saturation of the colours, 0 (grey) to 1."""
    saturation = cv2.cvtColor(grid.image_bgr, cv2.COLOR_BGR2HSV)[..., 1]
    return float(cv2.mean(saturation)[0] / 255.0)


_OF_GRID: Mapping[str, Measure] = {
    **{f"q{percent}": partial(_quantile, percent / 100) for percent in (10, 25, 50, 75, 90, 98)},
    "gradient": _gradient,
    "dark": _dark,
    "white": _white,
    "colour": _colour,
}
NAMES = (*_OF_GRID, *FEATURES)


class ImageFeatures:
    """The named features of an observation, in their order."""

    def __init__(self, names: Sequence[str]) -> None:
        if not names or not set(names) <= set(NAMES) or len(set(names)) < len(names):
            raise ConfigError("names", list(names), f"different ones of {', '.join(NAMES)}")
        self._names = tuple(names)

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sensors of all features."""
        needed = [
            FEATURES[name].sensor if name in FEATURES else Sensor.IMAGE for name in self._names
        ]
        return (frozenset(needed),)

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return the features (F,), None if a sensor is missing."""
        if not all(observation.has(sensor) for sensor in self.requires[0]):
            return None
        grid = None if observation.image_bgr is None else _grid(observation.image_bgr)
        return np.array(
            [
                _OF_GRID[name](grid)
                if name in _OF_GRID and grid is not None
                else FEATURES[name].measure(observation)
                for name in self._names
            ]
        )


def _grid(image_bgr: NDArray[np.uint8]) -> _Grid:
    step = max(1, min(image_bgr.shape[:2]) // _ROWS)
    pixels = np.ascontiguousarray(image_bgr[::step, ::step])
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    counts = np.bincount(grey.ravel(), minlength=256)
    return _Grid(
        image_bgr=pixels,
        grey=np.asarray(grey, np.uint8),
        shares=np.cumsum(counts, dtype=np.float64) / grey.size,
    )
