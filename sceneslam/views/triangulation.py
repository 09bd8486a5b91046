"""Locate corners without a measured depth: by the motion between views from nearby.

Beyond its range, in sunlight and on black surfaces a depth camera measures nothing, and many a
robot has none. Two views from known poses locate a corner where their rays meet (Hartley and
Zisserman, Multiple View Geometry, 2004, ch. 12); the module that tracks knows the poses.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform
from sceneslam.views.matching import matches
from sceneslam.views.rays import closest, directions
from sceneslam.views.view import NEAR_M, SIGMA_PX, LandmarkView

_BASE_M = 0.2, 3.0  # between two views: least, and most while the path is as good as a map
_VIEWS = 12  # the last ones, of 0.3 m or a turn each
_KEPT = 80  # views that are remembered: a hand-over replaces the poses of 20 s
_STEPS = 1000  # the same, in images
_JUMP_M_S = 1.0  # no robot's velocity changes so much from one image to the next: its path jumped
_JUMP_S = 1 / 30  # the same, if images come more often: a pose's noise is no jump
_PATH_M, _PATH_RAD = 0.01, 0.003  # standard deviations of the motion between two views
_OFF_PX = 1.5  # from where the other view's ray meets this one's, at most
_DEVIATION_RATIO = 0.4  # of a depth, at most: from beside where it was seen, it counts for less


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Past:
    """A view that was kept."""

    view: LandmarkView
    T_run_cam: Transform
    stamp_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Step:
    """A pose of the path, and since when it has not jumped."""

    stamp_ns: int
    T_run_base: Transform
    speed_m_s: float
    began_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Located:
    """Depths along the optical axis (N,) [m], 0 = unknown, and their standard deviations (N,)."""

    depth_m: NDArray[np.float64]
    deviation_m: NDArray[np.float64]


class Triangulation:
    """Remembers the last views and where they were taken."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._past: deque[_Past] = deque(maxlen=_KEPT)
        self._steps: deque[_Step] = deque(maxlen=_STEPS)

    def rewind(self, stamp_ns: int) -> None:
        """Forget steps and views from a stamp on: other poses replace theirs."""
        for kept in (self._past, self._steps):
            while kept and kept[-1].stamp_ns >= stamp_ns:
                kept.pop()

    def step(self, stamp_ns: int, T_run_base: Transform) -> None:
        """Follow the path (4, 4); no corner is located across a jump of it."""
        self.rewind(stamp_ns)
        speed_m_s, began_ns = 0.0, stamp_ns
        if self._steps:
            last = self._steps[-1]
            moved_m = float(np.linalg.norm(T_run_base[:3, 3] - last.T_run_base[:3, 3]))
            duration_s = (stamp_ns - last.stamp_ns) * 1e-9
            speed_m_s = moved_m / duration_s
            off_m = abs(moved_m - last.speed_m_s * duration_s)
            if off_m <= _JUMP_M_S * max(duration_s, _JUMP_S):
                began_ns = last.began_ns
        self._steps.append(
            _Step(stamp_ns=stamp_ns, T_run_base=T_run_base, speed_m_s=speed_m_s, began_ns=began_ns)
        )

    def add(self, view: LandmarkView, stamp_ns: int, T_run_base: Transform) -> None:
        """Remember a view and its pose (4, 4)."""
        T_run_cam = T_run_base @ self._camera.T_base_cam
        self._past.append(_Past(view=view, T_run_cam=T_run_cam, stamp_ns=stamp_ns))

    def locate(self, view: LandmarkView, T_run_base: Transform) -> Located:
        """Return where the corners without a depth are, in a view from a pose (4, 4)."""
        depth_m, deviation_m = np.zeros(len(view.rays)), np.zeros(len(view.rays))
        T_cam_run = se3.inverse(T_run_base @ self._camera.T_base_cam)
        began_ns = self._steps[-1].began_ns if self._steps else 0
        latest = [past for past in list(self._past)[-_VIEWS:] if past.stamp_ns >= began_ns]
        for past in latest:  # the oldest first: its rays meet at the widest angle
            left = np.flatnonzero((view.depth_m == 0) & (depth_m == 0))
            T_here_there = T_cam_run @ past.T_run_cam
            base_m = np.linalg.norm(T_here_there[:3, 3])
            if len(left) and _BASE_M[0] <= base_m <= _BASE_M[1]:
                rows, *found = self._meetings(view, past.view, T_here_there=T_here_there, rows=left)
                depth_m[rows], deviation_m[rows] = found
        return Located(depth_m=depth_m, deviation_m=deviation_m)

    def _meetings(
        self,
        here: LandmarkView,
        there: LandmarkView,
        *,
        T_here_there: Transform,
        rows: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return which corners `rows` (K,) another view shows, too, and their depths as located."""
        matched, columns = matches(here.descriptors[rows], there.descriptors)
        rows = rows[matched]
        a = directions(here.rays[rows])
        b = directions(there.rays[columns]) @ T_here_there[:3, :3].T
        z, _ = closest(a, b, T_here_there[:3, 3])
        seen_here = a * z[:, None]
        seen_there = (seen_here - T_here_there[:3, 3]) @ T_here_there[:3, :3]
        far2, there2 = (seen_here**2).sum(axis=1), (seen_there**2).sum(axis=1)
        crossed2 = (np.cross(a, b) ** 2).sum(axis=1)
        sine2 = np.maximum(crossed2 / ((a**2).sum(axis=1) * (b**2).sum(axis=1)), 1e-12)
        ray2 = (SIGMA_PX / self._camera.fx) ** 2
        variance = ray2 * (far2 * (1.0 - sine2) + there2) + _PATH_RAD**2 * there2 + _PATH_M**2
        deviation_m = np.sqrt(variance / sine2)
        ahead = np.maximum(seen_there[:, 2:], NEAR_M)
        off = np.abs(seen_there[:, :2] / ahead - there.rays[columns]).max(axis=1, initial=0.0)
        is_good = (np.minimum(z, seen_there[:, 2]) > NEAR_M) & (off <= _OFF_PX / self._camera.fx)
        is_good &= deviation_m <= _DEVIATION_RATIO * z
        return rows[is_good], z[is_good], deviation_m[is_good]
