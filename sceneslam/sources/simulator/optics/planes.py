"""Intersection of pixels with panels' planes in closed form: 1 / depth is affine in the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.places.place import Panel
from sceneslam.types.se3 import Transform

Values = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelPoints:
    """The points on panels that pixels show; all arrays have the pixels' shape."""

    depth_m: Values
    u: Values  # along the panel's edges, 0 to 1
    v: Values
    slope: Values  # cosine of the angle of incidence, times the length of the ray's direction


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """The planes of all panels in the frame of one camera pose."""

    table: Values  # (12, panels + 1)

    def at(self, panels: NDArray[np.int32], directions_cam: Values) -> PanelPoints:
        """Return the points that pixels show, by their panels (...) and directions (..., 3), z = 1.

        The point is X = corner + u e_u + v e_v = z d. With the dual basis g of (e_u, e_v, n):
        1 / z = g_n d / g_n corner, u = z g_u d - g_u corner.
        """
        x, y = directions_cam[..., 0], directions_cam[..., 1]
        # 1 / z = (g_n d) / (g_n corner).
        inverse = self._dot(0, panels, x, y)
        depth_m = np.reciprocal(inverse)
        # u = z (g_u d) - g_u corner, and v alike.
        u = self._dot(3, panels, x, y)
        u *= depth_m
        u += np.take(self.table[9], panels)
        v = self._dot(6, panels, x, y)
        v *= depth_m
        v += np.take(self.table[10], panels)
        slope = np.abs(inverse)
        slope *= np.take(self.table[11], panels)
        return PanelPoints(depth_m=depth_m, u=u, v=v, slope=slope)

    def _dot(self, row: int, panels: NDArray[np.int32], x: Values, y: Values) -> Values:
        total = np.take(self.table[row], panels)
        total *= x
        part = np.take(self.table[row + 1], panels)
        part *= y
        total += part
        total += np.take(self.table[row + 2], panels)
        return np.asarray(total)


class Planes:
    """The planes of all panels, and of the sky: a distant panel after the last index."""

    def __init__(self, panels: Sequence[Panel]) -> None:
        self.count = len(panels)
        self._corners_m = np.stack([panel.corner_m for panel in panels])
        across = np.stack([panel.edge_u_m for panel in panels])
        down = np.stack([panel.edge_v_m for panel in panels])
        basis = np.stack([across, down, np.cross(across, down)], axis=2)
        self._duals = np.linalg.inv(basis)  # (panels, 3, 3), rows g_u, g_v, g_n

    def seen_from(self, T_gt_cam: Transform) -> Sight:
        """Return the planes in the frame of a camera at T_gt_cam (4, 4) [m]."""
        corners_m = (self._corners_m - T_gt_cam[:3, 3]) @ T_gt_cam[:3, :3]
        duals = self._duals @ T_gt_cam[:3, :3]
        offsets = np.einsum("pij,pj->pi", duals, corners_m)
        distance = np.where(np.abs(offsets[:, 2]) < 1e-9, 1e-9, offsets[:, 2])
        table = np.zeros((12, self.count + 1), np.float32)
        table[0:3, :-1] = (duals[:, 2] / distance[:, None]).T
        table[3:6, :-1], table[6:9, :-1] = duals[:, 0].T, duals[:, 1].T
        table[9:11, :-1] = -offsets[:, :2].T
        table[11, :-1] = np.abs(distance) / np.linalg.norm(duals[:, 2], axis=1)
        table[2, -1] = 1e-3
        return Sight(table=table)
