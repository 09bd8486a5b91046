"""Conversion of PointCloud2 messages to arrays."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import InputError

_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_NAMES = ("time", "t", "timestamp", "time_stamp", "offset_time")
_ABSOLUTE_NS = 1e17  # larger values are absolute: clocks that begin with the sensor are below
_NS_SPREAD = 2.5e5  # floats whose median deviation is larger are in ns: of 1 ms and more
_ODD = 0.05  # at most such a share of the points with a return has times that no sweep can have
_SWEEP_MAX_S = 1.0  # no lidar turns slower, and its stamp is of a time that is as near


class PointTimes(Enum):
    """What the times of a cloud's points are."""

    GOOD = "after the stamp, or missing"
    OTHER_CLOCK = "of another clock than the stamp: the first point is taken to be as old as that"
    INVALID = "spread over more than a second, and left out"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """The finite points of one message."""

    points_lidar: NDArray[np.float32]  # (N, 3) [m]
    point_times_s: NDArray[np.float64] | None  # (N,) after the message's stamp
    times: PointTimes


def cloud(message: Any, stamp_ns: int) -> Cloud | None:
    """Return the points (N, 3) [m], lidar, of a PointCloud2, None if its data are cut off.

    Raises InputError if it has no fields x, y and z.
    """
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= fields.keys():
        raise InputError(f"point cloud fields: expected x, y, z, got {', '.join(fields)}")
    rows = _rows(message, fields)
    if rows is None:
        return None
    if not {"x", "y", "z"} <= set(rows.dtype.names or ()):
        return None
    points = np.stack([rows[axis] for axis in "xyz"], axis=-1).astype(np.float32)
    is_good = np.isfinite(points).all(axis=1)
    name = next((name for name in _TIME_NAMES if name in (rows.dtype.names or ())), None)
    times_s, times = None, PointTimes.GOOD
    if name is not None and is_good.any():
        # Points without a return are (0, 0, 0), and drivers give them any time.
        has_return = np.linalg.norm(points[is_good], axis=1) > 0
        trusted = has_return if has_return.any() else ~has_return
        times_s, times = _judged(_offsets_s(rows[name][is_good], trusted, stamp_ns), trusted)
    kept_s = None if times is PointTimes.INVALID else times_s
    return Cloud(points_lidar=points[is_good], point_times_s=kept_s, times=times)


def _rows(message: Any, fields: dict[str, Any]) -> NDArray[Any] | None:
    """Return the points as a structured array (N,), None if bytes are missing."""
    order = ">" if message.is_bigendian else "<"
    kept = [field for field in fields.values() if field.datatype in _DTYPES]
    ends = [field.offset + np.dtype(_DTYPES[field.datatype]).itemsize for field in kept]
    if not kept or max(ends) > message.point_step:
        return None
    dtype = np.dtype(
        {
            "names": [field.name for field in kept],
            "formats": [order + _DTYPES[field.datatype] for field in kept],
            "offsets": [int(field.offset) for field in kept],
            "itemsize": int(message.point_step),
        }
    )
    width, height = int(message.width), int(message.height)
    data = np.ascontiguousarray(message.data, dtype=np.uint8)
    row_bytes = width * dtype.itemsize
    step = int(message.row_step) if height > 1 else row_bytes
    if step < row_bytes or data.size < step * height:
        return None
    packed = data[: step * height].reshape(height, step)[:, :row_bytes]
    return np.ascontiguousarray(packed).reshape(-1).view(dtype)


def _offsets_s(
    values: NDArray[Any], trusted: NDArray[np.bool_], stamp_ns: int
) -> NDArray[np.float64]:
    """Return times (N,) [s] after the stamp: integers are in ns, floats in s or ns.

    Which they are is judged by the points `trusted` (N,).
    """
    if values.dtype.kind in "iu":
        is_absolute = int(values[trusted].max()) > _ABSOLUTE_NS
        return (values.astype(np.int64) - is_absolute * stamp_ns).astype(np.float64) * 1e-9
    times = values.astype(np.float64)
    usual, spread = _middle(times[trusted])
    if usual > _ABSOLUTE_NS or spread > _NS_SPREAD:
        return (times - (usual > _ABSOLUTE_NS) * stamp_ns) * 1e-9
    return times - (usual * 1e9 > _ABSOLUTE_NS) * stamp_ns * 1e-9


def _middle(times: NDArray[np.float64]) -> tuple[float, float]:
    """Return the median of times (N,) and their median deviation from it; 0 if all are NaN."""
    known = times[~np.isnan(times)]
    if not len(known):
        return 0.0, 0.0
    middle = float(np.median(known))
    return middle, float(np.median(np.abs(known - middle)))


def _judged(
    times_s: NDArray[np.float64], trusted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], PointTimes]:
    """Return times (N,) [s] after the stamp, and by a sweep's length what they are.

    Odd ones become the usual one if few of the points `trusted` (N,) have them. Times of another
    clock are after the first point.
    """
    usual_s, _ = _middle(times_s[trusted])
    is_odd = ~(np.abs(times_s - usual_s) < _SWEEP_MAX_S)  # also if NaN
    if is_odd[trusted].mean() <= _ODD:
        times_s = np.where(is_odd, usual_s, times_s)
    first_s, last_s = float(np.fmin.reduce(times_s)), float(np.fmax.reduce(times_s))
    if not last_s - first_s < _SWEEP_MAX_S:  # also if all are NaN
        return times_s, PointTimes.INVALID
    if first_s < _SWEEP_MAX_S and last_s > -_SWEEP_MAX_S:
        return times_s, PointTimes.GOOD
    return times_s - first_s, PointTimes.OTHER_CLOCK
