"""The robot's pose at every stamp, relative to keyframes, which may be corrected."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np

from sceneslam.types.planar import Planar, between, betweens, composed, to_transforms
from sceneslam.types.trajectory import Trajectory

from .keyframes import ScanKeyframes

_NONE = -1  # before the first keyframe: the pose as it was reported


@dataclass(slots=True)
class RelativePoseHistory:
    """Poses relative to keyframes; 40 bytes per stamp."""

    keyframes: ScanKeyframes
    _stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    _owners: array[int] = field(default_factory=lambda: array("q"))
    _motions: array[float] = field(default_factory=lambda: array("d"))  # T_keyframe_base

    def add(self, stamp_ns: int, T_local_base: Planar) -> None:
        """Add T_local_base (3,), stored relative to the newest keyframe."""
        owner = len(self.keyframes) - 1
        if owner != _NONE:
            T_local_base = between(self.keyframes.frames[owner].T_local_base, T_local_base)
        self._stamps_ns.append(stamp_ns)
        self._owners.append(owner)
        self._motions.extend(T_local_base.tolist())

    def trajectory(self) -> Trajectory:
        """Return T_local_base at every stamp, by the keyframes' current poses.

        A correction of the motion between two keyframes is distributed over the time between them.
        """
        if not self._stamps_ns:
            return Trajectory.empty()
        stamps_ns = np.array(self._stamps_ns, np.int64)
        owners = np.array(self._owners, np.int64)
        motions = np.array(self._motions).reshape(-1, 3)
        frames = self.keyframes.frames
        poses = np.vstack([self.keyframes.poses, np.zeros((1, 3))])  # the last one is for _NONE
        reported = composed(poses[owners], motions)
        kept_ns = np.array([frame.stamp_ns for frame in frames], np.int64)
        follows = np.flatnonzero((owners >= 0) & (owners + 1 < len(frames)))
        own = owners[follows]
        measured = np.array([frame.T_prev_curr for frame in frames]).reshape(-1, 3)
        missed = betweens(composed(poses[own], measured[own + 1]), poses[own + 1])
        between_ns = np.maximum(kept_ns[own + 1] - kept_ns[own], 1)  # stamps may repeat
        share = (stamps_ns[follows] - kept_ns[own]) / between_ns
        reported[follows] = composed(reported[follows], np.clip(share, 0.0, 1.0)[:, None] * missed)
        return Trajectory(stamps_ns=stamps_ns, T_world_base=to_transforms(reported))
