"""What a pose may be off by where a scan cannot tell which source of motion is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.planar import Matrix, Planar

from .matcher import Match
from .prior import MotionPrior

_APART_M, _APART_RAD = 0.005, 0.005  # sources that differ by less from scan to scan agree


@dataclass(slots=True)
class Doubt:
    """Adds up how far apart the poses by the sources of motion are while they disagree.

    The pose is that of the likeliest source; another one adds the variance of its difference from
    it, by its probability (of several, the one that adds most). What wheels lead away by in one
    disagreement is one error, as a lie lasts; errors of several disagreements are independent.
    """

    _before: Matrix = field(default_factory=lambda: np.zeros((3, 3)), init=False)
    _now: Planar = field(default_factory=lambda: np.zeros(3), init=False)
    _at_m: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2), init=False)

    def covariance(self, pose: Planar) -> Matrix:
        """Return the covariance (3, 3) that adds to that of the pose (3,), axes of local.

        That pose is where the robot is from now on.
        """
        self._carry(pose)
        return np.asarray(self._before + np.outer(self._now, self._now))

    def add(self, match: Match, priors: Sequence[MotionPrior]) -> None:
        """Add a scan that was matched with these priors."""
        self._carry(match.T_local_base)
        if not match.weighs_sources:
            return  # there is one source, or the pose was found by a wide search
        offs = np.array([match.drawn_to(prior) for prior in priors])
        shares = match.probabilities * (offs[:, :2] ** 2).sum(axis=1)
        shares[np.argmax(match.probabilities)] = -1.0
        other = int(np.argmax(shares))
        off = offs[other]
        if np.hypot(off[0], off[1]) < _APART_M and abs(off[2]) < _APART_RAD:
            self._before, self._now = self.covariance(match.T_local_base), np.zeros(3)
        else:
            self._now = self._now + np.sqrt(match.probabilities[other]) * off

    def _carry(self, pose: Planar) -> None:
        """Move to another pose: a heading in doubt moves what comes after it."""
        (x_m, y_m), self._at_m = pose[:2] - self._at_m, np.array(pose[:2])
        G = np.array([[1.0, 0.0, -y_m], [0.0, 1.0, x_m], [0.0, 0.0, 1.0]])
        self._before, self._now = G @ self._before @ G.T, G @ self._now
