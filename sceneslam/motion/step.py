"""A motion as one witness has it, and what its error grows with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """A motion as one witness has it. Pairs are of the distance and of the turn."""

    T: Transform
    variance: NDArray[np.float64]  # (2,) [m^2, rad^2]
    amounts: NDArray[np.float64]  # (2,) [m, rad]: what the variance of its noise grows with
    causes: NDArray[np.float64]  # (3,): metres, radians, seconds, of the turn's systematic error

    def then(self, step: Step) -> Step:
        """Return both in a row."""
        return Step(
            T=self.T @ step.T,
            variance=self.variance + step.variance,
            amounts=self.amounts + step.amounts,
            causes=self.causes + step.causes,
        )

    def turned(self, turn: NDArray[np.float64], noise_rad: float, duration_s: float) -> Step:
        """Return the step with the gyro's turn."""
        return Step(
            T=se3.from_parts(se3.so3_exp(turn), self.T[:3, 3]),
            variance=np.array([self.variance[0], noise_rad**2]),
            amounts=np.array([self.amounts[0], 0.0]),
            causes=np.array([0.0, 0.0, duration_s]),
        )


def still() -> Step:
    """Return no motion at all."""
    return Step(T=se3.identity(), variance=np.zeros(2), amounts=np.zeros(2), causes=np.zeros(3))
