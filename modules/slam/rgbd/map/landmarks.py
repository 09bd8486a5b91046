"""The landmark table: one row per landmark, one array per property."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_FIRST_CAPACITY = 4096


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Looks:
    """The appearance of landmarks from one viewpoint."""

    descriptors: NDArray[np.uint8]  # (N, 32)
    normals_local: NDArray[np.float64]  # (N, 3), unit vectors towards the viewer
    reach_m: NDArray[np.float64]  # (N,), distance at which they appear on level 0


class LandmarkTable:
    """Landmarks in `local`, each a Gaussian whose covariance shrinks with every sighting.

    An id is a row; rows of removed landmarks are reused, so ids stay below the limit
    that the map keeps. Properties are views: read them, change them through the methods.
    """

    def __init__(self) -> None:
        self.points_local = np.zeros((_FIRST_CAPACITY, 3))  # (C, 3) [m]
        self.information = np.zeros((_FIRST_CAPACITY, 3, 3))  # inverse covariance [1/m^2]
        self.covariance = np.zeros((_FIRST_CAPACITY, 3, 3))  # [m^2]
        self.normals_local = np.zeros((_FIRST_CAPACITY, 3))  # see Looks, also for the next two
        self.reach_m = np.zeros(_FIRST_CAPACITY)
        self.descriptors = np.zeros((_FIRST_CAPACITY, 32), np.uint8)
        self.alive = np.zeros(_FIRST_CAPACITY, bool)
        self.expected = np.zeros(_FIRST_CAPACITY, np.int64)  # images that should contain it
        self.found = np.zeros(_FIRST_CAPACITY, np.int64)  # images that did contain it
        self.scale_sigma = np.zeros(_FIRST_CAPACITY)  # ratio to distance; 0: measured by depth
        self.births = np.zeros(_FIRST_CAPACITY, np.int64)  # increases with every call of `add`
        self.shift_local = np.zeros(
            (_FIRST_CAPACITY, 3)
        )  # [m] per second that reading takes longer
        self.sightings = np.zeros(_FIRST_CAPACITY, np.int64)  # keyframes in the mean shift
        self._born = 0

    def __len__(self) -> int:
        return int(self.alive.sum())

    def add(
        self,
        *,
        points_local: NDArray[np.float64],
        information: NDArray[np.float64],
        looks: Looks,
        scale_sigma: float = 0.0,
    ) -> NDArray[np.int64]:
        """Store N landmarks with a common scale error, and return their ids (N,).

        `points_local` (N, 3) [m], `information` (N, 3, 3) [1/m^2].
        """
        self._reserve(len(points_local))
        ids = np.flatnonzero(~self.alive)[: len(points_local)]
        self.settle(ids, points_local=points_local, information=information)
        self.births[ids], self._born = self._born, self._born + 1
        self.describe(ids, looks)
        self.scale_sigma[ids] = scale_sigma
        self.alive[ids], self.expected[ids], self.found[ids] = True, 1, 1
        self.sightings[ids], self.shift_local[ids] = 0, 0.0
        return ids

    def fuse(
        self,
        ids: NDArray[np.int64],
        *,
        points_local: NDArray[np.float64],
        information: NDArray[np.float64],
    ) -> None:
        """Fuse landmarks (N,) with positions (N, 3) [m] measured by depth, by inverse variance."""
        total = self.information[ids] + information
        pull = information @ (points_local - self.points_local[ids])[:, :, None]
        self.points_local[ids] += np.linalg.solve(total, pull)[:, :, 0]
        self.information[ids], self.scale_sigma[ids] = total, 0.0
        self.covariance[ids] = np.linalg.inv(total)

    def settle(
        self,
        ids: NDArray[np.int64],
        *,
        points_local: NDArray[np.float64],
        information: NDArray[np.float64],
    ) -> None:
        """Replace positions (N, 3) [m] and information (N, 3, 3) [1/m^2] of landmarks (N,)."""
        self.points_local[ids], self.information[ids] = points_local, information
        self.covariance[ids] = np.linalg.inv(information)

    def move(self, ids: NDArray[np.int64], T_new_old: Transform) -> None:
        """Transform landmarks (N,), with their normals and covariances, by T_new_old (4, 4)."""
        rotation = T_new_old[:3, :3]
        self.points_local[ids] = se3.apply(T_new_old, self.points_local[ids])
        self.normals_local[ids] = self.normals_local[ids] @ rotation.T
        self.shift_local[ids] = self.shift_local[ids] @ rotation.T
        self.information[ids] = rotation @ self.information[ids] @ rotation.T
        self.covariance[ids] = rotation @ self.covariance[ids] @ rotation.T

    def shift(self, ids: NDArray[np.int64], shift_local: NDArray[np.float64]) -> None:
        """Add one keyframe's shift (N, 3) [m/s] of landmarks per second of longer readout.

        A landmark's shift is the mean over its keyframes.
        """
        self.sightings[ids] += 1
        change = shift_local - self.shift_local[ids]
        self.shift_local[ids] += change / self.sightings[ids][:, None]

    def describe(self, ids: NDArray[np.int64], looks: Looks) -> None:
        """Replace the appearance of landmarks (N,)."""
        self.descriptors[ids] = looks.descriptors
        self.normals_local[ids], self.reach_m[ids] = looks.normals_local, looks.reach_m

    def remove(self, ids: NDArray[np.int64]) -> None:
        """Remove landmarks (N,); their ids are reused."""
        self.alive[ids] = False

    def _reserve(self, count: int) -> None:
        capacity = len(self.alive)
        if count <= capacity - len(self):
            return
        extra = max(capacity, count)
        for name, rows in vars(self).items():
            if not isinstance(rows, np.ndarray):
                continue
            grown = np.concatenate([rows, np.zeros((extra, *rows.shape[1:]), rows.dtype)])
            setattr(self, name, grown)
