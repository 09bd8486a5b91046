"""The map in a third-person view: its coloured points, seen obliquely from above."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.figures import style as look
from sceneslam.types.maps import HybridMap
from sceneslam.types.run import RunResult

_SIZE_WH = (720, 480)  # [px] of the picture
_AZIMUTH_RAD, _ELEVATION_RAD = (
    np.deg2rad(-115.0),
    np.deg2rad(42.0),
)  # of the viewer, seen from the map
_DISTANCE = 3.4  # from the map's centre, in radii of the sphere around the map
_FILLED = 0.9  # of the picture's width or height
_PAPER = 0.94  # grey, so that dark points are seen on a dark page, too
_POINTS_MIN = 500  # with fewer, no view is drawn
_INSIDE = (1.0, 99.0)  # percentiles of the points: strays must not shrink the rest
_POINT_PX = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Viewer:
    """A pinhole camera whose image contains the map."""

    position_map: NDArray[np.float64]  # (3,) [m]
    R_map_view: NDArray[np.float64]  # columns: right, down, forward
    focal_px: float = 1.0
    centre_px: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))

    def project(self, points_map: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (N, 3): column and row [px], and depth [m]; NaN behind the viewer."""
        points_view = (points_map - self.position_map) @ self.R_map_view
        depth_m = np.where(points_view[:, 2] > 0.1, points_view[:, 2], np.nan)
        pixels = self.focal_px * points_view[:, :2] / depth_m[:, None] + self.centre_px
        return np.column_stack([pixels, depth_m])


def draw_view(result: RunResult) -> Any:
    """Return the map and the path as a viewer above sees them; None where there are few points."""
    points_map = result.map.points.points.astype(float)
    if len(points_map) < _POINTS_MIN or len(result.trajectory) < 2:
        return None
    viewer = _viewer(points_map)
    modules = look.module_colors(result)
    figure = look.new_figure(height_in=look.WIDTH_IN * _SIZE_WH[1] / _SIZE_WH[0] + 0.5)
    axes = figure.add_subplot()
    axes.imshow(_picture(viewer, points_map, _colors(result.map, modules)), interpolation="nearest")
    path = viewer.project(result.trajectory.positions_m)
    given = np.array(result.modules, dtype=object)
    for key in dict.fromkeys(result.modules):
        shown = (given == key) | np.append((given == key)[1:], False)
        line = np.where(shown[:, None], path[:, :2], np.nan)
        color = modules.get(key, look.BRIDGED)
        axes.plot(*line.T, color=color, linewidth=2.0, label=key or "bridged")
    axes.plot(*path[0, :2], "o", color=look.INK, markersize=6, label="start")
    axes.plot(*path[-1, :2], "s", color=look.INK, markersize=6, label="end")
    axes.set_xlim(0, _SIZE_WH[0])
    axes.set_ylim(_SIZE_WH[1], 0)
    axes.axis("off")
    figure.legend(loc="outside lower center", ncols=4, fontsize=11, frameon=False)
    return figure


def _viewer(points_map: NDArray[np.float64]) -> _Viewer:
    """Return a viewpoint from which nearly all points are visible."""
    low, high = np.percentile(points_map, _INSIDE, axis=0)
    centre_map, reach_m = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    away = np.array(
        [
            np.cos(_ELEVATION_RAD) * np.cos(_AZIMUTH_RAD),
            np.cos(_ELEVATION_RAD) * np.sin(_AZIMUTH_RAD),
            np.sin(_ELEVATION_RAD),
        ]
    )
    right = np.cross(-away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(-away, right)
    viewer = _Viewer(
        position_map=centre_map + _DISTANCE * max(reach_m, 0.1) * away,
        R_map_view=np.column_stack([right, down, -away]),
    )
    left_top, right_bottom = np.nanpercentile(viewer.project(points_map)[:, :2], _INSIDE, axis=0)
    extent = np.maximum(right_bottom - left_top, 1e-6)
    focal_px = float((_FILLED * np.array(_SIZE_WH) / extent).min())
    centre_px = np.array(_SIZE_WH) / 2 - focal_px * (left_top + right_bottom) / 2
    return replace(viewer, focal_px=focal_px, centre_px=centre_px)


def _picture(
    viewer: _Viewer, points_map: NDArray[np.float64], colors: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (H, W, 3): the points, the nearest in front."""
    width, height = _SIZE_WH
    picture = np.full((height + _POINT_PX, width + _POINT_PX, 3), _PAPER)
    seen = viewer.project(points_map)
    is_inside = (seen[:, 0] >= 0) & (seen[:, 0] < width) & (seen[:, 1] >= 0) & (seen[:, 1] < height)
    seen, colors = seen[is_inside], colors[is_inside]
    order = np.argsort(-seen[:, 2], kind="stable")
    columns, rows = seen[order, 0].astype(int), seen[order, 1].astype(int)
    for right in range(_POINT_PX):
        for below in range(_POINT_PX):
            picture[rows + below, columns + right] = colors[order]
    return picture[:height, :width]


def _colors(hybrid: HybridMap, modules: dict[str, str]) -> NDArray[np.float64]:
    """Return (N, 3) RGB, 0 to 1: as the camera saw them, else the module's."""
    from matplotlib.colors import to_rgb

    colors = np.zeros((len(hybrid.points.points), 3))
    for number, key in enumerate(hybrid.modules):
        colors[hybrid.point_modules == number] = to_rgb(modules[key])
    seen_bgr = hybrid.points.colors_bgr
    if seen_bgr is not None:
        has_color = seen_bgr.any(axis=1)
        colors[has_color] = seen_bgr[has_color, ::-1] / 255.0
    return colors
