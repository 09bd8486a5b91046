"""Predict the robot's motion while no module tracks: by odometry, else at constant velocity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.motion import KEPT_S
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform


class Bridge:
    """Predicts T_map_base from the last known pose on; if not `is_active`, only keeps that pose."""

    def __init__(self, *, is_active: bool) -> None:
        self._is_active = is_active
        self._T_map_base: Transform | None = None
        self._T_odom_base: Transform | None = None
        self._stamp_ns = 0
        self._before: tuple[int, Transform] | None = None  # the pose before the last known one
        self._known: tuple[int, Transform] | None = None  # the last pose by a module or by odometry

    @property
    def T_map_base(self) -> Transform:
        """Return the last pose, measured or predicted; the identity before the first."""
        return se3.identity() if self._T_map_base is None else self._T_map_base

    @property
    def has_velocity(self) -> bool:
        """Tell whether a velocity is known; without one, the robot is assumed to stand still."""
        return self._before is not None

    def unknown_s(self, stamp_ns: int) -> float:
        """Return the time [s] since the last pose that is known; 0 before the first."""
        return 0.0 if self._known is None else (stamp_ns - self._known[0]) / 1e9

    def copy(self) -> Bridge:
        """Return a copy of the bridge; poses are shared, for they are never changed in place."""
        twin = Bridge.__new__(Bridge)
        twin.__dict__.update(self.__dict__)
        return twin

    def update(
        self, observation: Observation, T_map_base: Transform, *, is_jump: bool = False
    ) -> None:
        """Add a pose T_map_base (4, 4) measured by a module.

        `is_jump`: the pose jumped by a correction, so that no velocity is derived from it.
        """
        if is_jump:
            self._before, self._known, self._T_map_base = None, None, T_map_base  # not a motion
        self._note(observation.stamp_ns, T_map_base)
        self._move(observation, T_map_base)

    def predict(
        self,
        observation: Observation,
        *,
        by_velocity: bool,
        turn: NDArray[np.float64] | None = None,
    ) -> Transform | None:
        """Return T_map_base at the observation and continue from it; None when it is unknown.

        Odometry bridges any gap, and without any earlier pose it begins the map. `turn` (3, 3), the
        rotation since the last observation, replaces the odometry's heading. Constant velocity is
        used only with `by_velocity`, and within the horizon after the last measured pose.
        """
        if self._T_map_base is None:
            if not self._is_active or observation.T_odom_base is None:
                return None
            self._move(observation, se3.identity())  # the map begins where odometry does
        if observation.stamp_ns == self._stamp_ns:
            return self._T_map_base
        T_odom_prev, T_odom_curr = self._T_odom_base, observation.T_odom_base
        if self._is_active and T_odom_prev is not None and T_odom_curr is not None:
            T_prev_curr = se3.inverse(T_odom_prev) @ T_odom_curr
            if turn is not None:
                # Roll and pitch stay the wheels': a module's tilt error would appear as a climb.
                T_prev_curr = se3.with_yaw(T_prev_curr, se3.yaw_rad(turn))
            self._note(observation.stamp_ns, self.T_map_base @ T_prev_curr)
        elif self._is_active and by_velocity and self._is_recent(observation.stamp_ns):
            T_prev_curr = self._at_constant_velocity(observation.stamp_ns - self._stamp_ns)
        else:
            return None
        self._move(observation, self.T_map_base @ T_prev_curr)
        return self._T_map_base

    def _note(self, stamp_ns: int, T_map_base: Transform) -> None:
        """Add a pose that is known, from which velocities are computed."""
        if self._known is not None and self._known[0] < stamp_ns:
            self._before = self._known  # at a hand-over two modules give a pose at the same stamp
        self._known = (stamp_ns, T_map_base)

    def follow(self, observation: Observation, T_prev_curr: Transform) -> Transform:
        """Return T_map_base after a given motion since the last observation."""
        self._move(observation, self.T_map_base @ T_prev_curr)
        return self.T_map_base

    def moved(self, T_new_old: Transform) -> Bridge:
        """Return the bridge in a map (4, 4) that was corrected."""
        twin = self.copy()
        for name in ("_before", "_known"):
            known = getattr(self, name)
            setattr(twin, name, known and (known[0], T_new_old @ known[1]))
        if self._T_map_base is not None:
            twin._T_map_base = T_new_old @ self._T_map_base
        return twin

    def _is_recent(self, stamp_ns: int) -> bool:
        return self._known is not None and self.unknown_s(stamp_ns) <= KEPT_S

    def _at_constant_velocity(self, elapsed_ns: int) -> Transform:
        """Return the motion in `elapsed_ns` at the velocity of the last two measured poses."""
        if self._known is None or self._before is None:
            return se3.identity()
        step_ns = self._known[0] - self._before[0]
        T_prev_curr = se3.inverse(self._before[1]) @ self._known[1]
        return se3.exp(elapsed_ns / step_ns * se3.log(T_prev_curr))

    def _move(self, observation: Observation, T_map_base: Transform) -> None:
        T_odom_base = observation.T_odom_base
        if T_odom_base is None and self._T_odom_base is not None:
            # The next odometry measures from the last one, not from here.
            T_odom_base = self._T_odom_base @ se3.inverse(self.T_map_base) @ T_map_base
        self._T_map_base, self._T_odom_base = T_map_base, T_odom_base
        self._stamp_ns = observation.stamp_ns
