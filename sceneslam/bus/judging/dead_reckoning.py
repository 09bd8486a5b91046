"""Dead reckoning by wheels and gyro: it bridges gaps and checks the modules' motion.

To stay independent of the module that it checks, the model is calibrated from wheels and gyro
alone, and the wheels' scale used with a module is the one that other modules measured.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.judging.gate import GateSettings, Witness
from sceneslam.bus.judging.hold import Hold
from sceneslam.bus.judging.wheel_scale import WheelScale
from sceneslam.motion.model import MotionModel
from sceneslam.motion.tilt import Tilt, upright
from sceneslam.storage.events import EventLog
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform, Vector

_UNKNOWN_RAD = 1e3  # added to what wheels miss where the gyro does not say: no more comparable
_OF_GATE = 0.5  # share of what the gate accepts, by which the odometry is corrected at most


class DeadReckoning:
    """Corrects the odometry and gyro of one observation after the other.

    Modules calibrate the wheels' scale only, and only where a gate checks them.
    """

    def __init__(self, rig: Rig, gate: GateSettings | None) -> None:
        self._learns = gate is not None
        self._drift = rig.wheels.drift_ratio
        self._limit = _OF_GATE * self._drift * (gate.sigmas if gate else 0.0)
        self.up_base: Vector | None = None  # (3,) upward direction, None: unknown
        self._motion = MotionModel(rig) if Sensor.GYRO in rig.sensors else None
        self._tilt = Tilt(self._motion) if self._motion is not None else None
        self._scales: dict[str, WheelScale] = {}  # by the module that measured it
        self._T_odom_base: Transform | None = None  # the last odometry, uncorrected
        self._T_corrected_base: Transform | None = None  # the same, corrected
        self._is_gap = False  # the last observation had no odometry
        self._turned_rad = 0.0  # rotation angle since the observation before [rad]
        self._missed_rad = 0.0  # yaw by wheels alone since the start, less the gyro's

    @property
    def witness(self) -> Witness:
        """Return what the gyro says of the wheels at the newest observation."""
        return Witness(missed_rad=None if self._motion is None else self._missed_rad)

    def correct(self, observation: Observation, module: str) -> Observation:
        """Return the observation for a module, corrected by the calibration so far."""
        turn = None  # (3, 3) since the last observation, None without a gyro
        if self._motion is not None and self._tilt is not None:
            turn = self._motion.predict(observation).T_prev_curr[:3, :3]
            self.up_base = self._tilt.update(observation, turn)
        before, now = self._T_odom_base, observation.T_odom_base
        is_gap, self._is_gap = self._is_gap, now is None
        self._turned_rad = 0.0
        observation = self._without_bias(observation)
        if now is None:
            return observation
        self._T_odom_base = now
        if before is None:
            self._T_corrected_base = now
            return observation
        T_prev_curr = se3.inverse(before) @ now
        missed_rad = _UNKNOWN_RAD
        if turn is not None and not is_gap:  # the gyro does not cover a gap
            if self._motion is not None and self._motion.is_turn_measured:
                missed_rad = se3.yaw_rad(T_prev_curr) - se3.yaw_rad(turn)
            T_prev_curr = self._turned(T_prev_curr, turn)
        self._missed_rad += missed_rad
        if self._learns:
            self._turned_rad = float(se3.rotation_angle_rad(T_prev_curr))
        learnt = self._taught(module)
        if turn is None and learnt is None and self._T_corrected_base is before:
            self._T_corrected_base = now  # nothing was corrected so far
            return observation
        T_prev_curr[:3, 3] *= 1.0 if learnt is None else learnt.scale
        assert self._T_corrected_base is not None
        self._T_corrected_base = se3.chained(self._T_corrected_base, T_prev_curr)
        if self.up_base is not None:
            self._T_corrected_base = upright(self._T_corrected_base, self.up_base)
        self._T_corrected_base.setflags(write=False)
        return replace(observation, T_odom_base=self._T_corrected_base)

    def learn(self, hold: Hold, module: str) -> None:
        """Update the wheels' scale by the distance that the active module measured."""
        if self._learns and module:
            if module not in self._scales:
                self._scales[module] = WheelScale(deviation=self._drift, limit=self._limit)
            measured = None if self._is_gap else self._T_odom_base
            self._scales[module].learn(hold, measured, self._turned_rad)

    def close(self, stamp_ns: int, log: EventLog) -> None:
        """Log the calibration, if there is one. May be called twice."""
        known: dict[str, object] = {}
        learnt = self._taught("")
        if learnt is not None:
            known |= {"wheel_scale": learnt.scale, "scale_deviation": learnt.variance**0.5}
        if self._motion is not None and self._motion.turns.gyro_bias.any():
            known |= {"gyro_bias_radps": self._motion.turns.gyro_bias.tolist()}
        if known:
            log.add("calibration", stamp_ns, **known)
        self._scales, self._motion = {}, None

    def _turned(self, T_prev_curr: Transform, turn: NDArray[np.float64]) -> Transform:
        """Return the odometry's motion with the gyro's rotation, or its yaw if that is biased."""
        if self._motion is not None and self._motion.turns.knows_level_bias:
            return se3.from_parts(turn, T_prev_curr[:3, 3])
        return se3.with_yaw(T_prev_curr, se3.yaw_rad(turn))

    def _without_bias(self, observation: Observation) -> Observation:
        if self._motion is None or observation.gyro_base is None:
            return observation
        gyro = observation.gyro_base.copy()
        gyro[:, 1:] -= self._motion.turns.gyro_bias
        gyro.setflags(write=False)
        return replace(observation, gyro_base=gyro)

    def _taught(self, module: str) -> WheelScale | None:
        """Return the most certain scale of all modules but `module`, None without any."""
        others = (one for key, one in self._scales.items() if key != module and one.scale != 1.0)
        return min(others, key=lambda one: one.variance, default=None)
