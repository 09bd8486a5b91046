"""Check what a module returns before the bus uses it; checks raise TypeError or ValueError."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import semidefinite
from sceneslam.types.maps import LAYER_TYPES, GridLayer, MapLayers
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.trajectory import Trajectory

_FAR_M = 1e8  # more than twice around the Earth
_SKEW_MAX = 1e-3  # largest deviation of R^T R from the identity; float32 rounds to 1e-6
_NUMBER, _BOOL = "fiu", "biu"  # kinds of types (NumPy)
_Shapes = dict[str, tuple[str | int, ...]]
_SHAPES: dict[str, _Shapes] = {  # of the arrays of each layer
    "points": {"points": ("N", 3), "colors_bgr": ("N", 3)},
    "grid": {"log_odds": ("rows", "columns")},
    "scans": {
        "stamps_ns": ("K",),
        "T_world_laser": ("K", 4, 4),
        "ranges_m": ("K", "B"),
        "angle_min_rad": ("K",),
        "angle_step_rad": ("K",),
    },
    "pose_graph": {
        "stamps_ns": ("N",),
        "T_world_base": ("N", 4, 4),
        "edges": ("M", 2),
        "T_from_to": ("M", 4, 4),
        "information": ("M", 6, 6),
        "is_loop": ("M",),
    },
    "landmarks": {"points": ("N", 3), "first_stamps_ns": ("N",), "sightings": ("N",)},
}
Value = TypeVar("Value")


def checked_tracking(tracking: object, stamp_ns: int) -> Tracking:
    """Return the module's answer to the observation at `stamp_ns`, with copies of its arrays."""
    tracking = _of("track's answer", tracking, Tracking)
    _of("status", tracking.status, TrackingStatus)
    _of("revision", tracking.revision, (int, np.integer))
    _of("can_begin", tracking.can_begin, (bool, np.bool_))
    if tracking.stamp_ns != stamp_ns:
        raise ValueError(f"stamp_ns: expected {stamp_ns}, got {tracking.stamp_ns}")
    if not 0.0 <= tracking.quality_ratio <= 1.0:
        raise ValueError(f"quality_ratio: expected 0 to 1, got {tracking.quality_ratio}")
    if not tracking.inliers >= 0:
        raise ValueError(f"inliers: expected 0 or more, got {tracking.inliers}")
    T_local_base = np.array(tracking.T_local_base, dtype=np.float64)
    _check_shape("T_local_base", T_local_base, (4, 4))
    _check_rigid("T_local_base", T_local_base)
    T_local_base.flags.writeable = False
    return replace(
        tracking,
        T_local_base=T_local_base,
        revision=int(tracking.revision),
        can_begin=bool(tracking.can_begin),
        covariance=_covariance("covariance", tracking.covariance),
        map_covariance=_covariance("map_covariance", tracking.map_covariance),
    )


def checked_trajectory(trajectory: object) -> Trajectory:
    """Return a trajectory whose stamps increase, with copies of its arrays: int64 and float64."""
    trajectory = _of("get_trajectory's answer", trajectory, Trajectory)
    stamps_ns = _of("stamps_ns", trajectory.stamps_ns, np.ndarray)
    if stamps_ns.dtype.kind != "i" or (np.diff(stamps_ns) <= 0).any():
        raise ValueError(f"stamps_ns: expected rising int64, got {stamps_ns.dtype}: {stamps_ns}")
    _check_shape("stamps_ns", stamps_ns, (stamps_ns.size,))
    T_world_base = _of("T_world_base", trajectory.T_world_base, np.ndarray)
    _check_shape("T_world_base", T_world_base, (len(stamps_ns), 4, 4))
    _check_rigid("T_world_base", T_world_base)
    return Trajectory(
        stamps_ns=stamps_ns.astype(np.int64),
        T_world_base=T_world_base.astype(np.float64),
        covariances=_covariances(trajectory.covariances, len(stamps_ns)),
    )


def checked_layers(layers: object) -> MapLayers:
    """Return a map whose arrays have the declared shapes and hold finite numbers."""
    layers = _of("get_map's answer", layers, MapLayers)
    if layers.grid is not None:
        _check_origin(_of("grid", layers.grid, GridLayer).origin_xy_m)
    for name, kind in LAYER_TYPES.items():
        layer = getattr(layers, name)
        if layer is not None:
            _check_layer(name, _of(name, layer, kind), _SHAPES[name])
    if layers.grid is not None and not layers.grid.resolution_m > 0:
        raise ValueError(f"grid.resolution_m: expected above 0, got {layers.grid.resolution_m}")
    if layers.points is not None and layers.points.colors_bgr is not None:
        _check_colors(layers.points.colors_bgr)
    if layers.scans is not None and not layers.scans.cell_m > 0:
        raise ValueError(f"scans.cell_m: expected above 0, got {layers.scans.cell_m}")
    if layers.pose_graph is not None:
        edges, nodes = layers.pose_graph.edges, len(layers.pose_graph.stamps_ns)
        if edges.dtype.kind not in "iu" or ((edges < 0) | (edges >= nodes)).any():
            raise ValueError(f"pose_graph.edges: expected int64, from 0 to {nodes - 1}")
    return layers


def _check_layer(name: str, layer: Any, shapes: _Shapes) -> None:
    sizes: dict[str, int] = {}
    for field in fields(layer):
        value, key = getattr(layer, field.name), f"{name}.{field.name}"
        if field.name not in shapes:
            if not np.isfinite(value).all():
                raise ValueError(f"{key}: expected finite numbers, got {value}")
        elif value is not None:
            array = _of(key, value, np.ndarray)
            if array.ndim == len(shapes[field.name]):
                for axis, size in zip(shapes[field.name], array.shape, strict=True):
                    sizes.setdefault(str(axis), size)
            expected = tuple(a if isinstance(a, int) else sizes.get(a) for a in shapes[field.name])
            _check_shape(key, array, expected)
            if array.dtype.kind not in (_BOOL if field.name == "is_loop" else _NUMBER):
                raise ValueError(f"{key}: expected numbers, got {array.dtype}")
            if not np.isfinite(array).all():
                raise ValueError(f"{key}: it is not finite")


def _check_origin(origin_xy_m: object) -> None:
    """Raise ValueError unless the corner of a grid is two finite numbers."""
    try:
        corner = np.array(origin_xy_m, np.float64)
    except (TypeError, ValueError):
        corner = np.zeros(0)
    if corner.shape != (2,) or not (np.abs(corner) <= _FAR_M).all():
        raise ValueError(f"grid.origin_xy_m: expected (x, y) on Earth [m], got {origin_xy_m!r}")


def _check_colors(colors_bgr: NDArray[Any]) -> None:
    kind, low, high = colors_bgr.dtype, colors_bgr.min(initial=0), colors_bgr.max(initial=0)
    if kind.kind == "f" or low < 0 or high > 255:
        raise ValueError(f"points.colors_bgr: expected 0 to 255, got {kind}: {low} to {high}")


def _of(name: str, value: object, kind: type[Value] | tuple[type[Value], ...]) -> Value:
    if not isinstance(value, kind):
        expected = kind[0] if isinstance(kind, tuple) else kind
        raise TypeError(f"{name}: expected {expected.__name__}, got {type(value).__name__}")
    return value


def _check_shape(name: str, array: NDArray[Any], expected: tuple[int | None, ...]) -> None:
    if array.shape != expected:
        raise ValueError(f"{name}: expected {expected}, got {array.shape}")


def _check_rigid(name: str, T_a_b: NDArray[np.float64]) -> None:
    """Raise ValueError where a (..., 4, 4) array holds anything but rigid transforms."""
    if not np.isfinite(T_a_b).all():
        raise ValueError(f"{name}: it is not finite")
    skew = se3.skew(T_a_b).max(initial=0.0)
    if skew > _SKEW_MAX:
        raise ValueError(f"{name}: expected a rotation, R^T R is off the identity by {skew:.3g}")
    far_m = np.abs(T_a_b[..., :3, 3]).max(initial=0.0)
    if far_m > _FAR_M or (T_a_b[..., 3, :] != (0, 0, 0, 1)).any():
        raise ValueError(f"{name}: expected a place on Earth and a last row of 0 0 0 1")


def _covariances(covariances: object, count: int) -> NDArray[np.float64] | None:
    """Return a copy of covariances (N, 6, 6), NaN where a pose has none; None without any."""
    if covariances is None:
        return None
    matrices = np.array(_of("covariances", covariances, np.ndarray), np.float64)
    _check_shape("covariances", matrices, (count, 6, 6))
    known = ~np.isnan(matrices).all(axis=(1, 2))
    if not np.isfinite(matrices[known]).all():
        raise ValueError("covariances: expected finite numbers, or NaN in all of a row")
    return matrices


def _covariance(name: str, covariance: object) -> NDArray[np.float64] | None:
    """Return a copy of a covariance (6, 6) without its negative parts, None without one."""
    if covariance is None:
        return None
    matrix = np.array(_of(name, covariance, np.ndarray), np.float64)
    _check_shape(name, matrix, (6, 6))
    if not (np.isfinite(matrix).all() and (matrix.diagonal() >= 0).all()):
        raise ValueError(f"{name}: expected finite numbers, none below 0 on the diagonal")
    if np.linalg.eigvalsh(matrix)[0] < 0.0:
        matrix = semidefinite(matrix)
    matrix.flags.writeable = False
    return matrix
