"""Point-to-plane registration of a depth image with keyframes, by projection.

Gauss-Newton (Chen and Medioni 1991; projective data association as in KinectFusion, Newcombe et al.
2011): each point is compared with the plane that a keyframe has in the cell to which the point
projects. Several keyframes are used at once, so that the pose agrees with all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from ..camera_certainty import CORRELATION
from ..degeneracy import Localizability, localizability
from ..model_error import squared, summed
from .keyframe import FACING_COS, SurfaceKeyframe
from .surface import Doubles, Floats, Grid, Surface

_ITERATIONS_MAX = 12
_GATE_M = (0.15, 0.03)  # largest residuals, in the first and last iteration
_GATE_SHRINK = 0.7
_KERNEL_SIGMAS = 12.0  # threshold of the robust kernel
_SURFACE_SIGMA_M = 0.001  # smallest standard deviation: roughness of surfaces
_STEP_MIN = 1e-4  # m and rad: converged
_POINTS_MIN = 100
_BLOCKS = 4  # per image width, in which residuals are summed: fewer err together less


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Points of one depth image for registration."""

    points: Floats  # (N, 3) [m], cam
    normals: Floats  # (N, 3), cam, smooth
    sigmas_m: Floats  # (N,) standard deviation across the plane
    blocks: NDArray[np.int64]  # (N,) of the image

    def __len__(self) -> int:
        return len(self.points)

    def localizability(self, rows: NDArray[np.bool_] | None = None) -> Localizability:
        """Return how well the samples, or those of `rows` (N,), constrain the camera's pose."""
        chosen = slice(None) if rows is None else rows
        return localizability(
            self.points[chosen], self.normals[chosen], self.sigmas_m[chosen] ** np.float32(-2)
        )

    def thinned(self, count: int) -> Samples:
        """Return about `count` of the samples, spread evenly."""
        rows = slice(None, None, max(1, len(self) // count))
        return Samples(
            self.points[rows], self.normals[rows], self.sigmas_m[rows], self.blocks[rows]
        )


def samples_of(surface: Surface, grid: Grid) -> Samples:
    """Return the surface's points in every second row and column."""
    valid = surface.valid.reshape(grid.height, grid.width)
    chosen = np.zeros_like(valid)
    chosen[1::2, 1::2] = True
    rows = np.flatnonzero(valid & chosen)
    depth_m = 1.0 / surface.disparity[rows]
    sigmas_m = depth_m * surface.planes[rows, 3] * np.float32(surface.noise_per_m)
    row, column = np.divmod(rows, grid.width)
    side = grid.width / _BLOCKS
    return Samples(
        grid.rays[rows] * depth_m[:, None],
        surface.smooth_normals(grid)[rows],
        np.sqrt(sigmas_m**2 + np.float32(_SURFACE_SIGMA_M**2)),
        np.asarray(_BLOCKS * (row // side) + column // side, np.int64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class CameraPrior:
    """The predicted pose of the camera, with its information."""

    T_local_cam: se3.Transform
    information: Doubles  # (6, 6) of se3.log order, cam


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceRegistration:
    """A registered pose and its quality."""

    T_local_cam: se3.Transform
    information: Doubles  # (6, 6) of se3.log order, cam: of the image, 0 along weak directions
    common_ratio: float  # by how much residuals pull more than independent ones of their sigma
    misfit: float  # mean square of the residuals [sigma^2]
    T_keyframe_cam: Doubles  # (K, 4, 4) from each keyframe
    localizability: Localizability  # by the matched points, cam
    matched_ratio: float  # share of the points in view that match, over all keyframes
    seen: int  # points that any keyframe shows
    matched: int  # of these, the points that lie on planes of any


def register(
    samples: Samples,
    prior: CameraPrior,
    keyframes: Sequence[SurfaceKeyframe],
    grid: Grid,
    *,
    weak_ratio: float,
) -> SurfaceRegistration | None:
    """Return the camera's pose by registration with keyframes; None if too few points match."""
    held = samples.localizability().held(weak_ratio)
    T_local_cam, gate_m = prior.T_local_cam, _GATE_M[0]
    for _ in range(_ITERATIONS_MAX):
        system = _System(samples, keyframes, T_local_cam, gate_m=gate_m, grid=grid)
        if system.is_matched.sum() < _POINTS_MIN:
            return None
        off = se3.log(se3.inverse(prior.T_local_cam) @ T_local_cam)
        information = held.T @ system.information @ held + prior.information
        pull = held.T @ system.pull - prior.information @ off
        step = np.asarray(np.linalg.solve(information, pull), np.float64)
        T_local_cam = T_local_cam @ se3.exp(step)
        if gate_m == _GATE_M[1] and np.abs(step).max() < _STEP_MIN:
            break
        gate_m = max(_GATE_SHRINK * gate_m, _GATE_M[1])
    matched = samples.localizability(system.is_matched)
    held = matched.held(weak_ratio)
    information = held.T @ system.information @ held
    return SurfaceRegistration(
        T_local_cam,
        information,
        system.common_ratio(),
        system.misfit(),
        np.stack([keyframe.T_cam_local @ T_local_cam for keyframe in keyframes]),
        matched,
        matched_ratio=system.pairs_matched / max(system.pairs_seen, 1),
        seen=int(system.is_seen.sum()),
        matched=int(system.is_matched.sum()),
    )


class _System:
    """The normal equations of the residuals at one pose, for a twist in cam."""

    def __init__(
        self,
        samples: Samples,
        keyframes: Sequence[SurfaceKeyframe],
        T_local_cam: se3.Transform,
        *,
        gate_m: float,
        grid: Grid,
    ) -> None:
        self.information, self.pull = np.zeros((6, 6)), np.zeros(6)
        self._blocks = samples.blocks
        self._parts: list[tuple[Floats, Floats, Floats, NDArray[np.intp]]] = []  # of keyframes
        self.pairs_seen, self.pairs_matched = 0, 0  # of a point and a keyframe
        self.is_seen, self.is_matched = np.zeros((2, len(samples)), np.bool_)
        for keyframe in keyframes:
            self._add(samples, keyframe, keyframe.T_cam_local @ T_local_cam, gate_m, grid)
        self.information /= CORRELATION
        self.pull /= CORRELATION

    def common_ratio(self) -> float:
        """Return how much stronger the image's blocks pull than independent points would.

        The mean over all directions; blocks count less the six that the pose takes.
        """
        pulls = [weights * residuals * rows.T for weights, residuals, rows, _ in self._parts]
        blocks = self._blocks[np.concatenate([points for *_, points in self._parts])]
        together = squared(summed(np.hstack(pulls), blocks), self.information * CORRELATION)
        count = int(np.count_nonzero(np.bincount(blocks)))
        return together / 6 * count / max(count - 6, 1)

    def misfit(self) -> float:
        """Return the mean square of the residuals [sigma^2], robust."""
        squares = (float(weights @ residuals**2) for weights, residuals, *_ in self._parts)
        return sum(squares) / self.pairs_matched

    def _add(
        self,
        samples: Samples,
        keyframe: SurfaceKeyframe,
        T_key_cam: se3.Transform,
        gate_m: float,
        grid: Grid,
    ) -> None:
        residuals, normals, seen, same = compare(samples, keyframe, T_key_cam, gate_m, grid)
        # Derivative of n' (T exp(xi) p) - d by the twist xi: (n', (p x n)') in cam.
        rows = np.flatnonzero(same)
        normals_cam = normals[rows] @ T_key_cam[:3, :3].astype(np.float32)
        jacobian = np.concatenate([normals_cam, _cross(samples.points[rows], normals_cam)], axis=1)
        sigmas_m, residuals = samples.sigmas_m[rows], residuals[rows]
        # Robust weights (Geman and McClure), then the normal equations J' W J and -J' W r.
        kernel = 1.0 / (1.0 + (residuals / (_KERNEL_SIGMAS * sigmas_m)) ** 2) ** 2
        weights = np.asarray(kernel / sigmas_m**2, np.float32)
        weighted = jacobian * weights[:, None]
        self.information += (jacobian.T @ weighted).astype(np.float64)
        self.pull -= (weighted.T @ residuals).astype(np.float64)
        self._parts.append((weights, residuals, jacobian, rows))
        self.is_seen |= seen
        self.is_matched |= same
        self.pairs_seen += int(seen.sum())
        self.pairs_matched += len(rows)


def compare(
    samples: Samples,
    keyframe: SurfaceKeyframe | Surface,
    T_key_cam: se3.Transform,
    gate_m: float,
    grid: Grid,
) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return residuals (N,) [m], normals (N, 3), and whether points are in view and match (N,)."""
    T = T_key_cam.astype(np.float32)
    # Projective data association: the cell of the keyframe's grid that a point projects to.
    points = samples.points @ T[:3, :3].T + T[:3, 3]
    cells, in_view = grid.index(points)
    planes = keyframe.planes[cells]
    normals = planes[:, :3]
    # Signed distance to the plane; a match needs a small one and similar normals.
    residuals = np.einsum("ij,ij->i", normals, points) - planes[:, 3]
    seen = in_view & (planes[:, 3] > 0)
    facing = np.einsum("ij,ij->i", normals, samples.normals @ T[:3, :3].T)
    return residuals, normals, seen, seen & (np.abs(residuals) < gate_m) & (facing > FACING_COS)


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of rows; several times faster than np.cross."""
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    y = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    z = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.stack([x, y, z], axis=1)
