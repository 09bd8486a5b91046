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
    """Corrects one observation's odometry and gyro after the other, and learns from modules."""

    def __init__(self, policy: Policy, rig: Rig) -> None:
        has_gyro = Sensor.GYRO in rig.sensors
        self._zero = GyroZero() if policy.calibrate_odometry and has_gyro else None
        self._scale = WheelScale() if policy.calibrate_odometry else None
        self._turn = Gyrodometry() if policy.turn_by_gyro and has_gyro else None

    def correct(self, observation: Observation) -> Observation:
        """Return the observation without the errors that are known so far."""
        for part in (self._zero, self._scale, self._turn):
            if part is not None:
                observation = part.correct(observation)
        return observation

    def learn(self, hold: Hold) -> None:
        """Take in what the active module said of the newest observation."""
        if self._scale is not None:
            self._scale.learn(hold)

    def tell(self, stamp_ns: int, log: EventLog) -> None:
        """Log what was learnt, if anything."""
        known: dict[str, object] = {}
        if self._scale is not None and self._scale.is_learnt:
            known |= {"wheel_scale": self._scale.scale, "scale_deviation": self._scale.deviation}
        if self._zero is not None and self._zero.bias_radps.any():
            known |= {"gyro_bias_radps": self._zero.bias_radps.tolist()}
        if known:
            log.add("calibration", stamp_ns, **known)
