"""The program between `process` and ROS 2: publishes sensors, receives poses and maps."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import names
from sceneslam.ros.encode import Encoder
from sceneslam.ros.transport.transport import Network, Qos, open_transport
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Camera, Sensor
from sceneslam.types.se3 import Transform

from ..process.client import LOST, TRACKING, poses, serve
from ..process.protocol import Fields, ProtocolError
from .listener import NodeListener, moved

_TYPES = {
    "image": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "depth": "sensor_msgs/msg/Image",
    "scan": "sensor_msgs/msg/LaserScan",
    "points": "sensor_msgs/msg/PointCloud2",
    "odometry": "nav_msgs/msg/Odometry",
    "imu": "sensor_msgs/msg/Imu",
}
_KEPT = 1000  # stored observations without a pose
# A larger move of the pose from one observation to the next is a loop closure. Less is within the
# bounds of the bus's gate: 0.09 m and 3 degrees. In a second wheels may slip by as much again.
_JUMP_M, _JUMP_RAD = 0.08, np.radians(2.0)
_JUMP_NS = 5_000_000_000  # the gate's longer horizon: it judges what jumps more often


class NodeClient:
    """Publishes observations, and returns the node's poses and maps."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings, self._topics = settings, settings["topics"]
        self.requires = " ".join(settings["needs"])
        self._encoder = Encoder()
        self._node: subprocess.Popen[bytes] | None = None
        self._sent: dict[int, Transform | None] = {}  # stamp -> T_odom_base
        self._T_odom_first: Transform | None = None
        self._T_local_world: Transform | None = None
        self._given_ns: int | None = None  # stamp of the newest returned pose
        self._T_map_odom: Transform | None = None  # the last that was used
        self._used_ns = 0  # when
        self._jumped_ns: int | None = None  # when the pose jumped last
        self._revision = 0

    def activate(self, rig: Fields) -> None:
        """Join the domain and start the node in it; its standard output is its log."""
        network = Network(**self._settings["network"])
        self._transport = open_transport(network)
        self._heard = NodeListener(self._transport, self._settings)
        self._camera = _camera(rig)
        places = {
            frame: rig[name]
            for frame, name in (
                (names.CAMERA, "camera.T_base_cam"),
                (names.LASER, "laser.T_base_laser"),
                (names.LIDAR, "lidar.T_base_lidar"),
            )
            if name in rig
        }
        static = self._encoder.transforms(0, names.BASE, places)
        self._transport.publisher(names.TF_STATIC, "tf2_msgs/msg/TFMessage", Qos.HISTORY).publish(
            static
        )
        is_camera = self._settings["pose_frame"] == "camera"
        self._T_frame_base = se3.inverse(places[names.CAMERA]) if is_camera else np.eye(4)
        if self._settings["command"] is not None:
            self._node = subprocess.Popen(
                self._settings["command"],
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr,
                env=os.environ | {"ROS_DOMAIN_ID": str(network.domain())},
            )

    def set_scene(self, scene: str) -> None:
        """Do nothing."""

    def track(self, observation: Fields) -> dict[str, Any]:
        """Publish the measurements; return the poses received so far."""
        if self._node is not None and self._node.poll() is not None:
            command = " ".join(self._settings["command"])
            raise ProtocolError(f"the node ended with {self._node.returncode}: {command}")
        stamp_ns = int(observation["stamp_ns"])
        T_odom_base = observation.get("T_odom_base")
        if not self._sent:
            self._T_odom_first = T_odom_base
        self._sent[stamp_ns] = T_odom_base
        while len(self._sent) > _KEPT:
            del self._sent[next(iter(self._sent))]
        self._send(stamp_ns, observation)
        if self._settings["pose_kind"] == "tf":
            T_map_odom = self._heard.T_map_odom(self._settings["tf_age_max_s"])
            if T_map_odom is None or T_odom_base is None:
                return poses([], [])
            self._note_jump(stamp_ns, T_map_odom, T_odom_base)
            said = {stamp_ns: (T_map_odom @ T_odom_base, 0.0)}
        else:
            said = self._heard.wait(stamp_ns, self._settings["answer_s"])
        return self._answer(said)

    def trajectory(self) -> dict[str, Any]:
        """Return no poses: nodes do not publish revised poses by stamp."""
        return poses([], [])

    def map(self) -> dict[str, Any]:
        """Return the latest map."""
        if self._T_local_world is None:
            return {}
        return moved(self._heard.map(), self._T_local_world)

    def _answer(self, said: dict[int, tuple[Transform, float]]) -> dict[str, Any]:
        """Return the poses of published observations, without those that are too late."""
        given_ns = self._given_ns
        stamps_ns = sorted(
            ns for ns in said if ns in self._sent and (given_ns is None or ns > given_ns)
        )
        statuses, found = [], []
        for stamp_ns in stamps_ns:
            T_world_frame, deviation_m = said[stamp_ns]
            T_world_base = T_world_frame @ self._T_frame_base
            is_lost = not deviation_m <= self._settings["deviation_max_m"]  # also NaN
            if self._T_local_world is None and not is_lost:
                self._T_local_world = self._since_first(stamp_ns) @ se3.inverse(T_world_base)
            # Before the first certain pose `local` is unknown in the node's world.
            T_local_world = np.eye(4) if self._T_local_world is None else self._T_local_world
            found.append(se3.orthonormal(T_local_world @ T_world_base))
            statuses.append(LOST if is_lost else TRACKING)
            self._given_ns = stamp_ns
        status = np.array(statuses, np.int64)
        return {**poses(stamps_ns, found), "status": status, "revision": self._revision}

    def _note_jump(self, stamp_ns: int, T_map_odom: Transform, T_odom_base: Transform) -> None:
        """Count a revision where map -> odom made the robot's pose jump, for the first time in 5 s.

        If poses that flap were revisions, the gate would never find that they are wrong.
        """
        T_map_odom_old, self._T_map_odom = self._T_map_odom, T_map_odom
        used_ns, self._used_ns = self._used_ns, stamp_ns
        if T_map_odom_old is None or not self._settings["closes_loops"]:
            return
        T_old_new = se3.inverse(T_map_odom_old @ T_odom_base) @ T_map_odom @ T_odom_base
        slipped = 1.0 + (stamp_ns - used_ns) * 1e-9
        if not se3.is_within(T_old_new, slipped * _JUMP_M, slipped * _JUMP_RAD):
            jumped_ns, self._jumped_ns = self._jumped_ns, stamp_ns
            self._revision += jumped_ns is None or stamp_ns - jumped_ns >= _JUMP_NS

    def _since_first(self, stamp_ns: int) -> Transform:
        """Return the motion by odometry since the first observation, identity without odometry."""
        T_first, T_now = self._T_odom_first, self._sent[stamp_ns]
        return np.eye(4) if T_first is None or T_now is None else se3.inverse(T_first) @ T_now

    def _send(self, stamp_ns: int, observation: Fields) -> None:
        encoder, T_odom_base = self._encoder, observation.get("T_odom_base")
        if T_odom_base is not None:
            tf = encoder.transforms(stamp_ns, names.ODOM, {names.BASE: T_odom_base})
            self._transport.publisher(names.TF, "tf2_msgs/msg/TFMessage", Qos.RELIABLE).publish(tf)
            self._publish("odometry", encoder.odometry, stamp_ns, T_odom_base, names.ODOM)
        for at_ns, measured in _inertial(stamp_ns, observation).items():
            self._publish("imu", encoder.imu, at_ns, measured)
        if "scan.ranges_m" in observation:
            self._publish("scan", encoder.scan, stamp_ns, _scan(observation))
        points, times_s = observation.get("points_lidar"), observation.get("point_times_s")
        if points is not None:
            self._publish("points", encoder.points, stamp_ns, points, times_s)
        image_bgr, depth_m = observation.get("image_bgr"), observation.get("depth_m")
        if self._camera is not None and (image_bgr is not None or depth_m is not None):
            self._publish("camera_info", encoder.camera_info, stamp_ns, self._camera)
        for name, encoding, pixels in (("depth", "32FC1", depth_m), ("image", "bgr8", image_bgr)):
            if pixels is not None:
                self._publish(name, encoder.image, stamp_ns, pixels, encoding)

    def _publish(self, name: str, encode: Callable[..., bytes], *values: Any) -> None:
        """Publish a message on a sensor's topic, if it has one."""
        if self._topics[name] is not None:
            publisher = self._transport.publisher(self._topics[name], _TYPES[name], Qos.RELIABLE)
            publisher.publish(encode(*values))


def _camera(rig: Fields) -> Camera | None:
    if "camera.fx" not in rig:
        return None
    width, height = rig["camera.size_wh"].tolist()
    return Camera(
        size_wh=(width, height),
        fx=float(rig["camera.fx"]),
        fy=float(rig["camera.fy"]),
        cx=float(rig["camera.cx"]),
        cy=float(rig["camera.cy"]),
        distortion=tuple(rig["camera.distortion"].tolist()),
    )


def _scan(observation: Fields) -> LaserScan:
    values = {name: float(observation[f"scan.{name}"]) for name in (
        "angle_min_rad", "angle_step_rad", "range_min_m", "range_max_m")}  # fmt: skip
    ranges_m = observation["scan.ranges_m"]
    return LaserScan(stamp_ns=int(observation["scan.stamp_ns"]), ranges_m=ranges_m, **values)


def _inertial(stamp_ns: int, observation: Fields) -> dict[int, dict[Sensor, NDArray[Any]]]:
    found: dict[int, dict[Sensor, NDArray[Any]]] = {}
    for sensor in (sensor for sensor in Sensor if sensor.is_sampled):
        for row in observation.get(sensor.field, np.zeros((0, 4))):
            found.setdefault(stamp_ns + round(float(row[0]) * 1e9), {})[sensor] = row[1:]
    return dict(sorted(found.items()))


def main(settings: dict[str, Any]) -> None:
    """Serve requests until the input is closed; the node ends with this process group."""
    serve(NodeClient(settings))
    sys.stderr.flush()
    os._exit(0)  # the transport's threads would keep running
