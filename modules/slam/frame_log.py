"""Poses of all frames relative to their keyframes, so that they follow their corrections."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_FIRST_CAPACITY = 1024


class FrameLog:
    """Frames ordered by stamp: 156 bytes each, so 17 MB per hour at 30 Hz."""

    def __init__(self) -> None:
        self._stamps_ns = np.zeros(_FIRST_CAPACITY, np.int64)
        self._keyframe_ids = np.zeros(_FIRST_CAPACITY, np.int32)
        self._T_keyframe_base = np.zeros((_FIRST_CAPACITY, 3, 4))
        self._twist_per_s = np.zeros((_FIRST_CAPACITY, 6))  # see rgbd.see.shutter.Turning
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(
        self,
        stamp_ns: int,
        keyframe_id: int,
        T_keyframe_base: Transform,
        twist_per_s: NDArray[np.float64] | float = 0.0,
    ) -> None:
        """Add a frame relative to a keyframe; `twist_per_s` (6,): per second of longer readout."""
        if self._count == len(self._stamps_ns):
            self._grow()
        self._stamps_ns[self._count] = stamp_ns
        self._keyframe_ids[self._count] = keyframe_id
        self._T_keyframe_base[self._count] = T_keyframe_base[:3]
        self._twist_per_s[self._count] = twist_per_s
        self._count += 1

    @property
    def newest(self) -> tuple[int, Transform]:
        """Return the newest frame's keyframe and T_keyframe_base."""
        last = np.array([self._count - 1])
        return int(self._keyframe_ids[last[0]]), self._poses(last)[0]

    def hand_over(self, gone: int, heir: int, T_heir_gone: Transform) -> None:
        """Refer the frames of a removed keyframe `gone` to another one, `heir`."""
        rows = np.flatnonzero(self._keyframe_ids[: self._count] == gone)
        T_gone_base = self._poses(rows)
        self._T_keyframe_base[rows] = (T_heir_gone @ T_gone_base)[:, :3]
        self._keyframe_ids[rows] = heir

    def straighten(self, readout_s: float, twist_per_s: Mapping[int, NDArray[np.float64]]) -> None:
        """Correct all frames for a readout longer by `readout_s`, by keyframes' twists (6,)."""
        for keyframe_id, twist in twist_per_s.items():
            rows = np.flatnonzero(self._keyframe_ids[: self._count] == keyframe_id)
            T_new_old = [se3.exp(readout_s * moved) for moved in self._twist_per_s[rows]]
            if len(rows):
                poses = se3.exp(-readout_s * twist) @ self._poses(rows) @ np.stack(T_new_old)
                self._T_keyframe_base[rows] = poses[:, :3]

    def trajectory(self, T_local_keyframe: Mapping[int, Transform]) -> Trajectory:
        """Return T_local_base of the frames whose keyframes are given, ordered by stamp."""
        if not T_local_keyframe:
            return Trajectory.empty()
        known = np.array(sorted(T_local_keyframe))
        T_known = np.stack([T_local_keyframe[k] for k in known.tolist()])
        ids = self._keyframe_ids[: self._count]
        rows = np.flatnonzero(np.isin(ids, known))
        T_local_base = T_known[np.searchsorted(known, ids[rows])] @ self._poses(rows)
        return Trajectory(stamps_ns=self._stamps_ns[rows], T_world_base=_rigid(T_local_base))

    def _poses(self, rows: np.ndarray) -> np.ndarray:
        poses = np.zeros((len(rows), 4, 4))
        poses[:, :3], poses[:, 3, 3] = self._T_keyframe_base[rows], 1.0
        return poses

    def _grow(self) -> None:
        for name in ("_stamps_ns", "_keyframe_ids", "_T_keyframe_base", "_twist_per_s"):
            rows = getattr(self, name)
            setattr(self, name, np.concatenate([rows, np.zeros_like(rows)]))


def joined(first: Trajectory, then: Trajectory) -> Trajectory:
    """Return both trajectories, one after the other."""
    return Trajectory(
        stamps_ns=np.concatenate([first.stamps_ns, then.stamps_ns]),
        T_world_base=np.concatenate([first.T_world_base, then.T_world_base]),
    )


def _rigid(T_a_b: np.ndarray) -> np.ndarray:
    """Return the transforms (N, 4, 4) with orthonormal rotations."""
    return se3.from_quat_xyzw(T_a_b[:, :3, 3], se3.to_quat_xyzw(T_a_b))
