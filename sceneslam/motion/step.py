"""A motion by one source, with the quantities that its error grows with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

UNKNOWN_VELOCITY = np.array([1.0, 2.0])  # m/s, rad/s: standard deviation of an unknown velocity


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """A motion by one source. Pairs (2,) hold the distance, then the turn."""

    T: Transform
    variance: NDArray[np.float64]  # (2,) [m^2, rad^2]
    amounts: NDArray[np.float64]  # (2,) [m, rad]: the variance of the noise grows with these
    causes: NDArray[np.float64]  # (3,) [m, rad, s]: the turn's systematic error grows with these

    def then(self, step: Step) -> Step:
        """Return this step followed by another."""
        return Step(
            T=self.T @ step.T,
            variance=self.variance + step.variance,
            amounts=self.amounts + step.amounts,
            causes=self.causes + step.causes,
        )

    def turned(self, turn: NDArray[np.float64], noise_rad: float, duration_s: float) -> Step:
        """Return the step with its turn replaced by the gyro's rotation vector (3,) [rad]."""
        return Step(
            T=se3.from_parts(se3.so3_exp(turn), self.T[:3, 3]),
            variance=np.array([self.variance[0], noise_rad**2]),
            amounts=np.array([self.amounts[0], 0.0]),
            causes=np.array([0.0, 0.0, duration_s]),
        )


def still() -> Step:
    """Return the step without motion."""
    return Step(T=se3.identity(), variance=np.zeros(2), amounts=np.zeros(2), causes=np.zeros(3))
