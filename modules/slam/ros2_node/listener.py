"""Poses and maps received from a SLAM node."""

from __future__ import annotations

import threading
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import decode, names
from sceneslam.ros.clouds import cloud
from sceneslam.ros.transport.transport import Arrival, Qos, Transport
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.se3 import Transform

_MAP_TYPES = {"grid": "nav_msgs/msg/OccupancyGrid", "points": "sensor_msgs/msg/PointCloud2"}
_POSE_TYPES = {"odometry": "nav_msgs/msg/Odometry", "pose": "geometry_msgs/msg/PoseStamped"}
_LOG_ODDS = 4.0  # of a cell with occupancy 100
_TURN_MAX_RAD = 1e-3  # of a grid against the axes of the map, or of `local`


class NodeListener:
    """Receives the node's messages, in the transport's thread."""

    def __init__(self, transport: Transport, settings: dict[str, Any]) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._came = threading.Condition()
        self._poses: dict[int, tuple[Transform, float]] = {}  # stamp -> pose, sigma [m]
        self._tf: tuple[float, Transform] | None = None  # when it arrived [s], map -> odom
        self._map: dict[str, NDArray[Any]] = {}
        topics, self._map_kind = settings["topics"], settings["map_kind"]
        if settings["pose_kind"] == "tf":
            transport.subscribe(names.TF, "tf2_msgs/msg/TFMessage", self._hear_tf, Qos.RELIABLE)
        else:
            self._pose_type = _POSE_TYPES[settings["pose_kind"]]
            transport.subscribe(topics["pose"], self._pose_type, self._hear_pose, Qos.SENSOR)
        if topics["map"] is not None:
            kind = _MAP_TYPES[self._map_kind]
            qos = Qos.LATCHED if self._map_kind == "grid" else Qos.SENSOR
            transport.subscribe(topics["map"], kind, self._hear_map, qos)

    def wait(self, stamp_ns: int, wait_s: float) -> dict[int, tuple[Transform, float]]:
        """Return the received poses (4, 4) [m] when there is one for a stamp, or after `wait_s`."""
        until_s = monotonic() + wait_s
        with self._came:
            while stamp_ns not in self._poses and monotonic() < until_s:
                self._came.wait(until_s - monotonic())
            found, self._poses = self._poses, {}
        return found

    def T_map_odom(self, age_max_s: float | None) -> Transform | None:
        """Return the newest map -> odom (4, 4) [m]; None if it arrived longer ago, or never."""
        tf = self._tf
        if tf is None or (age_max_s is not None and monotonic() - tf[0] > age_max_s):
            return None
        return tf[1]

    def map(self) -> dict[str, NDArray[Any]]:
        """Return the latest map: points (N, 3) [m] or a grid, in the node's map frame."""
        with self._came:
            return dict(self._map)

    def _hear_pose(self, arrival: Arrival) -> None:
        message = self._store.deserialize_cdr(arrival.cdr, self._pose_type)
        has_covariance = hasattr(message.pose, "covariance")
        pose = message.pose.pose if has_covariance else message.pose
        T_world_frame = decode.transform(pose.position, pose.orientation)
        deviation_m = 0.0
        if has_covariance:
            variances = np.asarray(message.pose.covariance).reshape(6, 6)[[0, 1, 2], [0, 1, 2]]
            deviation_m = float(np.sqrt(max(variances.max(), 0.0)))
        if T_world_frame is not None and np.isfinite(T_world_frame).all():
            with self._came:
                self._poses[decode.stamp_ns(message)] = (T_world_frame, deviation_m)
                self._came.notify()

    def _hear_tf(self, arrival: Arrival) -> None:
        message = self._store.deserialize_cdr(arrival.cdr, "tf2_msgs/msg/TFMessage")
        for one in decode.transforms(message):
            if (one.parent, one.child) == (names.MAP, names.ODOM):
                self._tf = monotonic(), one.T_parent_child

    def _hear_map(self, arrival: Arrival) -> None:
        message = self._store.deserialize_cdr(arrival.cdr, _MAP_TYPES[self._map_kind])
        with self._came:
            self._map = _grid(message) if self._map_kind == "grid" else _points(message)


def _grid(message: Any) -> dict[str, NDArray[Any]]:
    """Return an OccupancyGrid as log odds; raises InputError if it is rotated in the map frame."""
    info, turn = message.info, message.info.origin.orientation
    T_world_grid = decode.transform(info.origin.position, turn)
    if T_world_grid is None or se3.rotation_angle_rad(T_world_grid) > _TURN_MAX_RAD:
        got = f"{turn.x:g} {turn.y:g} {turn.z:g} {turn.w:g}"
        raise InputError(f"grid: expected the orientation 0 0 0 1 (x y z w) of origin, got {got}")
    percent = np.asarray(message.data, np.float32).reshape(info.height, info.width)
    log_odds = np.where(percent < 0, 0.0, (percent - 50.0) / 50.0 * _LOG_ODDS)
    return {
        "grid.log_odds": log_odds.astype(np.float32),
        "grid.resolution_m": np.array(info.resolution, np.float64),
        "grid.origin_xy_m": T_world_grid[:2, 3],
    }


def _points(message: Any) -> dict[str, NDArray[Any]]:
    found = cloud(message, decode.stamp_ns(message))
    return {} if found is None else {"points.points": found.points_lidar}


def moved(layers: dict[str, NDArray[Any]], T_local_world: Transform) -> dict[str, NDArray[Any]]:
    """Return the layers in `local`; a grid is left out if `local` is rotated against it."""
    if "points.points" in layers:
        points = se3.apply(T_local_world, layers["points.points"])
        return {"points.points": points.astype(np.float32)}
    if "grid.log_odds" in layers and se3.rotation_angle_rad(T_local_world) < _TURN_MAX_RAD:
        origin = layers["grid.origin_xy_m"] + T_local_world[:2, 3]
        return {**layers, "grid.origin_xy_m": origin}
    return {}
