"""Reported poses relative to keyframes, so that they move with the keyframes' corrections."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

from .keyframe_map import KeyframeMap


class PoseHistory:
    """One entry of 150 bytes per tracked observation."""

    def __init__(self, keyframes: KeyframeMap) -> None:
        self._map = keyframes
        self._stamps_ns: list[int] = []
        self._references: list[int] = []
        self._T_key_base: list[se3.Transform] = []

    def add(self, stamp_ns: int, reference: int, T_local_base: se3.Transform) -> None:
        """Add T_local_base (4, 4) [m] relative to the keyframe `reference`."""
        self._stamps_ns.append(stamp_ns)
        self._references.append(reference)
        self._T_key_base.append(self._map[reference].T_cam_local @ T_local_base)

    def trajectory(self) -> Trajectory:
        """Return T_local_base at all stamps, by the keyframes' current poses."""
        if not self._stamps_ns:
            return Trajectory.empty()
        keys = np.array([keyframe.T_local_cam for keyframe in self._map.keyframes])
        return Trajectory(
            stamps_ns=np.array(self._stamps_ns, np.int64),
            T_world_base=keys[self._references] @ np.array(self._T_key_base),
        )
