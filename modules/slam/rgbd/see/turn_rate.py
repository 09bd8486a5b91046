"""The base's turn rate while an image is read out, row by row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.predictor import Predictor
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_GYRO_RAD_PER_S = 0.02  # standard deviation of a gyro's turn rate
_TURN_RAD_PER_S2 = 6.0  # hand-held acceleration: a mean rate is half a step old
_TURN_RAD_PER_S = 1.0  # standard deviation without any measurement
_NEWEST_S = 0.1  # of the gyro: an image takes less
_STEP_MAX_S = 0.5  # over a longer step a mean rate is useless


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TurnRate:
    """The base's turn rate with its standard deviation."""

    rate_base: NDArray[np.float64]  # (3,) [rad/s]
    sigma_rad_per_s: float

    @property
    def is_unknown(self) -> bool:
        """Tell whether only the image can give the rate."""
        return self.sigma_rad_per_s >= _TURN_RAD_PER_S


def expected_rate(observation: Observation, predictor: Predictor) -> NDArray[np.float64]:
    """Return the predicted turn rate (3,) [rad/s], by the gyro if available."""
    rate = _gyro_rate(observation, predictor)
    return predictor.model.inertia.velocity[3:] if rate is None else rate


def measured_rate(
    observation: Observation, predictor: Predictor, T_local_base: Transform
) -> TurnRate:
    """Return the base's turn rate at an observation whose pose was found.

    By the gyro, else by the motion from the last pose; unknown after tracking was lost.
    """
    rate = _gyro_rate(observation, predictor)
    if rate is not None:
        return TurnRate(rate_base=rate, sigma_rad_per_s=_GYRO_RAD_PER_S)
    step_s = predictor.unmeasured_s(observation)
    if predictor.is_lost or not 0.0 < step_s <= _STEP_MAX_S:
        return TurnRate(rate_base=np.zeros(3), sigma_rad_per_s=_TURN_RAD_PER_S)
    T_prev_curr = se3.inverse(predictor.T_local_measured) @ T_local_base
    rate = se3.so3_log(T_prev_curr[:3, :3]) / step_s
    return TurnRate(rate_base=rate, sigma_rad_per_s=_TURN_RAD_PER_S2 * step_s)


def _gyro_rate(observation: Observation, predictor: Predictor) -> NDArray[np.float64] | None:
    """Return the mean turn rate (3,) [rad/s] by the newest gyro samples, None without any."""
    gyro = observation.gyro_base
    if gyro is None or not len(gyro) or not np.isfinite(gyro[:, 1:4]).all():
        return None
    gyro = gyro[gyro[:, 0] > gyro[-1, 0] - _NEWEST_S]  # after a gap there are older ones
    return np.asarray(gyro[:, 1:4].mean(axis=0) - predictor.model.turns.gyro_bias)
