"""A scan as points on surfaces, with the directions in which each one constrains the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Planar, rotation

_SPAN_M = 0.2  # neighbours along the scan within this distance form a point's surface
_NEIGHBOURS_MIN = 2  # one point alone does not define a surface
_SPREAD_MIN_M2 = 1e-6  # one point has any direction
_BLOB_RATIO = (0.04, 0.24)  # least to largest variance: up to the first a line, from the second not

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfacePoints:
    """Points with their shape matrix: n n' for a wall with normal n, I for a post.

    Their components lie one after the other in memory, as axes of two and three are slow.
    """

    points: Array  # (N, 2) [m], frame as in the owner's name
    shape: Array  # (N, 3): xx, xy, yy; 0 with too few neighbours
    weight: Array  # (N,) [1/m^2], inverse variance of the range
    normal_variance: Array  # (N,) [rad^2], of the surface's direction
    spacing_m: Array  # (N,), between neighbouring beams
    noise_ratio: float = 1.0  # of the range's deviation, to the one that was expected

    def __len__(self) -> int:
        return len(self.points)

    def with_noise(self, ratio: float) -> SurfacePoints:
        """Return the points with `ratio` times the standard deviation."""
        return replace(self, weight=self.weight / ratio**2, noise_ratio=self.noise_ratio * ratio)

    def moved(self, T_a_b: Planar) -> SurfacePoints:
        """Return the points (N, 2) [m] of frame b in frame a."""
        R = rotation(T_a_b[2])
        c, s = R[0, 0], R[1, 0]
        xx, xy, yy = self.shape.T
        shape = np.array(
            [
                c * c * xx - 2 * c * s * xy + s * s * yy,
                c * s * (xx - yy) + (c * c - s * s) * xy,
                s * s * xx + 2 * c * s * xy + c * c * yy,
            ]
        ).T
        return replace(self, points=(R @ self.points.T).T + T_a_b[:2], shape=shape)


def joined(parts: Sequence[SurfacePoints]) -> SurfacePoints:
    """Return the points of all parts."""
    return SurfacePoints(
        points=np.concatenate([part.points for part in parts]),
        shape=np.concatenate([part.shape for part in parts]),
        weight=np.concatenate([part.weight for part in parts]),
        normal_variance=np.concatenate([part.normal_variance for part in parts]),
        spacing_m=np.concatenate([part.spacing_m for part in parts]),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanSurfaceReader:
    """Reads the scans of one laser.

    A range's standard deviation is noise_m + noise_per_m * range^2; noise_per_m is 0 for a laser,
    and describes a triangulating depth camera.
    """

    T_base_laser: se3.Transform
    range_max_m: float
    noise_m: float
    noise_per_m: float

    def read(self, scan: LaserScan) -> SurfacePoints:
        """Return a scan's returns in base's xy plane, in the order of the beams."""
        ranges = scan.ranges_m.astype(np.float64)
        limit = min(self.range_max_m, scan.range_max_m)
        beam = np.flatnonzero(np.isfinite(ranges) & (ranges > scan.range_min_m) & (ranges <= limit))
        r, angle = ranges[beam], scan.angles_rad[beam].astype(np.float64)
        points_laser = np.array([r * np.cos(angle), r * np.sin(angle)])
        points_base = (self.T_base_laser[:2, :2] @ points_laser + self.T_base_laser[:2, 3:]).T
        spacing = np.maximum(r * abs(scan.angle_step_rad), 1e-4)
        weight = 1.0 / (self.noise_m + self.noise_per_m * r * r) ** 2
        shape, spread_m2 = _shape(points_base, spacing)
        return SurfacePoints(
            points=points_base,
            shape=shape,
            weight=weight,
            normal_variance=1.0 / (weight * np.maximum(spread_m2, _SPREAD_MIN_M2)),
            spacing_m=spacing,
        )


def _shape(points: Array, spacing_m: Array) -> tuple[Array, Array]:
    """Return each point's shape (N, 3) from its neighbours along the scan, and their spread (N,).

    The spread is the sum of the squared distances [m^2] from their mean: the direction of a line
    through them has the variance noise^2 / spread, as the slope of a linear regression.
    """
    count = len(points)
    if count == 0:
        return np.zeros((0, 3)), np.zeros(0)
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # A jump between neighbours is the edge of an object: surfaces end there.
    jump = step > np.maximum(_SPAN_M, 3.0 * np.minimum(spacing_m[1:], spacing_m[:-1]))
    index = np.arange(count)
    first = np.maximum.accumulate(np.where(np.r_[True, jump], index, 0))
    last = np.minimum.accumulate(np.where(np.r_[jump, True], index, count)[::-1])[::-1]
    half = np.clip(np.ceil(_SPAN_M / spacing_m), 2, 60).astype(np.int64)
    low, high = np.maximum(index - half, first), np.minimum(index + half, last) + 1
    x, y = (points - points.mean(axis=0)).T
    sums = np.cumsum(np.column_stack([x, y, x * x, x * y, y * y]), axis=0)
    sums = np.vstack([np.zeros(5), sums])
    number = high - low
    mean_x, mean_y, xx, xy, yy = ((sums[high] - sums[low]) / number[:, None]).T
    xx, xy, yy = xx - mean_x**2, xy - mean_x * mean_y, yy - mean_y**2
    shape = _shape_of_spread(xx, xy, yy)
    spread_m2 = number * (xx + yy)
    shape[(number < _NEIGHBOURS_MIN) | (spread_m2 < _SPREAD_MIN_M2)] = 0.0
    return shape, spread_m2


def _shape_of_spread(xx: Array, xy: Array, yy: Array) -> Array:
    root = np.hypot(0.5 * (xx - yy), xy)
    largest = 0.5 * (xx + yy) + root
    least = np.maximum(0.5 * (xx + yy) - root, 0.0)
    low, high = _BLOB_RATIO
    blob = np.clip((least / np.maximum(largest, 1e-12) - low) / (high - low), 0.0, 1.0)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)  # along the surface
    c, s = np.cos(angle), np.sin(angle)
    return np.array([s * s + blob * c * c, (blob - 1.0) * s * c, c * c + blob * s * s]).T
