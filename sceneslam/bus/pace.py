"""How far apart the remembered observations are that a module which catches up is led through."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation


@dataclass(slots=True, kw_only=True)
class PaceSettings:
    """What a module that catches up is spared: observations after so little time and motion."""

    period_s: float  # 0: none is spared
    step_m: float  # and as many radians: what is seen is a metre away or more

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 <= value < float("inf"):
                raise ConfigError(field.name, value, "0 or more")


class Pace:
    """Follows one catch-up. Only where odometry tells the motion is an observation spared."""

    def __init__(self, settings: PaceSettings) -> None:
        self._settings = settings
        self._last: Observation | None = None  # that the module was given
        self._spared: list[Observation] = []  # since then

    def spares(self, observation: Observation) -> bool:
        """Tell whether a module can do without an observation, as little as happened since."""
        last, settings = self._last, self._settings
        if last is None or last.T_odom_base is None or observation.T_odom_base is None:
            return False
        T_last_now = se3.inverse(last.T_odom_base) @ observation.T_odom_base
        return (
            observation.stamp_ns - last.stamp_ns < round(settings.period_s * 1e9)
            and float(np.linalg.norm(T_last_now[:3, 3])) < settings.step_m
            and float(se3.rotation_angle_rad(T_last_now)) < settings.step_m
        )

    def spare(self, observation: Observation) -> None:
        """Note an observation that the module is not given."""
        self._spared.append(observation)

    def give(self, observation: Observation) -> Observation:
        """Return an observation for the module, with the samples since its last."""
        spared, self._spared, self._last = self._spared, [], observation
        for older in reversed(spared):
            observation = observation.with_samples_of(older)
        return observation
