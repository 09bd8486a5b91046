"""Take views along the path: to be kept in the map, and to be compared with a loaded one."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.views.triangulation import Triangulation
from sceneslam.views.view import Landmarks, LandmarkView, LandmarkViewer

_APART_M, _APART_RAD = 0.3, 0.25  # between two views that are kept: up to 80 kB per metre of path
_READOUT_S = 0.03  # of a rolling shutter: in a turn, rows see from different directions
_SHEAR_MAX_RAD = 0.015  # a degree: of a view that is kept


class ViewTaker:
    """Knows how fast the camera turns, and where views were taken."""

    def __init__(self, rig: Rig, *, is_keeping: bool, is_comparing: bool = False) -> None:
        """`is_keeping`: views are kept in the map; `is_comparing`: with those of a loaded one."""
        self._viewer = LandmarkViewer.of(rig) if is_keeping or is_comparing else None
        self._triangulation: Triangulation | None = None
        if is_keeping and rig.camera is not None:
            self._triangulation = Triangulation(rig.camera)
        self._is_keeping = is_keeping
        self._T_run_kept: Transform | None = None  # of the last view that was kept
        self._last: tuple[int, Transform] | None = None  # stamp and pose
        self._shear_rad = 0.0
        self._measures_depth = Sensor.DEPTH in rig.sensors

    def move(self, stamp_ns: int, T_run_base: Transform) -> None:
        """Follow the pose (4, 4) of every observation."""
        if self._viewer is None:
            return
        if self._last is not None:
            step = se3.inverse(self._last[1]) @ T_run_base
            elapsed_s = max(stamp_ns - self._last[0], 1) / 1e9
            self._shear_rad = float(se3.rotation_angle_rad(step)) * _READOUT_S / elapsed_s
        self._last = stamp_ns, T_run_base
        if self._triangulation is not None:
            self._triangulation.step(stamp_ns, T_run_base)

    def is_kept(self, observation: Observation, T_run_base: Transform) -> bool:
        """Tell whether the view of an observation from a pose (4, 4) is to be kept."""
        if self._viewer is None or not self._is_keeping or self._shear_rad > _SHEAR_MAX_RAD:
            return False
        if self._measures_depth and observation.depth_m is None:
            return False  # the next one has a depth image
        if self._T_run_kept is None:
            return True
        away = se3.inverse(self._T_run_kept) @ T_run_base
        is_far = np.linalg.norm(away[:3, 3]) >= _APART_M
        return bool(is_far or se3.rotation_angle_rad(away) >= _APART_RAD)

    def take(self, observation: Observation) -> LandmarkView | None:
        """Return the view of an observation; None with too few features, or without an image."""
        if self._viewer is None:
            return None
        return self._viewer.look(observation, shear_rad=self._shear_rad)

    def keep(self, T_run_base: Transform) -> None:
        """Record that the view from a pose (4, 4) is kept."""
        self._T_run_kept = T_run_base

    def rewind(self, stamp_ns: int) -> None:
        """Forget what was seen from a stamp on: other poses replace those it was seen from."""
        if self._triangulation is not None:
            self._triangulation.rewind(stamp_ns)

    def locate(
        self, view: LandmarkView | None, stamp_ns: int, T_run_base: Transform
    ) -> Landmarks | None:
        """Follow a step (4, 4); return the landmarks of its view, None without or with too few.

        Beside the depths measured, the views before locate them. A stamp may come again, with
        another pose: what came after it before is forgotten.
        """
        if self._triangulation is not None:
            self._triangulation.step(stamp_ns, T_run_base)
        if view is None:
            return None
        assert self._viewer is not None and self._triangulation is not None
        found = self._triangulation.locate(view, T_run_base)
        self._triangulation.add(view, stamp_ns, T_run_base)
        return self._viewer.landmarks(view, found.depth_m, found.deviation_m)
