"""Conversion between SceneSLAM's types and the protocol's named arrays."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.maps import LAYER_TYPES, MapLayers
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory

from .protocol import Fields, ProtocolError, as_text, text

_STATUSES = (TrackingStatus.TRACKING, TrackingStatus.DEGRADED, TrackingStatus.LOST)
_SKEW_MAX = 1e-3  # as the bus allows
Layer = TypeVar("Layer")


def rig_fields(rig: Rig) -> dict[str, NDArray[Any]]:
    """Return the rig as named arrays: `sensors`, `camera.fx`, ..."""
    found = {"sensors": text(" ".join(sorted(sensor.value for sensor in rig.sensors)))}
    for name in ("camera", "laser", "lidar"):
        found |= _flat(getattr(rig, name), name)
    return found


def observation_fields(observation: Observation) -> dict[str, NDArray[Any]]:
    """Return the measurements as named arrays; missing sensors have no fields."""
    found: dict[str, NDArray[Any]] = {}
    for field in fields(observation):
        found |= _flat(getattr(observation, field.name), field.name)
    return found


def required(answer: Fields) -> tuple[frozenset[Sensor], ...]:
    """Return the required sensors of the first reply: a line per set, such as `scan odometry`."""
    known = {sensor.value: sensor for sensor in Sensor}
    lines = [line.split() for line in as_text(_of(answer, "requires")).splitlines()]
    unknown = {name for line in lines for name in line} - set(known)
    if unknown or not all(lines) or not lines:
        raise ProtocolError(
            f"requires {' | '.join(map(' '.join, lines)) or 'nothing'}, "
            f"allowed: lines of sensors, each one of {', '.join(known)}"
        )
    return tuple(frozenset(known[name] for name in line) for line in lines)


def answers(reply: Fields) -> list[Tracking]:
    """Return the poses of a reply to `track`; empty if there is no pose yet."""
    stamps_ns = _of(reply, "stamps_ns").reshape(-1)
    count = len(stamps_ns)
    T_local_base = _rigid(_of(reply, "T_local_base"), count)
    statuses = _optional(reply, "status", (count,))
    covariances = _optional(reply, "covariance", (count, 6, 6))
    of_maps = _optional(reply, "map_covariance", (count, 6, 6))
    qualities = _optional(reply, "quality_ratio", (count,))
    inliers = _optional(reply, "inliers", (count,))
    can_begin = _optional(reply, "can_begin", (count,))
    return [
        Tracking(
            stamp_ns=int(stamps_ns[index]),
            T_local_base=T_local_base[index],
            status=_STATUSES[0] if statuses is None else _status(statuses[index]),
            covariance=None if covariances is None else covariances[index].astype(np.float64),
            map_covariance=None if of_maps is None else of_maps[index].astype(np.float64),
            quality_ratio=1.0 if qualities is None else float(qualities[index]),
            inliers=0 if inliers is None else int(inliers[index]),
            can_begin=False if can_begin is None else bool(can_begin[index]),
        )
        for index in range(count)
    ]


def trajectory(reply: Fields) -> Trajectory:
    """Return the revised poses of a reply."""
    stamps_ns = _of(reply, "stamps_ns").reshape(-1).astype(np.int64)
    T_world_base = _rigid(_of(reply, "T_local_base"), len(stamps_ns))
    return Trajectory(stamps_ns=stamps_ns, T_world_base=T_world_base)


def layers(reply: Fields) -> MapLayers:
    """Return the map's layers: `points.points`, `grid.log_odds`, ...; other fields are unused."""
    found = {name: _layer(reply, name, kind) for name, kind in LAYER_TYPES.items()}
    return MapLayers(**found)


def _layer(reply: Fields, name: str, kind: type[Layer]) -> Layer | None:
    prefix = f"{name}."
    values = {key.removeprefix(prefix): reply[key] for key in reply if key.startswith(prefix)}
    if not values:
        return None
    known = {field.name: field for field in fields(kind)}  # type: ignore[arg-type]
    for key, value in values.items():
        if key == "is_loop":
            values[key] = value.astype(np.bool_)
        elif key in ("resolution_m", "cell_m"):
            values[key] = float(value)  # type: ignore[assignment]
        elif key == "origin_xy_m":
            values[key] = tuple(value.astype(float).tolist())  # type: ignore[assignment]
    try:
        return kind(**{key: value for key, value in values.items() if key in known})
    except TypeError as error:
        raise ProtocolError(f"wrote a map whose {name} is incomplete: {error}") from error


def _flat(value: object, name: str) -> dict[str, NDArray[Any]]:
    """Return a value's arrays by dotted names; empty for None."""
    if value is None:
        return {}
    if is_dataclass(value):
        parts = [
            _flat(getattr(value, field.name), f"{name}.{field.name}") for field in fields(value)
        ]
        return {key: array for part in parts for key, array in part.items()}
    array = np.asarray(value)
    return {name: array.astype(np.int64) if isinstance(value, int) else array}


def _of(reply: Fields, name: str) -> NDArray[Any]:
    if name not in reply:
        raise ProtocolError(
            f"sent a reply without {name!r}; it has: {', '.join(reply) or 'nothing'}"
        )
    return reply[name]


def _optional(reply: Fields, name: str, shape: tuple[int, ...]) -> NDArray[Any] | None:
    if name not in reply:
        return None
    if reply[name].shape != shape or not np.isfinite(reply[name]).all():
        raise ProtocolError(f"answered {name} {reply[name].shape}, expected finite {shape}")
    return reply[name]


def _rigid(array: NDArray[Any], count: int) -> NDArray[np.float64]:
    """Return `count` rigid transforms (4, 4) [m]; raises ProtocolError for invalid ones."""
    if array.shape != (count, 4, 4):
        raise ProtocolError(f"sent T_local_base {array.shape}, expected {(count, 4, 4)}")
    T_local_base = array.astype(np.float64)
    if not np.isfinite(T_local_base).all():
        raise ProtocolError("sent a T_local_base that is not finite")
    if (se3.skew(T_local_base) > _SKEW_MAX).any():
        raise ProtocolError("sent a T_local_base that is not a rotation")
    if (T_local_base[:, 3] != (0, 0, 0, 1)).any():
        raise ProtocolError("sent a T_local_base whose last row is not 0 0 0 1")
    return T_local_base


def _status(code: Any) -> TrackingStatus:
    if not 0 <= code < len(_STATUSES):
        raise ProtocolError(f"sent the status {code}, allowed: 0 tracking, 1 degraded, 2 lost")
    return _STATUSES[int(code)]
