"""What bridges and judges: the wheels and the gyro, with all that is known of their errors."""

from __future__ import annotations

from sceneslam.bus.events import EventLog
from sceneslam.bus.gyro_zero import GyroZero
from sceneslam.bus.gyrodometry import Gyrodometry
from sceneslam.bus.hold import Hold
from sceneslam.bus.policy import Policy
from sceneslam.bus.wheel_scale import WheelScale
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor


class Reckoning:
    """Corrects one observation's odometry and gyro after the other, and learns from modules.

    Where no gate watches a module, it does not teach the way.
    """

    def __init__(self, policy: Policy, rig: Rig) -> None:
        is_watched = policy.gate is not None and policy.handover != "cold"
        has_gyro = Sensor.GYRO in rig.sensors
        self._zero = GyroZero() if policy.calibrate_odometry and has_gyro else None
        self._turn = Gyrodometry() if policy.turn_by_gyro and has_gyro else None
        self._scale = WheelScale() if policy.calibrate_odometry and is_watched else None

    def correct(self, observation: Observation) -> Observation:
        """Return the observation without the errors that are known so far."""
        if self._zero is not None:
            before = self._zero.bias_radps[2]
            observation = self._zero.correct(observation)
            if self._turn is not None:
                self._turn.shift(float(self._zero.bias_radps[2] - before))
        if self._turn is not None:
            observation = self._turn.correct(observation)
        if self._scale is not None:
            observation = self._scale.correct(observation)
        return observation

    def learn(self, hold: Hold) -> None:
        """Take in what the active module said of the newest observation."""
        if self._zero is not None:
            self._zero.watch(hold)
        if self._scale is not None:
            self._scale.learn(hold)

    def close(self, stamp_ns: int, log: EventLog) -> None:
        """Log what was learnt, if anything. May be called twice."""
        (zero, self._zero), (scale, self._scale) = (self._zero, None), (self._scale, None)
        known: dict[str, object] = {}
        if scale is not None and scale.scale != 1.0:
            known |= {"wheel_scale": scale.scale, "scale_deviation": scale.deviation}
        if zero is not None and zero.bias_radps.any():
            known |= {"gyro_bias_radps": zero.bias_radps.tolist()}
        if known:
            log.add("calibration", stamp_ns, **known)
