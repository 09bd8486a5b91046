"""A robot for the tests, of another vendor's DDS: run by a Python that has rclpy.

    python ros_peer.py RECORDING.mcap HEARD.json [RATE]

Publishes a recording's sensor topics at the pace of their stamps, as if measured now, and writes
down what it hears of a run: poses, path, map, words. RATE 0.25: at a quarter of the robot's speed.
"""

import json
import pathlib
import struct
import sys
import time

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: F401  (a robot has it)
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Imu, LaserScan
from std_msgs.msg import String

SENSORS = {
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "sensor_msgs/msg/CameraInfo": CameraInfo,
    "sensor_msgs/msg/LaserScan": LaserScan,
    "sensor_msgs/msg/Imu": Imu,
    "nav_msgs/msg/Odometry": Odometry,
}
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
WAITS_S, LINGERS_S = 60.0, 3.0


def messages(path):
    """Return [(topic, type, nanoseconds, bytes)], by time."""
    from mcap.reader import make_reader

    with pathlib.Path(path).open("rb") as file:
        read = make_reader(file).iter_messages()
        found = [(c.topic, s.name, m.log_time, m.data) for s, c, m in read if s.name in SENSORS]
    return [one for one in found if not one[0].startswith(("/sceneslam", "/ground_truth"))]


def restamped(data, origin_ns, now_ns, rate=1.0):
    """Return a message that begins with a header, stamped now where it was stamped the origin."""
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    stamp_ns = round((sec * 10**9 + nanosec - origin_ns) / rate) + now_ns
    made = bytearray(data)
    struct.pack_into("<iI", made, 4, *divmod(stamp_ns, 10**9))
    return bytes(made)


def main(recording, heard_path, rate=1.0):
    rate = float(rate)
    rclpy.init()
    node = rclpy.create_node("robot")
    heard = {"poses": [], "path": [], "map": None, "scenes": [], "modules": []}

    def pose(message):
        at, stamp = message.pose.pose.position, message.header.stamp
        heard["poses"].append([stamp.sec * 10**9 + stamp.nanosec, at.x, at.y, at.z])

    def path(message):
        heard["path"] = [[p.pose.position.x, p.pose.position.y] for p in message.poses]

    def grid(message):
        cells = list(message.data)
        heard["map"] = {
            "size": [message.info.width, message.info.height],
            "occupied": sum(cell > 50 for cell in cells),
            "free": sum(0 <= cell < 50 for cell in cells),
        }

    node.create_subscription(Odometry, "/sceneslam/odometry", pose, 100)
    node.create_subscription(Path, "/sceneslam/path", path, LATCHED)
    node.create_subscription(OccupancyGrid, "/map", grid, LATCHED)
    for topic, words in (("scene", "scenes"), ("module", "modules")):
        node.create_subscription(
            String,
            f"/sceneslam/{topic}",
            lambda m, words=words: heard[words].append(m.data),
            LATCHED,
        )
    drive = messages(recording)
    publishers = {
        topic: node.create_publisher(SENSORS[kind], topic, BEST_EFFORT)
        for topic, kind, _, _ in drive
    }
    # First the beginning again and again, as from a robot that stands, until the run is under way.
    first_ns = drive[0][2]
    opening = [one for one in drive if one[2] - first_ns < 100_000_000]
    until_s = time.monotonic() + WAITS_S
    while not heard["poses"] and time.monotonic() < until_s:
        now_ns, round_s = time.time_ns(), time.monotonic() + 0.1
        for topic, _, _, data in opening:
            publishers[topic].publish(restamped(data, first_ns, now_ns, rate))
        while time.monotonic() < round_s:
            rclpy.spin_once(node, timeout_sec=0.01)
    heard["began_ns"], began_s = time.time_ns(), time.monotonic()
    heard["first_ns"], heard["rate"] = first_ns, rate
    for topic, _, at_ns, data in drive:
        due_s = began_s + (at_ns - first_ns) / 1e9 / rate
        while time.monotonic() < due_s:
            rclpy.spin_once(node, timeout_sec=max(due_s - time.monotonic(), 0.0))
        publishers[topic].publish(restamped(data, first_ns, heard["began_ns"], rate))
    until_s = time.monotonic() + LINGERS_S
    while time.monotonic() < until_s:
        rclpy.spin_once(node, timeout_sec=0.05)
    pathlib.Path(heard_path).write_text(json.dumps(heard))


main(*sys.argv[1:])
