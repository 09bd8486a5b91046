"""Plays a recording's sensor topics through rclpy, with what goes wrong on a real robot.

The steps of a plan, each {"at_s": when, "do": what, ...} on the recording's clock:

    drop     for_s, topics     publishes nothing of these topics (all by default)
    delay    for_s, by_s, topics   publishes them so much later, and what follows not before them
    swap     topics            publishes the next two messages in the wrong order
    restart  for_s             all publishers leave, and come back
    jump     by_s              all stamps are so much off from then on
    say      topic, text | is_on | pose [x, y, yaw]   an operator's word
"""

import heapq
import itertools
import math
import pathlib
import struct
import time

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, LaserScan
from std_msgs.msg import Bool, String
from tf_type import TFMessage

SENSORS = {
    "sensor_msgs/msg/CompressedImage": CompressedImage,
    "sensor_msgs/msg/Image": Image,
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
TF_STATIC = "/tf_static"
WAITS_S, LINGERS_S = 60.0, 2.0
BEGINNING_NS = 100_000_000  # of the recording, repeated until the run reports poses


def play(path, plan):
    """Play; return when the recording's first message was stamped, and how late messages left."""
    rclpy.init()
    node = rclpy.create_node("robot")
    rate = float(plan.get("rate", 1.0))
    drive, fixed = _read(path)
    drive = [_slowed(one, rate) for one in drive]
    robot = _Robot(node, drive, rate=rate, steps=plan.get("steps", ()))
    latched = [node.create_publisher(TFMessage, TF_STATIC, LATCHED) for _ in fixed]
    for publisher, data in zip(latched, fixed, strict=True):
        publisher.publish(data)
    robot.stand_until_heard()
    robot.drive()
    time.sleep(LINGERS_S)
    late_ms = sorted(robot.late_ms)
    return {
        "began_ns": robot.began_ns,
        "first_ns": robot.first_ns,
        "rate": robot.rate,
        "late_ms": [late_ms[len(late_ms) // 2], late_ms[-1]],
    }


def _read(path):
    """Return [(nanoseconds, topic, type, bytes)] of the sensors, and the fixed transforms."""
    from mcap.reader import make_reader

    drive, fixed = [], []
    with pathlib.Path(path).open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            topic = channel.topic
            if topic == TF_STATIC:
                fixed.append(message.data)
            elif schema.name in SENSORS and not topic.startswith(("/sceneslam", "/ground_truth")):
                drive.append((message.log_time, topic, schema.name, message.data))
    return drive, fixed


def _slowed(one, rate):
    """Return a message as a robot that drives at a part of the speed would have measured it."""
    at_ns, topic, kind, data = one
    if SENSORS[kind] is not Imu or rate == 1.0:
        return one
    message = deserialize_message(data, Imu)
    turn, push = message.angular_velocity, message.linear_acceleration
    turn.x, turn.y, turn.z = turn.x * rate, turn.y * rate, turn.z * rate
    push.x, push.y = push.x * rate**2, push.y * rate**2
    return at_ns, topic, kind, serialize_message(message)


class _Robot:
    def __init__(self, node, drive, *, rate, steps):
        self._node, self._drive, self.rate = node, drive, rate
        self._types = {topic: SENSORS[kind] for _, topic, kind, _ in drive}
        self._publishers = {}
        self.first_ns, self.began_ns = drive[0][0], 0
        self._steps, self._jump_ns = steps, 0
        self.late_ms = []
        self._start()
        said = {one["topic"]: type(_word(one)) for one in steps if one["do"] == "say"}
        self._said = {topic: node.create_publisher(kind, topic, 10) for topic, kind in said.items()}

    def stand_until_heard(self):
        """Publish the beginning again and again, as a robot that stands, until poses come."""
        poses = []
        heard = self._node.create_subscription(
            Odometry, "/sceneslam/odometry", poses.append, 10, raw=True
        )
        beginning = [one for one in self._drive if one[0] - self.first_ns < BEGINNING_NS]
        until_s = time.monotonic() + WAITS_S
        while not poses and time.monotonic() < until_s:
            self.began_ns, began_s = time.time_ns(), time.monotonic()
            for at_ns, topic, _, data in beginning:
                due_s = began_s + (at_ns - self.first_ns) / 1e9 / self.rate
                while time.monotonic() < due_s:
                    rclpy.spin_once(self._node, timeout_sec=max(due_s - time.monotonic(), 0))
                self._publish(topic, data)
        self._node.destroy_subscription(heard)

    def drive(self):
        """Publish everything once; `late_ms` are the times by which messages left too late."""
        self.began_ns, began_s = time.time_ns(), time.monotonic()
        number = itertools.count()  # what is due at the same time keeps its order
        due = [
            ((leaves_ns - self.first_ns) / 1e9, next(number), (topic, data))
            for leaves_ns, _, topic, _, data in self._planned()
        ]
        due += [(step["at_s"], next(number), step) for step in self._steps]
        heapq.heapify(due)
        while due:
            at_s, _, what = heapq.heappop(due)
            wait_s = began_s + at_s / self.rate - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            if isinstance(what, tuple):
                self.late_ms.append(max(-wait_s, 0.0) * 1e3)
                self._publish(*what)
            elif what["do"] == "restart":
                self._stop()
                heapq.heappush(due, (at_s + what["for_s"], next(number), {"do": "start"}))
            elif what["do"] == "start":
                self._start()
            elif what["do"] == "jump":
                self._jump_ns += round(what["by_s"] * 1e9)
            elif what["do"] == "say":
                self._say(what)

    def _planned(self):
        """Return the messages without those dropped, in the order in which they leave."""
        planned, last_ns = [], dict.fromkeys(self._types, 0)
        for one in self._drive:
            at_s, topic = (one[0] - self.first_ns) / 1e9, one[1]
            leaves_ns, is_dropped = one[0], False
            for step in self._steps:
                is_meant = topic in step.get("topics", self._types)
                if is_meant and 0 <= at_s - step["at_s"] < step.get("for_s", 0.0):
                    is_dropped |= step["do"] == "drop"
                    leaves_ns += round(step["by_s"] * 1e9) if step["do"] == "delay" else 0
            last_ns[topic] = max(last_ns[topic], leaves_ns)
            if not is_dropped:
                planned.append((last_ns[topic], *one))
        for step in (step for step in self._steps if step["do"] == "swap"):
            at_ns = self.first_ns + round(step["at_s"] * 1e9)
            first, second = [i for i, one in enumerate(planned)
                             if one[1] >= at_ns and one[2] in step["topics"]][:2]  # fmt: skip
            times = planned[first][0], planned[second][0]
            planned[first] = (times[1] + 1, *planned[first][1:])
            planned[second] = (times[0], *planned[second][1:])
        return planned

    def _publish(self, topic, data):
        publisher = self._publishers.get(topic)
        if publisher is not None:
            publisher.publish(self._restamped(data))

    def _restamped(self, data):
        """Return a message that begins with a header as if it had been measured now."""
        sec, nanosec = struct.unpack_from("<iI", data, 4)
        since_ns = round((sec * 10**9 + nanosec - self.first_ns) / self.rate)
        made = bytearray(data)
        stamp_ns = self.began_ns + since_ns + self._jump_ns
        struct.pack_into("<iI", made, 4, *divmod(stamp_ns, 10**9))
        return bytes(made)

    def _start(self):
        self._publishers = {
            topic: self._node.create_publisher(msgtype, topic, BEST_EFFORT)
            for topic, msgtype in self._types.items()
        }

    def _stop(self):
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        self._publishers = {}

    def _say(self, step):
        """Publish an operator's word; its publisher was there before, as an operator's is."""
        self._said[step["topic"]].publish(_word(step))


def _word(step):
    if "text" in step:
        return String(data=step["text"])
    if "is_on" in step:
        return Bool(data=step["is_on"])
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    x, y, yaw = step["pose"]
    message.pose.pose.position.x, message.pose.pose.position.y = float(x), float(y)
    message.pose.pose.orientation.z = math.sin(yaw / 2)
    message.pose.pose.orientation.w = math.cos(yaw / 2)
    return message
