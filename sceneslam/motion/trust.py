"""How far a witness of motion can be trusted: learnt from how it disagrees with another."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

_STUDENT = 4.0  # degrees of freedom: an error of five deviations counts a sixth
_HONEST_S, _LYING_S = 300.0, 5.0  # mean time for which wheels are right, and for which they lie
_EVIDENCE_MAX = 3.0  # of one comparison, as log-likelihood ratio: comparisons in a row err together
_LYING_MAX = 0.999


@dataclass(slots=True)
class NoiseRatio:
    """The standard deviation of an error after a metre (or a radian), learnt robustly.

    An error is normal with variance floor^2 + ratio^2 * amount, whatever the steps are in which
    the way is told (Siegwart and Nourbakhsh, "Introduction to Autonomous Mobile Robots", 2004,
    Eq. 5.6); ratio^2 has an inverse gamma posterior over the newest comparisons. What the
    comparison itself is off by is taken out by expectation maximisation; outliers count less, as
    under Student's distribution.
    """

    ratio: float
    doubt: float = 10.0  # so many comparisons say as much as what is believed before any
    memory: float = 200.0  # comparisons that are remembered
    _square: float = field(init=False)
    _count: float = field(init=False)

    def __post_init__(self) -> None:
        self._square, self._count = self.ratio**2, self.doubt

    def learn(
        self, missed: float, amount: float, *, floor: float, variance: float, share: float
    ) -> None:
        """Take in an error that was measured with a variance of its own; `share`: 0 to 1 of it."""
        moved = self.ratio**2 * amount
        noise = floor**2 + moved
        if moved <= 0.0:
            return
        gain = noise / (noise + variance)
        robust = (_STUDENT + 1.0) / (_STUDENT + missed**2 / (noise + variance))
        square = robust * (gain * missed) ** 2 + (1.0 - gain) * noise  # of the error itself
        part = moved / noise  # ... and of what the motion made of it
        square = part**2 * square + part * (1.0 - part) * noise
        weight = share * gain * part
        kept = 1.0 - weight / self.memory
        total = kept * self._count + weight
        self._square = (kept * self._count * self._square + weight * square / amount) / total
        self._count = total
        self.ratio = math.sqrt(self._square)


@dataclass(slots=True)
class LieDetector:
    """The probability that a witness lies just now: two states, honest and lying, that last.

    The forward recursion of a hidden Markov model: Rabiner, "A tutorial on hidden Markov models",
    Proc. IEEE 1989.
    """

    lying: float = _LYING_S / (_HONEST_S + _LYING_S)

    def wait(self, duration_s: float) -> None:
        """Let time go by: a lie may begin or end."""
        rest = _LYING_S / (_HONEST_S + _LYING_S)
        stays = math.exp(-duration_s * (1.0 / _HONEST_S + 1.0 / _LYING_S))
        self.lying = rest + (self.lying - rest) * stays

    def judge(self, evidence: float) -> None:
        """Take in how much likelier a comparison is if the witness lies (log-likelihood ratio)."""
        evidence = min(max(evidence, -_EVIDENCE_MAX), _EVIDENCE_MAX)
        odds = self.lying / (1.0 - self.lying) * math.exp(evidence)
        self.lying = min(odds / (1.0 + odds), _LYING_MAX)


def evidence_of_a_lie(
    *,
    wheels: NDArray[np.float64],
    guess: NDArray[np.float64],
    wheels_variance: float,
    guess_variance: float,
    covariance: Matrix,
) -> float:
    """Return how much likelier a measured motion is if the wheels lie (log-likelihood ratio).

    `wheels`, `guess` (N,): by what each differs from the measured motion, whose own `covariance`
    is (N, N). Inertia is no better a witness than wheels are: a drive that it predicts well does
    not make liars of wheels that are right within their noise.
    """
    unit = np.eye(len(wheels))
    by_inertia = _log_likelihood(guess, max(guess_variance, wheels_variance) * unit + covariance)
    return by_inertia - _log_likelihood(wheels, wheels_variance * unit + covariance)


def _log_likelihood(missed: NDArray[np.float64], covariance: Matrix) -> float:
    """Return the log-density of an error (N,) under a normal distribution, less a constant."""
    factor = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(factor, missed)
    return float(-0.5 * whitened @ whitened - np.log(np.diag(factor)).sum())
