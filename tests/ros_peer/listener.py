"""Hears what a run publishes, through rclpy, and writes it down as JSON."""

import json
import pathlib
import struct
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from tf_type import TFMessage

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
TOPICS = {
    "/tf": (TFMessage, 100),
    "/sceneslam/odometry": (Odometry, 100),
    "/sceneslam/path": (Path, LATCHED),
    "/map": (OccupancyGrid, LATCHED),
    "/sceneslam/points": (PointCloud2, LATCHED),
    "/sceneslam/scene": (String, LATCHED),
    "/sceneslam/module": (String, LATCHED),
    "/diagnostics": (DiagnosticArray, 10),
}
LATE_S = 3.0  # within which who joins late has to get the latched map


def listen(heard_path, is_over):
    """Listen until `is_over` is set; then join again, late, for what is latched."""
    rclpy.init()
    node = rclpy.create_node("listener")
    heard = {topic: [] for topic in TOPICS}
    for topic, (msgtype, qos) in TOPICS.items():
        node.create_subscription(
            msgtype,
            topic,
            lambda data, kept=heard[topic]: kept.append((time.time_ns(), data)),
            qos,
            raw=True,
        )
    while not is_over.is_set():
        rclpy.spin_once(node, timeout_sec=0.05)
    pathlib.Path(heard_path).write_text(json.dumps(_read(heard) | {"late": _join_late()}))


def _join_late():
    """Return the latched topics that a node which joins now is given."""
    node, late = rclpy.create_node("late"), []
    for topic in ("/map", "/sceneslam/path", "/sceneslam/scene", "/sceneslam/module"):
        node.create_subscription(
            TOPICS[topic][0], topic, lambda _, topic=topic: late.append(topic), LATCHED, raw=True
        )
    until_s = time.monotonic() + LATE_S
    while time.monotonic() < until_s:
        rclpy.spin_once(node, timeout_sec=0.05)
    return sorted(set(late))


def _read(heard):
    """Return what the messages say, as numbers and words."""
    messages = {
        topic: [deserialize_message(data, TOPICS[topic][0]) for _, data in kept]
        for topic, kept in heard.items()
        if topic != "/tf"
    }
    poses = []
    for (came_ns, _), message in zip(
        heard["/sceneslam/odometry"], messages["/sceneslam/odometry"], strict=True
    ):
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        poses.append([stamp_ns, came_ns, at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w])
    paths, grids = messages["/sceneslam/path"], messages["/map"]
    cells = list(grids[-1].data) if grids else []
    return {
        "poses": poses,
        "path": [[p.pose.position.x, p.pose.position.y] for p in paths[-1].poses] if paths else [],
        "tf": sorted({_frames(data) for _, data in heard["/tf"]}),
        "tf_count": len(heard["/tf"]),
        "map": {
            "count": len(grids),
            "occupied": sum(cell == 100 for cell in cells),
            "free": sum(cell == 0 for cell in cells),
        },
        "points": max((one.width * one.height for one in messages["/sceneslam/points"]), default=0),
        "scenes": [one.data for one in messages["/sceneslam/scene"]],
        "modules": [one.data for one in messages["/sceneslam/module"]],
        "diagnostics": sorted({one.status[0].message for one in messages["/diagnostics"]}),
    }


def _frames(data):
    """Return `parent -> child` of the first transform of a serialised TFMessage."""
    at, names = 16, []  # after the CDR header, the length of the list and the stamp
    for _ in range(2):
        (length,) = struct.unpack_from("<I", data, at)
        names.append(data[at + 4 : at + 3 + length].decode())
        at = (at + 4 + length + 3) // 4 * 4
    return " -> ".join(names)
