"""Where the base is expected to be: a pose that the motion model carries on from the last one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.model import Motion, MotionModel
from sceneslam.types import se3
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform

Matrix = NDArray[np.float64]

_FIRST_DEVIATION = 1e-4  # m and rad: of the pose that `local` is defined by
_COAST_S = 0.5  # without a measurement for longer, a guessed pose is no pose
_UNMEASURED = 1e-6  # 1/m^2, 1/rad^2: the information along what a sensor does not measure


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """The expected pose of the base at an observation."""

    T_local_base: Transform
    covariance: Matrix  # (6, 6) of se3.log order [m, rad], base, relative to the map around
    motion: Motion  # since the observation before

    @property
    def is_measured(self) -> bool:
        """Tell whether odometry that can be believed led here from the last measured pose."""
        return self.motion.is_measured and not self.motion.is_doubted


class Predictor:
    """Carries a pose and its covariance from one observation to the next.

    Every observation is first predicted, then either measured, or else coasted or lost.
    """

    def __init__(self, rig: Rig) -> None:
        self.model = MotionModel(rig)
        self.T_local_base = se3.identity()  # of the last observation, measured or predicted ...
        self.covariance = np.eye(6) * _FIRST_DEVIATION**2
        self.T_local_measured = se3.identity()  # ... and the last that was measured
        self._measured_ns: int | None = None
        self._is_lost = False
        self._alone = np.zeros((6, 6))  # the sensor's own covariance of the last measured pose

    @property
    def is_lost(self) -> bool:
        """Tell whether the motion to the last observation is not known."""
        return self._is_lost

    def predict(self, observation: Observation) -> Prediction:
        """Return where the base should be at an observation."""
        motion = self.model.predict(observation)
        carried = se3.adjoint(se3.inverse(motion.T_prev_curr))
        return Prediction(
            T_local_base=se3.orthonormal(self.T_local_base @ motion.T_prev_curr),
            covariance=carried @ self.covariance @ carried.T + motion.covariance,
            motion=motion,
        )

    def unmeasured_s(self, observation: Observation) -> float:
        """Return for how long no pose was measured; 0 before there was any."""
        if self._measured_ns is None:
            return 0.0
        return (observation.stamp_ns - self._measured_ns) * 1e-9

    def measure(
        self,
        observation: Observation,
        T_local_base: Transform,
        covariance: Matrix,
        information: Matrix | None = None,
    ) -> None:
        """Go on from a measured pose with its covariance (6, 6), in base.

        `information` (6, 6) is what a sensor alone says of it, the prediction left out: the motion
        model learns from that. None: nothing, as the pose was inferred in another way.
        """
        if information is None or self._is_lost or self._measured_ns is None:
            self.model.skip()
            alone = covariance
        else:
            alone = np.asarray(np.linalg.inv(information + _UNMEASURED * np.eye(6)))
            T_before_now = se3.inverse(self.T_local_measured) @ T_local_base
            carried = se3.adjoint(se3.inverse(T_before_now))
            self.model.learn(T_before_now, alone + carried @ self._alone @ carried.T)
        self.T_local_base = self.T_local_measured = T_local_base
        self.covariance, self._alone = covariance, alone
        self._measured_ns, self._is_lost = observation.stamp_ns, False

    def coast(self, prediction: Prediction) -> None:
        """Go on from a prediction at the velocity that was measured last."""
        self.T_local_base, self.covariance = prediction.T_local_base, prediction.covariance

    def lose(self, prediction: Prediction) -> None:
        """Go on from a prediction; where no wheels told of it, as if the base only turned."""
        rotation, position = prediction.T_local_base[:3, :3], self.T_local_base[:3, 3]
        self.coast(prediction)
        if not prediction.is_measured:
            self.T_local_base = se3.from_parts(rotation, position)
        self.model.slow_down()
        self._is_lost = True

    def bridge(
        self, observation: Observation, prediction: Prediction, *, can_coast: bool
    ) -> TrackingStatus:
        """Go on without a measurement; return what the pose is worth then.

        Odometry leads on (DEGRADED), else the last velocity for a moment where `can_coast`
        (TRACKING), else the pose is lost.
        """
        is_brief = self.unmeasured_s(observation) <= _COAST_S
        if prediction.is_measured or (can_coast and is_brief):
            self.coast(prediction)
            is_known = prediction.is_measured
            return TrackingStatus.DEGRADED if is_known else TrackingStatus.TRACKING
        self.lose(prediction)
        return TrackingStatus.LOST

    def correct(self, T_new_old: Transform) -> None:
        """Take that the map, and the poses with it, was corrected."""
        self.T_local_base = se3.orthonormal(T_new_old @ self.T_local_base)
        self.T_local_measured = se3.orthonormal(T_new_old @ self.T_local_measured)
