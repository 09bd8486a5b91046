"""Predict the base's pose from the last one by the motion model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.motion.model import MotionModel
from sceneslam.motion.motion import KEPT_S, Motion
from sceneslam.types import se3
from sceneslam.types.covariance import Matrix, covariance_of
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform

_FIRST_DEVIATION = 1e-4  # m and rad: of the first pose, which defines `local`
_UNMEASURED = 0.01  # 1/m^2, 1/rad^2: information in directions that a sensor does not measure


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """The expected pose of the base at an observation."""

    T_local_base: Transform
    covariance: Matrix  # (6, 6), se3.log order [m, rad], base, relative to the local map
    motion: Motion  # since the observation before

    @property
    def is_measured(self) -> bool:
        """Tell whether trusted odometry covers all motion since the last measured pose."""
        return self.motion.is_measured and not self.motion.is_doubted


class Predictor:
    """Propagates a pose and its covariance from one observation to the next.

    For every observation call `predict`, then `measure`, `coast`, `lose` or `bridged`.
    """

    def __init__(self, rig: Rig) -> None:
        self.model = MotionModel(rig)
        self.T_local_base = se3.identity()  # of the last observation, measured or predicted
        self.covariance = np.eye(6) * _FIRST_DEVIATION**2
        self.T_local_measured = se3.identity()  # the last that was measured
        self.is_lost = False  # the motion to the last observation is unknown
        self._measured_ns: int | None = None
        self._alone = np.zeros((6, 6))  # the sensor's own covariance of the last measured pose

    def predict(self, observation: Observation) -> Prediction:
        """Return the predicted pose of the base at an observation."""
        motion = self.model.predict(observation)
        carried = se3.carried(self.covariance, se3.inverse(motion.T_prev_curr))
        return Prediction(
            T_local_base=se3.orthonormal(self.T_local_base @ motion.T_prev_curr),
            covariance=carried + motion.covariance,
            motion=motion,
        )

    def unmeasured_s(self, observation: Observation) -> float:
        """Return the time [s] since the last measured pose; 0 before the first."""
        if self._measured_ns is None:
            return 0.0
        return (observation.stamp_ns - self._measured_ns) * 1e-9

    def is_long_unmeasured(self, observation: Observation) -> bool:
        """Tell whether the last measured pose is so old that a predicted one is lost."""
        return self.unmeasured_s(observation) > KEPT_S

    def measure(
        self,
        observation: Observation,
        T_local_base: Transform,
        covariance: Matrix,
        information: Matrix | None = None,
    ) -> None:
        """Continue from a measured pose (4, 4) with its covariance (6, 6), in base.

        `information` (6, 6) is that of the sensor alone, without the prediction; it calibrates the
        motion model. None: the pose was not measured directly, and the model is not calibrated.
        """
        if information is None or self.is_lost or self._measured_ns is None:
            self.model.skip()
            alone = covariance
        else:
            alone = covariance_of(information, unmeasured=_UNMEASURED)
            T_before_now = se3.inverse(self.T_local_measured) @ T_local_base
            carried = se3.carried(self._alone, se3.inverse(T_before_now))
            self.model.learn(T_before_now, alone + carried)
        self.T_local_base = self.T_local_measured = T_local_base
        self.covariance, self._alone = covariance, alone
        self._measured_ns, self.is_lost = observation.stamp_ns, False

    def coast(self, prediction: Prediction) -> None:
        """Continue from a prediction; the last measured velocity is kept."""
        self.T_local_base, self.covariance = prediction.T_local_base, prediction.covariance

    def lose(self, prediction: Prediction) -> None:
        """Continue from a prediction while lost; without wheels only its rotation is used."""
        rotation, position = prediction.T_local_base[:3, :3], self.T_local_base[:3, 3]
        self.coast(prediction)
        if not prediction.is_measured:
            self.T_local_base = se3.from_parts(rotation, position)
        self.model.inertia.reset()
        self.is_lost = True

    def bridged(
        self,
        observation: Observation,
        prediction: Prediction,
        *,
        can_coast: bool = False,
        can_begin: bool = False,
    ) -> Tracking:
        """Continue without a measurement; return the predicted pose, else the last measured one.

        With odometry it is DEGRADED; else at the last velocity, for a short time and if
        `can_coast`, TRACKING; else LOST.
        """
        is_known = prediction.is_measured
        if not is_known and (not can_coast or self.is_long_unmeasured(observation)):
            self.lose(prediction)
            status = TrackingStatus.LOST
            return self.tracking(observation, self.T_local_measured, status, can_begin=can_begin)
        self.coast(prediction)
        status = TrackingStatus.DEGRADED if is_known else TrackingStatus.TRACKING
        return self.tracking(observation, prediction.T_local_base, status)

    def tracking(
        self,
        observation: Observation,
        T_local_base: Transform,
        status: TrackingStatus,
        *,
        quality_ratio: float = 0.0,
        inliers: int = 0,
        can_begin: bool = False,
    ) -> Tracking:
        """Return the answer with a pose (4, 4); the covariance is the predictor's unless LOST."""
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=T_local_base.copy(),
            status=status,
            covariance=None if status is TrackingStatus.LOST else self.covariance.copy(),
            quality_ratio=quality_ratio,
            inliers=inliers,
            can_begin=can_begin and status is TrackingStatus.LOST,
        )

    def correct(self, T_new_old: Transform) -> None:
        """Apply a correction (4, 4) of the map to the poses."""
        self.T_local_base = se3.orthonormal(T_new_old @ self.T_local_base)
        self.T_local_measured = se3.orthonormal(T_new_old @ self.T_local_measured)
