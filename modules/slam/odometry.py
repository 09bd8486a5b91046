"""The `odometry` SLAM module: dead reckoning by odometry, without a map.

In a run, the odometry of an observation has the gyro's turn already
(`bus/judging/dead_reckoning.py`).
"""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig, Sensor

from .local import LocalModule

_LEAST = 1e-4**2 * np.eye(6)  # (0.1 mm, 0.1 mrad)^2: smallest covariance


class Odometry(LocalModule):
    """Dead reckoning, without settings."""

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return odometry."""
        return (frozenset({Sensor.ODOMETRY}),)

    def activate(self, rig: Rig) -> None:
        """Start a session: `local` is at the next observation with odometry."""
        self._wheels = rig.wheels
        self._T_odom_base: se3.Transform | None = None  # last odometry
        self._T_local_base = se3.identity()
        self._drift = _LEAST  # (6, 6) since then

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m]; LOST without odometry.

        After a gap, the motion over the gap is that of odometry.
        """
        before, T_odom_base = self._T_odom_base, observation.T_odom_base
        if T_odom_base is None:
            return self._answer(observation, TrackingStatus.LOST)
        if before is not None:
            self._move(se3.inverse(before) @ T_odom_base)
        self._T_odom_base = T_odom_base
        return self._answer(observation, TrackingStatus.TRACKING)

    def _move(self, T_prev_curr: se3.Transform) -> None:
        distance_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
        angle_rad = float(se3.rotation_angle_rad(T_prev_curr))
        along = self._wheels.drift_ratio * distance_m
        turn = self._wheels.drift_ratio * angle_rad + self._wheels.drift_rad_per_m * distance_m
        # Errors of odometry are systematic: standard deviations add up, not variances.
        covariance = se3.carried(self._drift, se3.inverse(T_prev_curr))
        deviation = np.sqrt(np.diag(covariance)) + np.array([along] * 3 + [turn] * 3)
        scale = deviation / np.sqrt(np.diag(covariance))
        self._drift = covariance * np.outer(scale, scale)
        self._T_local_base = self._T_local_base @ T_prev_curr

    def _answer(self, observation: Observation, status: TrackingStatus) -> Tracking:
        is_lost = status is TrackingStatus.LOST
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=self._T_local_base.copy(),
            status=status,
            covariance=None if is_lost else _LEAST.copy(),
            map_covariance=None if is_lost else self._drift.copy(),
            quality_ratio=0.0 if is_lost else 1.0,
        )
