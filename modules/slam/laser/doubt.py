"""What a pose may be off by where a scan cannot tell which source of motion is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneslam.types.planar import Matrix, Planar

from .matcher import Match
from .prior import MotionPrior

_APART_M, _APART_RAD = 0.005, 0.005  # sources that differ by less from scan to scan agree


@dataclass(slots=True)
class Doubt:
    """Adds up how far apart the poses by the sources of motion are while they disagree.

    The pose is that of the likeliest source; the variance of the mixture is that of the others'
    differences from it, by their probabilities. What wheels lead away by in one disagreement is one
    error, as a lie lasts; errors of several disagreements are independent.
    """

    _before: Matrix = field(default_factory=lambda: np.zeros((3, 3)), init=False)
    _now: Planar = field(default_factory=lambda: np.zeros(3), init=False)

    @property
    def covariance(self) -> Matrix:
        """Return the covariance (3, 3) that adds to the pose's, axes of local."""
        return np.asarray(self._before + np.outer(self._now, self._now))

    def add(self, match: Match, priors: Sequence[MotionPrior]) -> None:
        """Add a scan that was matched with these priors."""
        if len(match.probabilities) != len(priors):
            return  # it was found by a wide search
        offs = np.array([match.drawn_to(prior) for prior in priors])
        shares = match.probabilities * (offs[:, :2] ** 2).sum(axis=1)
        other = int(np.argmax(shares))
        off = offs[other]
        if np.hypot(off[0], off[1]) < _APART_M and abs(off[2]) < _APART_RAD:
            self._before, self._now = self.covariance, np.zeros(3)
        else:
            self._now = self._now + np.sqrt(match.probabilities[other]) * off
