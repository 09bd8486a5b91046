"""Estimate the noise and faults of a motion source from its differences to another source."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.covariance import UNKNOWN_VELOCITY, Matrix

_DOUBT = 10.0  # weight of the prior of a noise, in comparisons
_MEMORY = 200.0  # comparisons in its posterior, about
_STUDENT = 4.0  # degrees of freedom: an error of 5 standard deviations has weight 1/6
_HONEST_S, _LYING_S = 300.0, 5.0  # mean durations of correct and of wrong odometry
EVIDENCE_MAX = 3.0  # log-likelihood ratio of one comparison; consecutive ones correlate
_LYING_MAX = 0.999


@dataclass(slots=True)
class NoiseRatio:
    """Robust estimate of the standard deviation of an error after 1 m (or 1 rad).

    An error is normal with variance floor^2 + ratio^2 * amount, independent of the step size
    (Siegwart and Nourbakhsh, "Introduction to Autonomous Mobile Robots", 2004, Eq. 5.6); ratio^2
    has an inverse gamma posterior over the newest comparisons. Expectation maximisation removes the
    error of the comparison itself; outliers have less weight, by Student's distribution.
    """

    ratio: float
    _square: float = field(init=False)
    _count: float = field(default=_DOUBT, init=False)

    def __post_init__(self) -> None:
        self._square = self.ratio**2

    def learn(
        self, missed: float, amount: float, *, floor: float, variance: float, share: float
    ) -> None:
        """Update by an error measured with `variance`; `share` (0 to 1) is its weight."""
        moved = self.ratio**2 * amount
        noise = floor**2 + moved
        if moved <= 0.0:
            return
        gain = noise / (noise + variance)
        robust = (_STUDENT + 1.0) / (_STUDENT + missed**2 / (noise + variance))
        square = robust * (gain * missed) ** 2 + (1.0 - gain) * noise  # of the error alone
        part = moved / noise  # share of the noise that is caused by motion
        square = part**2 * square + part * (1.0 - part) * noise
        weight = share * gain * part
        kept = 1.0 - weight / _MEMORY
        total = kept * self._count + weight
        self._square = (kept * self._count * self._square + weight * square / amount) / total
        self._count = total
        self.ratio = math.sqrt(self._square)


@dataclass(slots=True)
class LieDetector:
    """Estimates the probability that a source is wrong now: two lasting states, right and wrong.

    The forward recursion of a hidden Markov model: Rabiner, "A tutorial on hidden Markov models",
    Proc. IEEE 1989.
    """

    lying: float = _LYING_S / (_HONEST_S + _LYING_S)

    def wait(self, duration_s: float) -> None:
        """Predict over `duration_s`: a fault may begin or end."""
        rest = _LYING_S / (_HONEST_S + _LYING_S)
        stays = math.exp(-duration_s * (1.0 / _HONEST_S + 1.0 / _LYING_S))
        self.lying = rest + (self.lying - rest) * stays

    def judge(self, evidence: float) -> None:
        """Update by a comparison's log-likelihood ratio, wrong against right."""
        evidence = min(max(evidence, -EVIDENCE_MAX), EVIDENCE_MAX)
        odds = self.lying / (1.0 - self.lying) * math.exp(evidence)
        self.lying = min(odds / (1.0 + odds), _LYING_MAX)


def evidence_of_a_lie(
    missed: NDArray[np.float64], variance: NDArray[np.float64], duration_s: float
) -> NDArray[np.float64]:
    """Return the log-likelihood ratios (2,) of the wheels' motion: wheels wrong against right.

    `missed` (2,) [m, rad]: distance and turn by which wheels differ from another source's motion in
    `duration_s`; `variance` (2,) is that of both together. Wheels that are wrong may report any
    motion that a robot is capable of.
    """
    wrong = variance + (UNKNOWN_VELOCITY * duration_s) ** 2
    cost, cost_wrong = (student_cost(missed**2 / v, 1) + 0.5 * np.log(v) for v in (variance, wrong))
    return np.asarray(cost - cost_wrong)


def student_cost(squared: Matrix | float, size: int, freedom: float = _STUDENT) -> Matrix:
    """Return the negative log-density of Student's distribution at squared normalised errors."""
    return np.asarray(0.5 * (freedom + size) * np.log1p(squared / freedom))
