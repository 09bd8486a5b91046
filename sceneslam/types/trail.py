"""The robot's way of the last second: a scan is not of the instant of its observation."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import UNKNOWN_VELOCITY
from sceneslam.types.observation import SWEEP_MAX_S
from sceneslam.types.se3 import Transform

_KEPT_NS = 1_000_000_000  # no driver is later
_JUMP = 0.1  # m, rad: more than what stamps that jitter or noisy poses make


@dataclass(slots=True)
class Trail:
    """The poses of the last observations, in a frame of their own."""

    _stamps_ns: list[int] = field(default_factory=list)
    _poses: list[Transform] = field(default_factory=list)
    _has_jumped: bool = False  # at the newest pose, so that the velocity is of before

    def add(self, stamp_ns: int, T_w_base: Transform) -> None:
        """Go on to a pose (4, 4) [m]; what is known of its stamp or later is replaced.

        Where a loop or a hand-over moved the pose, it moves the way to it as well. No jump follows
        another: what still moves otherwise than expected has another velocity.
        """
        self._keep(slice(self._count_before(stamp_ns - _KEPT_NS), self._count_before(stamp_ns)))
        is_compared, self._has_jumped = len(self._poses) > 1 and not self._has_jumped, False
        if is_compared:
            step_s = (stamp_ns - self._stamps_ns[-1]) * 1e-9
            T_w_expected = self._poses[-1] @ se3.exp(step_s * self.twist_s)
            off = se3.log(se3.inverse(T_w_expected) @ T_w_base).reshape(2, 3)
            if (np.linalg.norm(off, axis=1) > _JUMP + step_s * UNKNOWN_VELOCITY).any():
                T_moved = T_w_base @ se3.inverse(T_w_expected)
                self._poses = [T_moved @ pose for pose in self._poses]
                self._has_jumped = True
        self._append(stamp_ns, T_w_base)

    def move(self, stamp_ns: int, T_prev_base: Transform) -> None:
        """Go on by the motion (4, 4) [m] to an observation."""
        self._append(stamp_ns, self._poses[-1] @ T_prev_base if self._poses else se3.identity())

    def retraced(self, pose_at: Callable[[int], Transform | None]) -> Trail:
        """Return the trail of the poses (4, 4) [m] that there are now at the same stamps."""
        trail = Trail()
        for stamp_ns in self._stamps_ns:
            T_w_base = pose_at(stamp_ns)
            if T_w_base is not None:
                trail.add(stamp_ns, T_w_base)
        return trail

    def base_at(self, stamp_ns: int) -> Transform:
        """Return T_base_then (4, 4) [m]: the base at a stamp, in the newest.

        Later than that, by half a sweep at most, it goes on as it moved last; the oldest one that
        is known is that before.
        """
        after = self._count_before(stamp_ns)
        if after == len(self._poses):
            ahead_s = 0.0 if not self._stamps_ns else (stamp_ns - self._stamps_ns[-1]) * 1e-9
            return se3.exp(min(ahead_s, SWEEP_MAX_S / 2) * self.twist_s)
        T_w_then = self._poses[after]
        if after > 0:
            first_ns, last_ns = self._stamps_ns[after - 1 : after + 1]
            share = (stamp_ns - first_ns) / (last_ns - first_ns)
            T_w_then = se3.interpolate(self._poses[after - 1], T_w_then, share)
        return se3.inverse(self._poses[-1]) @ T_w_then

    @property
    def twist_s(self) -> NDArray[np.float64]:
        """Return the velocity (6,) of the last motion, of se3.log order [m/s, rad/s], in base."""
        if len(self._poses) < 2:
            return np.zeros(6)
        T_prev_base = se3.inverse(self._poses[-2]) @ self._poses[-1]
        step_s = (self._stamps_ns[-1] - self._stamps_ns[-2]) * 1e-9
        return np.asarray(se3.log(T_prev_base) / step_s)

    def _append(self, stamp_ns: int, T_w_base: Transform) -> None:
        self._keep(slice(self._count_before(stamp_ns - _KEPT_NS), self._count_before(stamp_ns)))
        self._stamps_ns.append(stamp_ns)
        self._poses.append(T_w_base)

    def _keep(self, kept: slice) -> None:
        self._stamps_ns, self._poses = self._stamps_ns[kept], self._poses[kept]

    def _count_before(self, stamp_ns: int) -> int:
        return bisect_left(self._stamps_ns, stamp_ns)
