"""A run as ROS 2 topics, for any transport: map -> odom, path, map, scene, module, health."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import LiveMapper
from sceneslam.ros import names
from sceneslam.ros.encode_results import ERROR, OK, WARN, ResultEncoder
from sceneslam.ros.transport.transport import Qos, Transport
from sceneslam.sinks.live_map import LiveMap
from sceneslam.sinks.ros2.requests import Requests
from sceneslam.types import se3
from sceneslam.types.command import Command, SaveMap
from sceneslam.types.errors import ConfigError
from sceneslam.types.grid_frames import in_frame
from sceneslam.types.maps import HybridMap, MovedMap
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import Event, RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

MAP, POINTS, DIAGNOSTICS = "/map", "/sceneslam/points", "/diagnostics"
ODOMETRY, PATH = "/sceneslam/odometry", "/sceneslam/path"
SCENE, MODULE = "/sceneslam/scene", "/sceneslam/module"
TYPES = {
    names.TF: ("tf2_msgs/msg/TFMessage", Qos.RELIABLE),
    ODOMETRY: ("nav_msgs/msg/Odometry", Qos.RELIABLE),
    PATH: ("nav_msgs/msg/Path", Qos.LATCHED),
    MAP: ("nav_msgs/msg/OccupancyGrid", Qos.LATCHED),
    POINTS: ("sensor_msgs/msg/PointCloud2", Qos.LATCHED),
    SCENE: ("std_msgs/msg/String", Qos.LATCHED),
    MODULE: ("std_msgs/msg/String", Qos.LATCHED),
    DIAGNOSTICS: ("diagnostic_msgs/msg/DiagnosticArray", Qos.RELIABLE),
}
_SLOW_NS = 1_000_000_000  # period of path and diagnostics
_PATH_POSES = 2000  # largest number; beyond, every second one is left out
_LEVELS = {"tracking": OK, "degraded": WARN}
_PLACES = {  # event -> what it says of the loaded map
    "relocalized": "",
    "not_relocalized": "not found in the loaded map",
    "relocalization_withdrawn": "not found in the loaded map",
}


class TopicSink:
    """Publishes poses as they are reported, and the map every `map_every_s`.

    `map -> odom` follows REP-105: the robot publishes `odom -> base_link`. If the source has no
    odometry, `map -> base_link` is published. The stamp is `tf_ahead_s` ahead, so that look-ups
    between two poses do not wait. `/initialpose` moves `map` so that the robot has the given pose;
    it does not relocalize the robot in an older map.
    """

    writes_files = False

    def __init__(
        self,
        join: Callable[[], Transport],
        *,
        map_frame: str,
        odom_frame: str,
        base_frame: str,
        tf_ahead_s: float,
        map_every_s: float,
        mapper: LiveMapper,
    ) -> None:
        for key, value in (("tf_ahead_s", tf_ahead_s), ("map_every_s", map_every_s)):
            if not 0 <= value < float("inf"):
                raise ConfigError(key, value, "0 or more [s]")
        frames = (map_frame, odom_frame, base_frame)
        if "" in frames or len(set(frames)) < len(frames):
            raise ConfigError(
                "map_frame", list(frames), "three names: map, odom and base_link, say"
            )
        self._join = join
        self._map_frame, self._odom_frame, self._base_frame = frames
        self._ahead_ns = round(tf_ahead_s * 1e9)
        self._live_map = LiveMap(mapper, every_s=map_every_s, publish=self._publish_map)
        self.encoder = ResultEncoder()
        self._transport: Transport | None = None

    def open(self, rig: Rig, folder: Path) -> None:
        """Start publishing."""
        self._transport = self._join()
        for topic, (msgtype, qos) in TYPES.items():
            self._transport.publisher(topic, msgtype, qos)
        self._requests = Requests(self._transport, map_frame=self._map_frame)
        self._T_frame_map = se3.identity()
        self._T_smooth_odom = se3.identity()
        self._T_frame_odom: Transform | None = None
        self._has_odometry = Sensor.ODOMETRY in rig.sensors
        self._shift_ns = 0  # offset of the run's stamps to the robot's
        self._covariance: NDArray[np.float64] | None = None
        self._stamps_ns: list[int] = []
        self._run_ns: list[int] = []  # the same by the run's clock, which never jumps
        self._poses: list[Transform] = []  # T_map_base
        self._path_step = 1  # every so many poses, one is in the path
        self._count, self._slow_ns = 0, -_SLOW_NS
        self._said = dict.fromkeys((SCENE, MODULE), "")
        self._status, self._reason, self._place = "", "", ""
        self._live_map.open(rig)

    def commands(self) -> Sequence[Command]:
        """Return the operators' commands since the last call."""
        if self._transport is None:
            return ()
        saves = [
            SaveMap(name=name, hybrid=self._live_map.newest()) for name in self._requests.maps()
        ]
        return [*self._requests.commands(), *saves]

    def write_covariance(self, stamp_ns: int, covariance: NDArray[np.float64]) -> None:
        """Set the covariance (6, 6) of the next pose, of se3.log order [m, rad], in base."""
        self._covariance = covariance

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Publish a pose and, once per second, path and diagnostics."""
        stamp_ns = observation.stamp_ns - self._shift_ns
        covariance, self._covariance = self._covariance, None
        if T_map_base is not None:
            self._place_frame(T_map_base)
            T_frame_base = self._T_frame_map @ T_map_base
            self._send_transform(stamp_ns, T_frame_base, observation.T_odom_base)
            odometry = self.encoder.odometry(
                stamp_ns,
                T_frame_base,
                self._map_frame,
                base=self._base_frame,
                covariance=covariance,
                marks_twist=True,
            )
            self.send(ODOMETRY, odometry)
            self._keep(stamp_ns, observation.stamp_ns, T_map_base)
            self._live_map.add(observation, T_map_base)
        self._say(MODULE, module)
        if observation.stamp_ns - self._slow_ns >= _SLOW_NS:
            self._slow_ns = observation.stamp_ns
            self._send_path()
            self._send_health(stamp_ns, module)

    def write_map(self, moved: MovedMap) -> None:
        """Correct what was drawn of the map, and the path."""
        self._live_map.move(moved)
        if self._poses:
            stamps_ns = np.array(self._run_ns, np.int64)
            self._poses = list(moved.moved(stamps_ns, np.array(self._poses)))

    def write_event(self, event: Event) -> None:
        """Publish scene and module when they change."""
        kind = event["event"]
        if kind == "scene":
            self._say(SCENE, str(event["scene"]))
        elif kind == "tracking":
            self._status = str(event["status"])
        elif kind == "decision":
            self._reason = f"{event['to']}: {event['reason']}"
        elif kind in _PLACES:
            self._place = _PLACES[kind]
        elif kind == "clock_jump" and event["paces"]:
            self._shift_ns = int(event["shift_ns"])
        elif kind == "odometry_jump":
            self._T_smooth_odom = np.reshape(event["T_smooth_odom"], (4, 4))

    def write_truth(self, truth: GroundTruth) -> None:
        """Do nothing: a robot has no ground truth."""

    def write_result(self, result: RunResult) -> None:
        """Publish the revised path and the final map."""
        trajectory = result.trajectory
        self._stamps_ns = (trajectory.stamps_ns - self._shift_ns).tolist()
        self._poses = list(trajectory.T_world_base)
        self._send_path()
        if result.map.grid is not None:
            self._publish_map(result.map)

    def close(self) -> None:
        """Stop publishing."""
        try:
            self._live_map.close()
        finally:
            if self._transport is not None:
                self._transport.close()
                self._transport = None

    def _place_frame(self, T_map_base: Transform) -> None:
        """Move the published `map` so that the robot has the pose of `/initialpose`."""
        T_frame_base = self._requests.placed()
        if T_frame_base is not None:
            self._T_frame_map = T_frame_base @ se3.inverse(T_map_base)

    def _send_transform(
        self, stamp_ns: int, T_frame_base: Transform, T_smooth_base: Transform | None
    ) -> None:
        child, T_frame_child = self._base_frame, T_frame_base
        if T_smooth_base is not None:
            T_odom_base = se3.inverse(self._T_smooth_odom) @ T_smooth_base
            self._T_frame_odom = T_frame_base @ se3.inverse(T_odom_base)
        if self._has_odometry:  # base has one parent: while odometry is silent, the last one holds
            if self._T_frame_odom is None:
                return
            child, T_frame_child = self._odom_frame, self._T_frame_odom
        at_ns = stamp_ns + self._ahead_ns
        message = self.encoder.transforms(at_ns, self._map_frame, {child: T_frame_child})
        self.send(names.TF, message)

    def _keep(self, stamp_ns: int, run_ns: int, T_map_base: Transform) -> None:
        if self._count % self._path_step == 0:
            self._stamps_ns.append(stamp_ns)
            self._run_ns.append(run_ns)
            self._poses.append(T_map_base)
        self._count += 1
        if len(self._poses) > _PATH_POSES:
            self._stamps_ns, self._run_ns = self._stamps_ns[::2], self._run_ns[::2]
            self._poses = self._poses[::2]
            self._path_step *= 2

    def _send_path(self) -> None:
        poses = list(self._T_frame_map @ np.reshape(self._poses, (-1, 4, 4)))
        self.send(PATH, self.encoder.path(self._stamps_ns, poses, self._map_frame))

    def _send_health(self, stamp_ns: int, module: str) -> None:
        level = _LEVELS.get(self._status, ERROR)
        message = f"{module}: {self._status}" if module else "no module runs"
        if self._place:
            level, message = max(level, WARN), f"{message}, {self._place}"
        values = {
            "scene": self._said[SCENE],
            "module": module,
            "status": self._status,
            "last decision": self._reason,
        }
        self.send(DIAGNOSTICS, self.encoder.diagnostics(stamp_ns, level, message, values))

    def _publish_map(self, hybrid: HybridMap) -> None:
        stamp_ns = self._stamps_ns[-1] if self._stamps_ns else 0
        T_frame_map, frame = self._T_frame_map, self._map_frame
        if hybrid.grid is not None and hybrid.grid.log_odds.size:
            grid = in_frame(T_frame_map, hybrid.grid)  # Nav2 ignores an origin's rotation
            self.send(MAP, self.encoder.grid(stamp_ns, grid, frame))
        if len(hybrid.points.points):
            self.send(POINTS, self.encoder.cloud(stamp_ns, hybrid.points, T_frame_map, frame))

    def _say(self, topic: str, text: str) -> None:
        """Publish a text if it has changed."""
        if text != self._said[topic]:
            self._said[topic] = text
            self.send(topic, self.encoder.text(text))

    def send(self, topic: str, cdr: bytes) -> None:
        """Publish a serialised message, while the sink is open."""
        transport = self._transport
        if transport is not None:
            transport.publisher(topic, *TYPES[topic]).publish(cdr)
