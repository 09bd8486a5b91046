"""The predicted pose of a scan by one source of motion, and what it costs to contradict it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.trust import student_cost
from sceneslam.types.planar import Matrix, Planar, wrap

_REACH_SIGMAS = 10.0  # farther away is less than a thousandth of the prior, heavy as its tails are
_SAME_M, _SAME_RAD = 0.02, 0.01  # so far around a match the scan's cost is quadratic
_STUDENT = 4.0  # degrees of freedom of the prior: an error of 10 sigmas has weight 1/20
_NORMAL = 1e6  # degrees of freedom of a normal distribution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionPrior:
    """The predicted pose of a scan by one source of motion.

    The wheels' prior has heavy tails (Student's distribution), so that a contradicting scan
    prevails. Position and heading are weighted separately: slipping wheels may turn correctly.
    """

    pose: Planar
    covariance: Matrix
    information: Matrix
    probability: float
    freedom: float  # degrees of freedom of Student's distribution

    @classmethod
    def of(cls, pose: Planar, covariance: Matrix, probability: float = 1.0) -> MotionPrior:
        """Return the prior of a pose (3,) with covariance (3, 3); normal if it is the only one."""
        return cls(
            pose=pose,
            covariance=covariance,
            information=np.asarray(np.linalg.inv(covariance), dtype=np.float64),
            probability=probability,
            freedom=_NORMAL if probability == 1.0 else _STUDENT,
        )

    def off(self, pose: Planar) -> Planar:
        """Return the difference (3,) of a pose from this prior."""
        return difference(pose, self.pose)

    def weighed(self, pose: Planar) -> Matrix:
        """Return the prior's information (3, 3) at a pose, reduced by the heavy tails."""
        squared = self._squared(pose)
        weight = [min((self.freedom + n) / (self.freedom + squared[n]), 1.0) for n in (2, 1)]
        root = np.sqrt([weight[0], weight[0], weight[1]])
        return self.information * root[:, None] * root

    def cost_at(self, pose: Planar) -> float:
        """Return the negative logarithm of the prior at a pose, relative to its peak."""
        tails = (student_cost(each, n, self.freedom) for n, each in self._squared(pose).items())
        return float(sum(tails)) - float(np.log(self.probability))

    def cost_least(self, information: Matrix) -> float:
        """Return the cost of this motion at its peak."""
        return -float(np.log(self.probability)) - self.spread_after(information)

    def spread_after(self, information: Matrix) -> float:
        """Return the logarithm of the share of the prior that a scan's information (3, 3) leaves.

        It is that of Laplace's approximation of a motion's evidence (MacKay, "Information Theory,
        Inference, and Learning Algorithms", 2003, ch. 28): a motion that predicts a wider range
        of poses is less likely where the scan measures one of them.
        """
        left = np.eye(3) + self.covariance @ information
        return -0.5 * float(np.linalg.slogdet(left)[1])

    def reach(self, centre: Planar) -> Planar:
        """Return how far (3,) from `centre` a pose may be."""
        return np.abs(self.off(centre)) + _REACH_SIGMAS * np.sqrt(np.diag(self.covariance))

    def costs(self, centre: Planar, offsets_m: Planar, turns: Planar) -> NDArray[np.float64]:
        """Return the negative logarithms (A, K) of the prior at poses around `centre`.

        They are turned by `turns` (A,) and moved by `offsets_m` (K, 2).
        """
        sigma = np.sqrt(np.diag(self.covariance))
        off = -self.off(centre)
        near = np.sum((offsets_m - off[:2]) ** 2, axis=1) / max(sigma[0], sigma[1]) ** 2
        turned = ((turns - off[2]) / sigma[2]) ** 2
        tails = student_cost(near, 2, self.freedom) + student_cost(turned, 1, self.freedom)[:, None]
        return np.asarray(tails - np.log(self.probability))

    def _squared(self, pose: Planar) -> dict[int, float]:
        """Return the squared normalised deviations of position and heading by number of axes."""
        off, information = self.off(pose), self.information
        position = float(off[:2] @ information[:2, :2] @ off[:2])
        return {2: position, 1: float(off[2] ** 2 * information[2, 2])}


def difference(pose: Planar, other: Planar) -> Planar:
    """Return the difference (3,) of two poses."""
    off = pose - other
    off[2] = wrap(float(off[2]))
    return off


def is_apart(off: Planar) -> bool:
    """Tell whether poses that differ by `off` (3,) are farther apart than a cost is quadratic."""
    return bool(max(abs(off[0]), abs(off[1])) > _SAME_M or abs(off[2]) > _SAME_RAD)
