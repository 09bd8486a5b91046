"""Pictures of a run in the third person: points, paths and the robot, seen from above one side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.figures import style as look
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

_CEILING_M = 1.6  # what is higher would hide what is below
_SHOWN = 60_000  # points that are drawn at most
_ELEVATION_DEG, _AZIMUTH_DEG = 50.0, -70.0
_PLY_CODES = {"float": "<f4", "double": "<f8", "int": "<i4", "uchar": "u1"}
_ROBOT_RADIUS_M, _ROBOT_HEIGHT_M = 0.18, 0.42  # about a TurtleBot


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Points to draw, in `map`."""

    points: NDArray[np.float64]  # (N, 3)
    colors: NDArray[np.float64] | str  # (N, 3) red green blue in [0, 1], or one for all
    label: str = ""


def read_ply(path: Path) -> NDArray[Any]:
    """Return the vertices of a binary PLY as our own maps are written, a field per property."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in header.decode().splitlines()]
    fields = [(words[2], _PLY_CODES[words[1]]) for words in lines if words[0] == "property"]
    return np.frombuffer(body, np.dtype(fields))


def modules_of(path: Path) -> list[str]:
    """Return the names of the modules that gave the points of a map, by their numbers."""
    lines = path.read_bytes().partition(b"end_header")[0].decode().splitlines()
    return [line.split(maxsplit=3)[3] for line in lines if line.startswith("comment module")]


def cloud_of(rows: NDArray[Any], colors: NDArray[np.float64] | str, label: str = "") -> Cloud:
    """Return the points of PLY vertices."""
    points = np.column_stack([rows[axis] for axis in "xyz"]).astype(float)
    return Cloud(points=points, colors=colors, label=label)


def draw_third_person(
    path: Path,
    clouds: Sequence[Cloud],
    paths: Mapping[str, Trajectory],
    robots: Sequence[NDArray[np.float64]] = (),
) -> None:
    """Write a PNG of clouds, paths and robots (their T_map_base), seen from above one side."""
    from mpl_toolkits.mplot3d import Axes3D  # noqa: F401  # registers the projection

    figure = look.new_figure(look.WIDTH_IN, 4.2)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    shown = [_thinned(cloud) for cloud in clouds]
    for cloud in shown:
        color = cloud.colors
        if isinstance(color, str):
            axes.plot([], [], ".", color=color, label=cloud.label or None)
        axes.scatter(*cloud.points.T, s=0.6, c=color, linewidths=0, depthshade=False, zorder=1)
    for number, (name, one) in enumerate(paths.items()):
        color = (look.INK, *look.PALETTE[2:])[number % 5]  # the first two are the modules'
        axes.plot(*one.positions_m.T, color=color, linewidth=2.0, label=name, zorder=3)
    for T_map_base in robots:
        _draw_robot(axes, T_map_base)
    _frame(axes, [*(cloud.points for cloud in shown), *(one.positions_m for one in paths.values())])
    figure.legend(loc="outside lower center", ncols=3, fontsize=11, frameon=False)
    look.save(figure, path)


def _thinned(cloud: Cloud) -> Cloud:
    """Return what is below the ceiling, of many points an even part."""
    below = np.flatnonzero(cloud.points[:, 2] < _CEILING_M)
    kept = below[:: max(1, len(below) // _SHOWN)]
    colors = cloud.colors if isinstance(cloud.colors, str) else cloud.colors[kept]
    return Cloud(points=cloud.points[kept], colors=colors, label=cloud.label)


def _draw_robot(axes: Any, T_map_base: NDArray[np.float64]) -> None:
    """Draw a cylinder, and a stroke to where it looks."""
    angle, height_m = np.meshgrid(np.linspace(0, 2 * np.pi, 25), [0.0, _ROBOT_HEIGHT_M])
    around = np.stack([np.cos(angle), np.sin(angle), height_m / _ROBOT_RADIUS_M], axis=-1)
    body = se3.apply(T_map_base, _ROBOT_RADIUS_M * around.reshape(-1, 3)).reshape(2, -1, 3)
    axes.plot_surface(*np.moveaxis(body, -1, 0), color=look.INK, alpha=0.9, zorder=4)
    ahead = np.array([[0.0, 0.0, _ROBOT_HEIGHT_M], [0.6, 0.0, _ROBOT_HEIGHT_M]])
    axes.plot(*se3.apply(T_map_base, ahead).T, color=look.INK, linewidth=1.5, zorder=5)


def _frame(axes: Any, parts: Sequence[NDArray[np.float64]]) -> None:
    """Fit the axes to what is drawn; a few stray points do not count."""
    points = np.concatenate([part for part in parts if len(part)])
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_zlim(low[2], high[2])
    axes.set_box_aspect(high - low, zoom=1.25)
    axes.view_init(_ELEVATION_DEG, _AZIMUTH_DEG)
    axes.set_xlabel("x [m]", fontsize=10)
    axes.set_ylabel("y [m]", fontsize=10)
    axes.set_zticks([])
    axes.tick_params(labelsize=9)
    axes.grid(visible=False)
