"""A wide search for a scan in the map: branch and bound over a score pyramid.

After Hess et al., "Real-time loop closure in 2D LIDAR SLAM" (ICRA 2016), section V-B: a node of
the search tree is a rotation and a square of shifts; its bound is the score in a grid that holds,
per cell, the maximum over the square that begins there. Each level is searched in one batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.planar import Planar, wrap

from .field import LikelihoodField

_CELL_M = 0.1  # the finest shift, at least; the refinement starts from there
_LEVELS = 4  # shifts of 0.1, 0.2, 0.4, 0.8 m
_POINTS = 100  # of the scan; more do not change the result
_BEAM = 32  # nodes of the first descent, whose best score bounds the second
_SCORE_MIN = 0.5  # with less, a pose does not fit
_NODES_MAX = 4000  # best nodes kept per level
_APART_M, _APART_RAD = 0.5, 0.15  # and this far away from better ones, is another one
_POSES_MAX = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Found:
    """A pose that fits."""

    T_submap_base: Planar
    score: float  # 0 to 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Nodes:
    """Nodes of one level: turn, shift of x and of y [cells]."""

    turn: NDArray[np.int64]
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    bound: NDArray[np.float32]

    def at(self, index: NDArray[np.int64]) -> _Nodes:
        return _Nodes(
            turn=self.turn[index], x=self.x[index], y=self.y[index], bound=self.bound[index]
        )


class WideSearch:
    """Searches one likelihood field."""

    def __init__(self, field: LikelihoodField) -> None:
        pad = 2 ** (_LEVELS - 1)
        factor = max(1, round(_CELL_M / field.resolution_m))
        self._cell_m = factor * field.resolution_m
        grid, self._origin = field.pooled(factor)
        self._origin = self._origin - pad
        grid = np.pad(grid, ((pad, 1), (pad, 1)))
        self._pyramid = [grid]
        for level in range(1, _LEVELS):
            half = 2 ** (level - 1)
            kernel = np.zeros((2 * half + 1, 2 * half + 1), np.uint8)
            kernel[[half, half, -1, -1], [half, -1, half, -1]] = 1  # the cell, those at `half`
            above = cv2.dilate(grid, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
            grid = np.asarray(above, dtype=np.float32)
            self._pyramid.append(grid)

    def find(
        self,
        points_base: NDArray[np.float64],
        around: Planar,
        *,
        window_m: float,
        window_rad: float,
        alike_ratio: float,
    ) -> list[Found]:
        """Return the poses near `around` where points (N, 2) [m] fit, the best first."""
        points = points_base[:: max(1, len(points_base) // _POINTS)]
        radius_m = float(np.median(np.linalg.norm(points, axis=1))) + 0.1
        step_rad = self._cell_m / radius_m
        count = int(np.ceil(window_rad / step_rad))
        yaws = around[2] + np.arange(-count, count + 1) * step_rad
        c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x, y = points.T
        local = np.stack([c * x - s * y, s * x + c * y], axis=-1) + around[:2]
        cells = np.floor(local / self._cell_m).astype(np.int32) - self._origin.astype(np.int32)
        roots = self._roots(cells, window_m)
        first = self._descend(cells, roots, 0.0, _BEAM)
        limit = max(_SCORE_MIN, alike_ratio * float(first.bound.max(initial=0.0)))
        leaves = self._descend(cells, roots, limit, _NODES_MAX)
        return self._peaks(leaves, yaws, around)

    def _roots(self, cells: NDArray[np.int32], window_m: float) -> _Nodes:
        size = 2 ** (_LEVELS - 1)
        shifts = np.arange(-int(window_m / self._cell_m), int(window_m / self._cell_m) + 1, size)
        turn, x, y = (
            part.ravel()
            for part in np.meshgrid(np.arange(len(cells)), shifts, shifts, indexing="ij")
        )
        return self._scored(cells, turn, x, y, _LEVELS - 1)

    def _descend(self, cells: NDArray[np.int32], nodes: _Nodes, limit: float, most: int) -> _Nodes:
        """Return the leaves under the `most` best nodes per level, scored at least `limit`."""
        for level in range(_LEVELS - 1, -1, -1):
            if level < _LEVELS - 1:
                size = 2**level
                dx, dy = np.array([0, size, 0, size]), np.array([0, 0, size, size])
                nodes = self._scored(
                    cells,
                    np.repeat(nodes.turn, 4),
                    (nodes.x[:, None] + dx).ravel(),
                    (nodes.y[:, None] + dy).ravel(),
                    level,
                )
            kept = np.flatnonzero(nodes.bound >= limit)
            if len(kept) > most:
                kept = np.sort(kept[np.argsort(-nodes.bound[kept], kind="stable")[:most]])
            nodes = nodes.at(kept)
        return nodes

    def _scored(
        self,
        cells: NDArray[np.int32],
        turn: NDArray[np.int64],
        x: NDArray[np.int64],
        y: NDArray[np.int64],
        level: int,
    ) -> _Nodes:
        grid = self._pyramid[level]
        rows, columns = grid.shape
        bound = np.empty(len(turn), np.float32)
        for start in range(0, len(turn), 4096):
            part = slice(start, start + 4096)
            at = cells[turn[part]]
            column = np.clip(at[..., 0] + x[part, None].astype(np.int32), 0, columns - 1)
            row = np.clip(at[..., 1] + y[part, None].astype(np.int32), 0, rows - 1)
            bound[part] = np.take(grid.reshape(-1), row * columns + column).mean(axis=1)
        return _Nodes(turn=turn, x=x, y=y, bound=bound)

    def _peaks(self, leaves: _Nodes, yaws: NDArray[np.float64], around: Planar) -> list[Found]:
        """Return the poses of the best leaves that are apart."""
        peaks: list[Found] = []
        while len(leaves.turn) and len(peaks) < _POSES_MAX:
            best = int(np.argmax(leaves.bound))
            yaw, x, y = float(yaws[leaves.turn[best]]), leaves.x[best], leaves.y[best]
            pose = np.array([*(around[:2] + self._cell_m * np.array([x, y])), wrap(yaw)])
            peaks.append(Found(T_submap_base=pose, score=float(leaves.bound[best])))
            away_m = self._cell_m * np.hypot(leaves.x - x, leaves.y - y)
            away_rad = np.abs(np.remainder(yaws[leaves.turn] - yaw + np.pi, 2 * np.pi) - np.pi)
            leaves = leaves.at(np.flatnonzero((away_m > _APART_M) | (away_rad > _APART_RAD)))
        return peaks
