"""A robot as a source: what is heard, what is missing, who is silent, whose clock jumps."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from dataclasses import replace
from time import monotonic_ns

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sceneslam.ros import names
from sceneslam.ros.encode import Encoder
from sceneslam.ros.transport.transport import Arrival, Publication, Qos
from sceneslam.sources.ros2 import source as under_test
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Camera, Sensor

MS, S = 1_000_000, 1_000_000_000
IMAGE, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"
PICTURE = "sensor_msgs/msg/Image"
TYPES = {
    IMAGE: PICTURE,
    DEPTH: PICTURE,
    INFO: "sensor_msgs/msg/CameraInfo",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/odom": "nav_msgs/msg/Odometry",
    "/wheels": "nav_msgs/msg/Odometry",
    "/fused": "nav_msgs/msg/Odometry",
    "/imu": "sensor_msgs/msg/Imu",
    names.TF: "tf2_msgs/msg/TFMessage",
    names.TF_STATIC: "tf2_msgs/msg/TFMessage",
    "/husky/scan": "sensor_msgs/msg/LaserScan",
    "/husky/tf_static": "tf2_msgs/msg/TFMessage",
    "/uav1/scan": "sensor_msgs/msg/LaserScan",
    "/uav1/tf_static": "tf2_msgs/msg/TFMessage",
    "/chatter": "std_msgs/msg/String",
}
CAMERA = Camera(size_wh=(8, 6), fx=5.0, fy=5.0, cx=4.0, cy=3.0)
T_BASE_LASER = se3.from_parts(np.eye(3), np.array([0.2, 0.0, 0.3]))


class Robot:
    """A transport whose other side is driven by the test; stamps are what it says."""

    def __init__(self, *topics):
        self.encoder, self._heard, self.is_closed = Encoder(), {}, False
        self.qos = {}
        self.mounts = {names.LASER: T_BASE_LASER, names.CAMERA: se3.identity()}
        self.root_mounts, self.root_is_latched = None, True
        self.tf_frame, self.tf_ahead_m = names.ODOM, 0.0
        self.inertial = {Sensor.GYRO: np.array([0.0, 0.0, 0.5])}
        self._topics = {topic: TYPES[topic] for topic in topics}
        for topic in topics:  # what serialises a type is made at its first message
            self._message(self.encoder, topic, 0)

    def publications(self):
        return [
            Publication(topic=topic, msgtype=kind, is_latched=self._is_latched(topic))
            for topic, kind in self._topics.items()
        ]

    def subscribe(self, topic, msgtype, heard, qos=None):
        assert TYPES[topic] == msgtype
        self._heard[topic], self.qos[topic] = heard, qos

    def unsubscribe(self, topic):
        self._heard.pop(topic, None)

    def publisher(self, topic, msgtype, qos=None):
        raise AssertionError("a source says nothing")

    def close(self):
        self.is_closed = True

    def send(self, topic, cdr, *, to=object, publisher=0, arrived_ns=None):
        """Deliver a message, to a listener of the class `to` alone."""
        listener = self._heard.get(topic)
        if listener is not None and isinstance(listener.__self__, to):
            came_ns = monotonic_ns() if arrived_ns is None else arrived_ns
            listener(Arrival(topic=topic, cdr=cdr, arrived_ns=came_ns, publisher=publisher))

    def measure(self, stamp_ns, *, without=(), **how):
        """Send what every topic would at one instant, at which all of it arrives."""
        how = {"arrived_ns": monotonic_ns()} | how
        for topic in [one for one in self._topics if one not in without]:
            self.send(topic, self._message(self.encoder, topic, stamp_ns), **how)

    def _is_latched(self, topic):
        is_root = topic == names.TF_STATIC
        return self.root_is_latched if is_root else topic.endswith(names.TF_STATIC)

    def _message(self, encoder, topic, stamp_ns):
        x_m = stamp_ns / S
        if topic in ("/odom", "/wheels", "/fused"):
            T_odom_base = se3.from_parts(np.eye(3), np.array([x_m, 0.0, 0.0]))
            return encoder.odometry(stamp_ns, T_odom_base, names.ODOM)
        if topic == names.TF:
            T_odom_base = se3.from_xy_yaw(x_m + self.tf_ahead_m, 0.0, 0.0)
            return encoder.transforms(stamp_ns, self.tf_frame, {names.BASE: T_odom_base})
        if topic == "/imu":
            return encoder.imu(stamp_ns, self.inertial)
        if topic.endswith("/scan"):
            return encoder.scan(stamp_ns, scan(stamp_ns))
        if topic == INFO:
            return encoder.camera_info(stamp_ns, CAMERA)
        if topic.endswith(names.TF_STATIC):
            is_root = topic == names.TF_STATIC
            mounts = self.root_mounts if is_root and self.root_mounts else self.mounts
            return encoder.transforms(stamp_ns, names.BASE, mounts)
        if topic == IMAGE:
            return encoder.image(stamp_ns, np.full((6, 8, 3), 7, np.uint8), "bgr8")
        return encoder.image(stamp_ns, np.full((6, 8, 1), 2000, np.uint16), "16UC1")


def scan(stamp_ns):
    return LaserScan(
        stamp_ns=stamp_ns,
        ranges_m=np.ones(5, np.float32),
        angle_min_rad=0.0,
        angle_step_rad=0.1,
        range_min_m=0.1,
        range_max_m=10.0,
    )


@pytest.fixture(scope="module")
def config():
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        return OmegaConf.to_container(compose("source/ros2").source)


@pytest.fixture
def make(monkeypatch, config):
    config = {key: value for key, value in config.items() if key != "_target_"}
    quick = {"listen_s": 0.05, "wait_s": 0.5, "silent_after_s": 0.3}

    def made(robot, **words):
        monkeypatch.setattr(under_test, "open_transport", lambda network: robot)
        topics = config["topics"] | words.pop("topics", {})
        return under_test.Ros2(**(config | quick | words | {"topics": topics}))

    return made


@contextmanager
def talking(robot):
    """Measure every 10 ms while a source listens to what there is, and nothing once it follows."""
    is_over = threading.Event()

    def talk():
        while not is_over.wait(0.01):
            robot.measure(monotonic_ns(), to=under_test.LiveRecording)

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def heard(source, robot):
    with talking(robot):
        return source.rig


ALL = (IMAGE, DEPTH, INFO, "/scan", "/odom", "/imu", names.TF_STATIC)


def test_rig_is_what_is_heard(make):
    robot = Robot(*ALL, "/chatter")
    rig = heard(make(robot), robot)
    assert rig.sensors == {
        Sensor.IMAGE, Sensor.DEPTH, Sensor.SCAN, Sensor.ODOMETRY, Sensor.GYRO,
    }  # fmt: skip
    assert rig.camera.size_wh == (8, 6)
    np.testing.assert_allclose(rig.laser.T_base_laser, T_BASE_LASER)


@pytest.mark.parametrize("force_mps2", [0.0, 9.81])
def test_imu_that_is_zero_while_the_robot_stands_is_in_the_rig(make, force_mps2):
    """Of a simulated robot, it may turn later."""
    robot = Robot("/scan", "/imu")
    inertial = {Sensor.GYRO: np.zeros(3), Sensor.ACCELEROMETER: np.array([0.0, 0.0, force_mps2])}
    robot.inertial = inertial
    assert heard(make(robot), robot).sensors == {Sensor.SCAN, *inertial}


def test_many_messages_are_kept_of_topics_with_samples_alone(make):
    robot = Robot(*ALL)
    heard(make(robot), robot)
    assert {topic for topic, qos in robot.qos.items() if qos is Qos.SAMPLES} == {"/imu", "/odom"}


def test_first_observation_is_one_that_every_stream_was_there_for(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    now_ns = monotonic_ns()
    for index in range(6):
        robot.measure(now_ns + index * 33 * MS, without=(DEPTH, "/imu") if index < 2 else ())
    first = next(one for one in source if one.stamp_ns >= now_ns)
    assert first.stamp_ns == now_ns + 66 * MS and first.has(Sensor.DEPTH)


def test_messages_from_which_topics_were_chosen_do_not_stay_in_memory(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    assert source.survey().streams and list(source.heard.messages(ALL))
    drive(robot, 4)
    next(iter(source))
    assert not list(source.heard.messages(ALL))


def test_observation_holds_what_was_measured_at_its_stamp(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    now_ns = monotonic_ns()
    for index in range(4):
        robot.measure(now_ns + index * 33 * MS)
    observations = (one for one in source if one.stamp_ns >= now_ns)
    taken = [next(observations) for _ in range(3)]
    assert [one.stamp_ns - now_ns for one in taken] == [0, 33 * MS, 66 * MS]
    for one in taken:
        assert one.image_bgr[0, 0, 0] == 7 and one.depth_m[0, 0] == 2.0
        np.testing.assert_allclose(one.T_odom_base[0, 3], one.stamp_ns / S)
        assert one.gyro_base[-1, 3] == 0.5
    source.close()
    assert list(observations) == [] and robot.is_closed


def test_scan_takes_the_place_of_images_that_fall_silent(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    over = threading.Event()

    def drive():
        for index in range(1000):
            robot.measure(monotonic_ns(), without=(IMAGE, DEPTH) if index > 5 else ())
            if over.wait(0.02):
                return

    thread = threading.Thread(target=drive)
    thread.start()
    for observation in source:
        if observation.image_bgr is None:
            break
    over.set()
    thread.join()
    source.close()
    assert observation.scan is not None and observation.T_odom_base is not None
    silent = {one["topic"] for one in source.notices() if one["event"] == "stream_silent"}
    assert silent >= {IMAGE, DEPTH}


def taken(source, count):
    """Return so many observations, and end the source."""
    observations = iter(source)
    found = [next(observations) for _ in range(count)]
    source.close()
    return found


def drive(robot, count, *, begin_ns=None, **words):
    now_ns = monotonic_ns() if begin_ns is None else begin_ns
    for index in range(count):
        robot.measure(now_ns + index * 33 * MS, **words)
    return now_ns


def told(source, event):
    return [one for one in source.notices() if one["event"] == event]


def test_topic_of_two_types_is_read_as_the_one_that_serves_and_named(make):
    robot = Robot(*ALL)
    text = Publication(topic="/scan", msgtype="std_msgs/msg/String")
    right = robot.publications()
    robot.publications = lambda: [text, *right]
    source = make(robot)
    assert Sensor.SCAN in heard(source, robot).sensors
    (odd,) = source.survey().odd
    assert "/scan is published as std_msgs/msg/String too" in odd
    drive(robot, 3)
    taken(source, 1)
    (event,) = told(source, "wrong_type")
    assert event["topic"] == "/scan" and event["type"] == "std_msgs/msg/String"


def test_usual_topic_of_another_type_is_named(make):
    robot = Robot(IMAGE, INFO)
    text = Publication(topic="/scan", msgtype="std_msgs/msg/String")
    right = robot.publications()
    robot.publications = lambda: [text, *right]
    source = make(robot)
    assert Sensor.SCAN not in heard(source, robot).sensors
    assert any("/scan is std_msgs/msg/String" in one for one in source.survey().odd)


def test_second_publisher_of_a_topic_is_named_and_not_mixed_in(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    now_ns = drive(robot, 2)
    other = robot.encoder.image(now_ns + 50 * MS, np.full((6, 8, 3), 99, np.uint8), "bgr8")
    robot.send(IMAGE, other, publisher=5)
    drive(robot, 3, begin_ns=now_ns + 66 * MS)
    found = taken(source, 4)
    assert {one.image_bgr[0, 0, 0] for one in found} == {7}
    (event,) = told(source, "second_publisher")
    assert event["topic"] == IMAGE


def test_calibration_that_comes_late_is_waited_for(make):
    robot = Robot(*ALL)
    source = make(robot, wait_s=5.0)
    robot._topics = {topic: kind for topic, kind in robot._topics.items() if topic != INFO}
    timer = threading.Timer(0.5, lambda: robot._topics.update({INFO: TYPES[INFO]}))
    timer.start()
    assert heard(source, robot).camera.fx == CAMERA.fx
    timer.join()


def test_calibration_that_changes_is_named_and_the_run_goes_on(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    drive(robot, 2)
    robot.send(INFO, robot.encoder.camera_info(1, replace(CAMERA, fx=9.0)))
    drive(robot, 3, without=(INFO,))
    taken(source, 3)
    (event,) = told(source, "camera_info_changed")
    assert event["fx"] == 9.0


def test_robot_in_a_namespace_has_its_own_transforms(make):
    robot = Robot("/husky/scan", "/husky/tf_static")
    source = make(robot)
    np.testing.assert_allclose(heard(source, robot).laser.T_base_laser, T_BASE_LASER)
    assert not list(source.survey().odd)
    moved = {names.LASER: se3.identity()}
    robot.send("/husky/tf_static", robot.encoder.transforms(1, names.BASE, moved))
    source.close()
    assert [one["event"] for one in source.notices()] == ["tf_changed"]


def test_two_robots_that_name_a_frame_alike_move_nothing(make):
    robot = Robot(names.TF_STATIC, "/uav1/tf_static", "/uav1/scan")
    robot.root_mounts = {names.LASER: se3.identity()}
    source = make(robot)
    np.testing.assert_allclose(heard(source, robot).laser.T_base_laser, T_BASE_LASER)
    robot.measure(1, without=("/uav1/scan",))
    source.close()
    assert not list(source.notices())


@pytest.mark.parametrize(
    ("topics", "how", "says"),
    [
        (("/odom",), {}, None),
        (("/odom",), {"tf_ahead_m": 0.5}, "in 'odom' and /odom has other poses: choose"),
        (("/odom",), {"tf_frame": "fused"}, "in 'fused' and /odom is in frame 'odom': choose"),
        ((), {}, "in 'odom' and no odometry is used: map -> base_link would be a second parent"),
    ],
)
def test_odometry_that_is_not_that_of_the_transforms_is_named(make, topics, how, says):
    robot = Robot("/scan", names.TF, *topics)
    vars(robot).update(how)
    source = make(robot)
    heard(source, robot)
    odd = list(source.survey().odd)
    assert [f"/tf has 'base_link' {says}" in one for one in odd] == ([True] if says else [])


def test_of_several_topics_of_odometry_the_one_of_the_transforms_is_to_be_chosen(make):
    robot = Robot("/scan", "/wheels", "/fused", names.TF)
    with pytest.raises(InputError, match="the one that is odom -> base_link on /tf"):
        heard(make(robot), robot)


def test_every_topic_of_transforms_has_to_be_latched(make):
    robot = Robot(names.TF_STATIC, "/uav1/tf_static", "/uav1/scan")
    robot.root_is_latched = False
    source = make(robot)
    heard(source, robot)
    assert ["transient local" in one for one in source.survey().odd] == [True]


def test_transforms_that_move_or_come_late_are_named(make):
    robot = Robot(*ALL)
    robot.mounts = {names.LASER: T_BASE_LASER}  # nobody says where the camera sits
    source = make(robot)
    heard(source, robot)
    moved = {names.LASER: se3.identity(), names.CAMERA: se3.identity()}
    robot.send(names.TF_STATIC, robot.encoder.transforms(1, names.BASE, moved))
    source.close()
    events = [(one["event"], one["frames"]) for one in source.notices()]
    assert events == [("tf_late", [names.CAMERA]), ("tf_changed", [names.LASER])]


@pytest.mark.parametrize(
    ("picture", "encoding", "says"),
    [
        (np.zeros((12, 16, 3), np.uint8), "bgr8", "has 16x12 pixels"),
        (np.zeros((6, 8, 3), np.uint8), "cmyk8", "image encoding: got 'cmyk8'"),
    ],
)
def test_image_that_cannot_be_used_is_named_and_the_run_goes_on(make, picture, encoding, says):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    now_ns = drive(robot, 2)
    robot.send(IMAGE, robot.encoder.image(now_ns + 66 * MS, picture, encoding))
    robot.measure(now_ns + 66 * MS, without=(IMAGE,))
    drive(robot, 3, begin_ns=now_ns + 99 * MS)
    assert any(one.stamp_ns > now_ns + 66 * MS for one in taken(source, 4))
    (event,) = told(source, "left_out")
    assert says in event["what"]


def test_depth_of_another_size_than_the_image_is_named_once_and_left_out(make):
    robot = Robot(*ALL)
    of_own_topic = robot._message

    def message(encoder, topic, stamp_ns):
        if topic == DEPTH:
            return encoder.image(stamp_ns, np.full((3, 4, 1), 2000, np.uint16), "16UC1")
        return of_own_topic(encoder, topic, stamp_ns)

    robot._message = message
    source = make(robot)
    heard(source, robot)
    drive(robot, 4)
    found = taken(source, 3)
    assert all(one.image_bgr is not None and one.depth_m is None for one in found)
    (event,), (fault,) = told(source, "left_out"), source.faults
    assert event["what"] == "a depth image was left out, it has 4x3 pixels, not 8x6"
    assert "3 times" in fault or "4 times" in fault


def test_damaged_message_is_named_and_the_run_goes_on(make):
    robot = Robot(*ALL)
    source = make(robot)
    heard(source, robot)
    now_ns = drive(robot, 2)
    robot.send("/scan", b"\x00\x01\x00\x00broken")
    drive(robot, 3, begin_ns=now_ns + 66 * MS)
    taken(source, 4)
    (event,) = told(source, "left_out")
    assert "/scan" in event["what"]


def test_robot_that_stamps_nothing_is_followed_by_when_messages_come(make):
    robot = Robot(IMAGE, DEPTH, INFO, "/odom")
    source = make(robot)
    heard(source, robot)
    now_ns = monotonic_ns()
    for index in range(5):
        robot.measure(0, arrived_ns=now_ns + index * 33 * MS)
    stamps_ns = [one.stamp_ns for one in taken(source, 3)]
    assert stamps_ns == sorted(set(stamps_ns))
    assert {one["topic"] for one in told(source, "unstamped")}


def test_topic_that_is_named_and_not_heard_is_named_with_what_is_there(make):
    robot = Robot(IMAGE)
    source = make(robot, topics={"image": "/front/image"})
    with talking(robot), pytest.raises(InputError, match=r"nothing on /front/image within 0.5 s"):
        _ = source.rig
    assert robot.is_closed


def test_topic_that_is_announced_and_silent_is_said_to_be_so(make):
    with pytest.raises(InputError, match=r"there is /scan \(sensor_msgs/msg/LaserScan, silent\)"):
        _ = make(Robot("/scan")).rig


def test_where_nobody_is_it_says_where_it_listened(make):
    with pytest.raises(InputError, match=r"domain 5 \(localhost.*nobody publishes a sensor"):
        _ = make(Robot(), domain_id=5).rig


def test_depth_without_intrinsics_says_what_to_give(make):
    robot = Robot(DEPTH)
    with pytest.raises(InputError, match="depth without intrinsics"):
        heard(make(robot), robot)


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ({"wait_s": 0.01}, "wait_s"),
        ({"listen_s": 0.0}, "listen_s"),
        ({"topics": {"sonar": "/x"}}, "topics.sonar"),
        ({"transport": "mqtt"}, "transport"),
    ],
)
def test_impossible_settings_are_refused(make, words, key):
    with pytest.raises(ConfigError, match=key):
        make(Robot(), **words)
