"""The `ros2_node` SLAM module: any ROS 2 SLAM node, as the paper used ROS nodes.

The node is started by a program that uses the protocol of `process` on one side and ROS 2 over
DDS on the other. Deadlines, restarts and late poses are handled by `process`.
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from sceneslam.ros.transport.transport import DDS, Network
from sceneslam.supervision.limits import Limits
from sceneslam.types.errors import ConfigError
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import Command

from ..process.module import ProcessSlam, python_command

POSES = ("odometry", "pose", "tf")
MAPS = ("grid", "points")


@dataclass(slots=True, kw_only=True)
class NodeTopics:
    """Names of topics; null: not published, or not subscribed to."""

    image: str | None
    camera_info: str | None
    depth: str | None
    scan: str | None
    points: str | None
    odometry: str | None
    imu: str | None
    pose: str | None
    map: str | None

    def __post_init__(self) -> None:
        for name, topic in asdict(self).items():
            if topic is not None and not topic.startswith("/"):
                raise ConfigError(name, topic, "null or the whole name of a topic: /scan")


class Ros2Node(ProcessSlam):
    """Starts a node by a command, or uses a running one; returns the poses that it publishes.

    `pose_kind` is the type of `topics.pose`: `odometry` (Odometry) or `pose` (PoseStamped) of
    base_link, or `tf`: map -> odom on /tf, multiplied with the odometry that the node receives.
    With `closes_loops`, a jump of map -> odom is a revision of the past, not a motion.
    """

    def __init__(
        self,
        *,
        command: Command | None,
        needs: Sequence[str],
        topics: NodeTopics,
        pose_kind: str,
        map_kind: str,
        pose_frame: str,
        answer_s: float,
        tf_age_max_s: float | None,
        deviation_max_m: float,
        network: Network,
        late_max_s: float,
        limits: Limits,
        closes_loops: bool,
    ) -> None:
        if network.transport == DDS and importlib.util.find_spec("cyclonedds") is None:
            raise ConfigError("network.transport", DDS, "pip install 'sceneslam[ros2]'")
        if command is not None and (not command or shutil.which(command[0]) is None):
            raise ConfigError("command", command, "null, or a program that can be run")
        for name, given, known in (("pose_kind", pose_kind, POSES), ("map_kind", map_kind, MAPS)):
            if given not in known:
                raise ConfigError(name, given, " | ".join(known))
        if pose_frame not in ("base", "camera"):
            raise ConfigError("pose_frame", pose_frame, "base | camera")
        if pose_kind == "tf" and pose_frame != "base":
            allowed = "base: map -> odom times the odometry is the pose of base"
            raise ConfigError("pose_frame", pose_frame, allowed)
        if pose_kind != "tf" and topics.pose is None:
            raise ConfigError("topics.pose", None, f"a topic, as pose_kind is {pose_kind}")
        for name, value in (("answer_s", answer_s), ("deviation_max_m", deviation_max_m)):
            if not 0 < value < np.inf:
                raise ConfigError(name, value, "above 0")
        if tf_age_max_s is not None and not 0 < tf_age_max_s < np.inf:
            raise ConfigError("tf_age_max_s", tf_age_max_s, "null, or above 0")
        sensors = {sensor.value for sensor in Sensor}
        if not needs or not sensors >= set(needs):
            raise ConfigError("needs", list(needs), f"some of {', '.join(sorted(sensors))}")
        settings = {
            "command": None if command is None else list(command),
            "needs": list(needs),
            "topics": asdict(topics),
            "pose_kind": pose_kind,
            "map_kind": map_kind,
            "pose_frame": pose_frame,
            "answer_s": answer_s,
            "tf_age_max_s": tf_age_max_s,
            "deviation_max_m": deviation_max_m,
            "network": asdict(network),
            "closes_loops": closes_loops,
        }
        bridge = python_command("sceneslam.modules.slam.ros2_node.client", settings)
        super().__init__(
            command=bridge, late_max_s=late_max_s, limits=limits, closes_loops=closes_loops
        )
        self._pose_frame = pose_frame

    def activate(self, rig: Rig) -> None:
        """Start a session; raises ConfigError if the poses are those of a missing camera."""
        if self._pose_frame == "camera" and rig.camera is None:
            raise ConfigError("pose_frame", "camera", "base, as the rig has no camera")
        super().activate(rig)
