"""Which of the remembered observations a module processes while it catches up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_least


@dataclass(slots=True, kw_only=True)
class PaceSettings:
    """Observations are skipped in a catch-up after less time and motion than this."""

    period_s: float  # 0: no observation is skipped
    step_m: float  # the same number limits turns [rad]: landmarks are 1 m away or more

    def __post_init__(self) -> None:
        check_least(0, period_s=self.period_s, step_m=self.step_m)


class Pace:
    """Follows one catch-up. Observations are skipped only where odometry measures the motion."""

    def __init__(self, settings: PaceSettings) -> None:
        self._settings = settings
        self.last: Observation | None = None  # that the module was given

    def spares(self, observation: Observation) -> bool:
        """Tell whether an observation can be skipped because little time and motion passed."""
        last, settings = self.last, self._settings
        if last is None or last.T_odom_base is None or observation.T_odom_base is None:
            return False
        T_last_now = se3.inverse(last.T_odom_base) @ observation.T_odom_base
        return (
            observation.stamp_ns - last.stamp_ns < round(settings.period_s * 1e9)
            and float(np.linalg.norm(T_last_now[:3, 3])) < settings.step_m
            and float(se3.rotation_angle_rad(T_last_now)) < settings.step_m
        )
