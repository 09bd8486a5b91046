"""Motions by one source, and the base's motion with the alternatives if a source is wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import UNKNOWN_VELOCITY
from sceneslam.types.se3 import Transform

# For so long a velocity that nothing measures is kept as it is; that of a camera in a hand lasts
# 0.4 s or more (experiments/liars/README.md).
KEPT_S = 0.5
BELIEVED = 0.5  # wheels are not used if they are wrong with this probability
_CERTAIN = 100.0  # nats: more is the same, and exp(710) is no number
_RARE = 0.003  # least probability of an alternative: one scan in 300


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

    def turned(self, turn: NDArray[np.float64], variance: float, duration_s: float) -> Step:
        """Return the step with the gyro's rotation vector (3,) [rad] and its variance [rad^2]."""
        return Step(
            T=se3.from_parts(se3.so3_exp(turn), self.T[:3, 3]),
            variance=np.array([self.variance[0], variance]),
            amounts=np.array([self.amounts[0], 0.0]),
            causes=np.array([0.0, 0.0, duration_s]),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """The base's motion since the last observation."""

    T_prev_curr: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order [m, rad], axes of curr
    is_measured: bool  # wheels covered all motion since another sensor measured
    is_guessed: tuple[bool, bool] = (False, False)  # distance, turn at constant velocity
    is_unknown: bool = False  # the distance is by neither of both
    probability: float = 1.0  # that this motion is right and none of the alternatives
    alternatives: tuple[Motion, ...] = ()  # distance, turn or both by the source that is not used

    @property
    def is_doubted(self) -> bool:
        """Tell whether it is predicted without the wheels: missing ones, or probably wrong."""
        return any(self.is_guessed)

    def since_misfit(self, misfit: float, since_s: float) -> Motion:
        """Return this motion where scans have fitted worse by `misfit` nats for `since_s`.

        Then a motion that neither wheels nor inertia predict is that much more likely, and has led
        the farther away.
        """
        if misfit <= 0.0:
            return self
        reach = np.diag([(UNKNOWN_VELOCITY[0] * since_s) ** 2] * 3 + [0.0] * 3)
        alternatives = tuple(
            replace(
                other,
                covariance=np.maximum(other.covariance, reach),
                probability=min(other.probability * math.exp(min(misfit, _CERTAIN)), BELIEVED),
            )
            if other.is_unknown
            else other
            for other in self.alternatives
        )
        return replace(self, alternatives=alternatives)

    def evidence(self, probabilities: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the log-likelihood ratios (2,) of distance and turn: wheels wrong against right.

        `probabilities` (N,): of this motion and its alternatives, given a measurement.
        """
        motions = (self, *self.alternatives)
        before = np.array([motion.probability for motion in motions])
        is_wrong = np.array([motion.is_guessed for motion in motions])
        after, before = (
            np.clip(p @ is_wrong / p.sum(), 1e-9, 1 - 1e-9) for p in (probabilities, before)
        )
        return np.asarray(np.log(after / (1.0 - after)) - np.log(before / (1.0 - before)))


def still() -> Step:
    """Return the step without motion."""
    return Step(T=se3.identity(), variance=np.zeros(2), amounts=np.zeros(2), causes=np.zeros(3))


def motion_of(
    wheels: Step | None,
    guess: Step,
    *,
    duration_s: float,
    lying: NDArray[np.float64],
    is_measured: bool,
) -> Motion:
    """Return the motion with distance and turn by the wheels, unless they are wrong or missing.

    `lying` (2,): the probabilities of that. `guess` is by inertia. If neither is right, the
    distance is that of a robot whose velocity is unknown, in `duration_s`.
    """
    if wheels is None:
        distances, turns = [(guess, 1.0)], [(guess, 1.0)]
    else:
        distances, turns = (_ranked(wheels, guess, p) for p in lying.tolist())
    reach = np.array([(UNKNOWN_VELOCITY[0] * duration_s) ** 2, 0.0])
    anywhere = replace(guess, variance=np.maximum(reach, guess.variance))
    distances.append((anywhere, _RARE))
    best, *others = (
        Motion(
            T_prev_curr=se3.from_parts(turn.T[:3, :3], distance.T[:3, 3]),
            covariance=np.diag(np.repeat([distance.variance[0], turn.variance[1]], 3)),
            is_measured=is_measured,
            is_guessed=(distance is not wheels, turn is not wheels),
            is_unknown=distance is anywhere,
            probability=max(p_distance * p_turn, _RARE),
        )
        for distance, p_distance in distances
        for turn, p_turn in turns
    )
    return replace(best, alternatives=tuple(others))


def _ranked(wheels: Step, guess: Step, lying: float) -> list[tuple[Step, float]]:
    """Return both sources with their probabilities, the one that is used first."""
    sources = [(wheels, 1.0 - lying), (guess, lying)]
    return sources[::-1] if lying >= BELIEVED else sources
