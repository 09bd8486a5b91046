"""The interface to a library's cloud map, with overlap and localizability of clouds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation

from .cloud_shape import cloud_localizability
from .clouds import Cloud
from .degeneracy import Localizability

_SLOTS = 1 << 20
_SHAPE_POINTS = 10_000  # points used for the shape of a cloud


class CloudMap(ABC):
    """Registers clouds in `local`; only accepted clouds become part of the map.

    `register` stores the registered points (`source`) and those for the map (`dense`), both (N, 3)
    [m] in base.
    """

    source: Cloud
    dense: Cloud
    capture_m: float = np.inf  # points that a guess puts farther off may be taken for others
    guess_off_m: float = 0.0  # how far the next guess may be off, as no velocity was measured yet

    def __init__(self, *, voxel_m: float, range_max_m: float) -> None:
        self._edge_m, self._range_max_m = voxel_m, range_max_m
        self._known = np.zeros(_SLOTS, np.bool_)  # a hash table of voxels with few collisions
        self._marked_at = np.zeros(3)

    def listen(self, observation: Observation) -> None:  # noqa: B027
        """Take what an observation holds besides its cloud; called for all, also without one."""

    @abstractmethod
    def register(
        self, cloud: Cloud, T_local_guess: se3.Transform, observation: Observation
    ) -> se3.Transform | None:
        """Return T_local_base (4, 4) [m] of a cloud (N, 3) [m], base; None if the library fails."""

    @abstractmethod
    def add(self, T_local_guess: se3.Transform, T_local_base: se3.Transform) -> None:
        """Add the last cloud to the library's map, and update its model of prediction errors."""

    @abstractmethod
    def points(self) -> NDArray[Any]:
        """Return the map's points (N, 3) [m], local."""

    def overlap(self, T_local_base: se3.Transform) -> tuple[float, int]:
        """Return the share and the number of points in known voxels of the map."""
        inliers = int(self._known[self._slots(se3.apply(T_local_base, self.source))].sum())
        return inliers / max(len(self.source), 1), inliers

    def localizability(self) -> Localizability:
        """Return how well the last cloud's shape constrains the pose, in base."""
        thinned = self.dense[:: max(1, round(len(self.dense) / _SHAPE_POINTS))]
        return cloud_localizability(thinned, 2.0 * self._edge_m)

    def accept(self, T_local_guess: se3.Transform, T_local_base: se3.Transform) -> None:
        """Add the last cloud to the map."""
        self.add(T_local_guess, T_local_base)
        if np.linalg.norm(T_local_base[:3, 3] - self._marked_at) > 0.5 * self._range_max_m:
            self._known[:] = False  # the library removes points out of range
            self._known[self._slots(self.points())] = True
            self._marked_at = T_local_base[:3, 3]
        self._known[self._slots(se3.apply(T_local_base, self.dense))] = True

    def _slots(self, points: NDArray[Any]) -> NDArray[np.int64]:
        """Return each point's index (N,) in the hash table."""
        cells = np.floor(points / self._edge_m).astype(np.int64)
        keys = (cells[:, 0] * 73856093) ^ (cells[:, 1] * 19349669) ^ (cells[:, 2] * 83492791)
        return np.asarray(keys & (_SLOTS - 1))
