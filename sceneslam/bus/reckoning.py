"""What bridges and judges: wheels and gyro, with all that is known of their errors.

A judge is not taught by whom it judges: the odometry beside a module knows the gyro's bias by
rests, and the wheels' scale as the other modules measured it.
"""

from __future__ import annotations

from dataclasses import replace

from sceneslam.bus.events import EventLog
from sceneslam.bus.gyro_zero import GyroZero
from sceneslam.bus.gyrodometry import Gyrodometry
from sceneslam.bus.hold import Hold
from sceneslam.bus.policy import Policy
from sceneslam.bus.wheel_scale import WheelScale
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform


class Reckoning:
    """Corrects one observation's odometry and gyro after the other, and learns from modules.

    Where no gate watches a module, it does not teach.
    """

    def __init__(self, policy: Policy, rig: Rig) -> None:
        is_watched = policy.gate is not None and policy.handover != "cold"
        has_gyro = Sensor.GYRO in rig.sensors
        self._learns = is_watched
        self._zero = GyroZero() if has_gyro else None
        self._turn = Gyrodometry() if has_gyro else None
        self._scales: dict[str, WheelScale] = {}  # by the module that taught it
        self._T_odom_base: Transform | None = None  # of the newest observation, not to scale
        self._T_scaled_base: Transform | None = None  # the same to scale
        self._turned_rad = 0.0

    def correct(self, observation: Observation, module: str) -> Observation:
        """Return the observation without the errors that are known so far, for a module."""
        if self._zero is not None:
            before = self._zero.bias_radps[2]
            observation = self._zero.correct(observation)
            if self._turn is not None:
                self._turn.shift(float(self._zero.bias_radps[2] - before))
        if self._turn is not None:
            observation = self._turn.correct(observation)
        return self._scaled(observation, module)

    def learn(self, hold: Hold, module: str) -> None:
        """Take in what the active module said of the newest observation."""
        if self._zero is not None:
            self._zero.watch(hold)
        if self._learns and module:
            scale = self._scales.setdefault(module, WheelScale())
            scale.learn(hold, self._T_odom_base, self._turned_rad)

    def close(self, stamp_ns: int, log: EventLog) -> None:
        """Log what was learnt, if anything. May be called twice."""
        known: dict[str, object] = {}
        learnt = self._taught("")
        if learnt is not None:
            known |= {"wheel_scale": learnt.scale, "scale_deviation": learnt.variance**0.5}
        if self._zero is not None and self._zero.bias_radps.any():
            known |= {"gyro_bias_radps": self._zero.bias_radps.tolist()}
        if known:
            log.add("calibration", stamp_ns, **known)
        self._scales, self._zero = {}, None

    def _scaled(self, observation: Observation, module: str) -> Observation:
        """Return the observation with distances to scale, as the other modules measured it."""
        before, now = self._T_odom_base, observation.T_odom_base
        self._T_odom_base = now if now is not None else before
        self._turned_rad = 0.0
        if now is None or before is None:
            self._T_scaled_base = self._T_scaled_base if now is None else now
            return observation
        T_prev_curr = se3.inverse(before) @ now
        if self._learns:
            self._turned_rad = float(se3.rotation_angle_rad(T_prev_curr))
        learnt = self._taught(module)
        if learnt is None and self._T_scaled_base is before:
            self._T_scaled_base = now  # nothing was ever scaled
            return observation
        T_prev_curr[:3, 3] *= 1.0 if learnt is None else learnt.scale
        assert self._T_scaled_base is not None
        self._T_scaled_base = se3.chained(self._T_scaled_base, T_prev_curr)
        self._T_scaled_base.setflags(write=False)
        return replace(observation, T_odom_base=self._T_scaled_base)

    def _taught(self, module: str) -> WheelScale | None:
        """Return the scale that any module but one knows best, None where none taught it."""
        others = (one for key, one in self._scales.items() if key != module and one.scale != 1.0)
        return min(others, key=lambda one: one.variance, default=None)
