"""Localizability: how well the geometry constrains a pose, per direction.

Planes constrain a pose along their normals only (Gelfand et al., "Geometrically Stable Sampling for
the ICP Algorithm", 3DIM 2003). One wall leaves three directions unconstrained, a bare corridor one.
In these the registration follows noise, so its information there is removed, and the motion
prediction is used ("solution remapping", Zhang, Kaess and Singh, ICRA 2016).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

Doubles = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Localizability:
    """Ratios from 0 (unconstrained) to about 1 (normals in all directions), and their directions.

    A direction is a motion about the points' centre, in units of the points' displacement.
    """

    ratios: Doubles  # (6,), rising
    directions: Doubles  # (6, 6), one per column: the motion [m, m] of the points
    scale: Doubles  # (6, 6): takes a twist (se3.log order) of the points' frame to such a motion

    def held(self, ratio_min: float) -> Doubles:
        """Return the projection (6, 6) of a twist on the directions that are not weak."""
        strong = self.directions[:, self.ratios >= ratio_min]
        return np.asarray(np.linalg.solve(self.scale, strong @ strong.T @ self.scale))

    def information(self, noise_m: float, ratio_min: float) -> Doubles:
        """Return the information (6, 6) of a twist, by the deviation of points seen from all sides.

        A direction has as much of it as normals face it, one below `ratio_min` none.
        """
        seen = np.where(self.ratios >= ratio_min, np.minimum(self.ratios, 1.0), 0.0)
        shape = (self.directions * seen) @ self.directions.T
        return np.asarray(self.scale.T @ shape @ self.scale / noise_m**2)

    def reach_m(self, covariance: Doubles, ratio_min: float) -> float:
        """Return the points' deviation by a pose's covariance (6, 6) along what is not weak."""
        seen = self.directions[:, self.ratios >= ratio_min].T @ self.scale
        moved = seen @ covariance @ seen.T
        return float(np.sqrt(max(np.linalg.eigvalsh(moved).max(initial=0.0), 0.0)))


def localizability(
    points: NDArray[np.floating], normals: NDArray[np.floating], weights: NDArray[np.floating]
) -> Localizability:
    """Return how points (N, 3) [m] with unit normals (N, 3) and weights (N,) constrain a pose."""
    # Centre and moments of inertia of the points.
    total = max(float(weights.sum()), 1e-12)
    centre = (weights @ points) / total
    offsets = (points - centre).astype(np.float64)
    moments = offsets.T @ (offsets * weights[:, None]) / total
    inertia = np.trace(moments) * np.eye(3) - moments
    # Root mean square displacement of the points per radian, about each axis.
    squares, axes = np.linalg.eigh(inertia)
    turn_m = axes @ np.diag(np.sqrt(np.maximum(squares, 1e-12))) @ axes.T  # [m/rad], symmetric
    # Derivative of the plane residual n' x by displacement (Gelfand et al., Sec. 3), with
    # rotations in units of displacement.
    turns = np.linalg.solve(turn_m, np.cross(offsets, normals).T).T
    rows = np.concatenate([normals, turns], axis=1)
    shape = 3.0 * rows.T @ (rows * weights[:, None]) / total
    ratios, directions = np.linalg.eigh(shape)
    return Localizability(
        ratios=np.maximum(ratios, 0.0), directions=directions, scale=_motion_of(centre, turn_m)
    )


def _motion_of(centre: NDArray[np.floating], turn_m: Doubles) -> Doubles:
    scale = np.eye(6)
    scale[:3, 3:] = -se3.hat(centre)
    scale[3:, 3:] = turn_m
    return scale
