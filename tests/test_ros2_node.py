"""A SLAM node of ROS 2 as a module: it answers over DDS, from a process of its own."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from isolation import limits
from omegaconf import OmegaConf
from rosbags.typesys import Stores, get_typestore

from sceneslam.config.check import check_node
from sceneslam.config.echo import check_echo
from sceneslam.modules.slam.process.client import LOST, TRACKING
from sceneslam.modules.slam.process.fields import observation_fields
from sceneslam.modules.slam.ros2_node.client import NodeClient
from sceneslam.modules.slam.ros2_node.listener import NodeListener, moved
from sceneslam.modules.slam.ros2_node.module import NodeTopics, Ros2Node
from sceneslam.ros import decode, names
from sceneslam.ros.encode import Encoder
from sceneslam.ros.encode_results import ResultEncoder
from sceneslam.ros.transport.transport import Arrival, Network
from sceneslam.testing import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError, ModuleError
from sceneslam.types.maps import GridLayer
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Sensor

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install sceneslam[ros2]")
NODE = Path(__file__).with_name("ros2_odometry_node.py")
NONE = dict.fromkeys(("image", "camera_info", "depth", "scan", "points", "imu", "map"))


def build(behaviour, **changes):
    domain_id = 100 + (os.getpid() + 50) % 100
    command = [sys.executable, str(NODE), str(domain_id), behaviour]
    values = {
        "command": command,
        "needs": ["odometry"],
        "topics": NodeTopics(**NONE, odometry="/odom", pose="/slam/pose"),
        "pose_kind": "odometry",
        "map_kind": "grid",
        "pose_frame": "base",
        "answer_s": 0.5,
        "tf_age_max_s": 1.0,
        "deviation_max_m": 1.0,
        "network": Network(domain_id=domain_id),
        "late_max_s": 0.5,
        "limits": limits(),
        "closes_loops": False,
    }
    return Ros2Node(**(values | changes))


@contextmanager
def active(behaviour, **changes):
    module = build(behaviour, **changes)
    module.activate(RIG)
    try:
        yield module
    finally:
        module.note_failure()


def drive(module, until, *, count=200):
    """Return what it answers, until one is as it should be."""
    found = []
    for index in range(count):
        found.append(module.track(room_observation(index)))
        if until(found[-1]):
            break
    return found


def test_a_node_that_answers_is_tracked_from_where_odometry_began():
    with active("good") as module:
        found = drive(module, lambda one: one.status is TrackingStatus.TRACKING)
        assert found[-1].status is TrackingStatus.TRACKING
        assert {one.status for one in found[:-1]} <= {TrackingStatus.DEGRADED, TrackingStatus.LOST}
        T_first = room_observation(0).T_odom_base
        T_true = se3.inverse(T_first) @ room_observation(len(found) - 1).T_odom_base
        np.testing.assert_allclose(found[-1].T_local_base, T_true, atol=1e-6)
        silent = module.track(replace(room_observation(len(found)), T_odom_base=None))
        assert silent.status is not TrackingStatus.TRACKING  # the node had nothing to answer


def test_a_node_that_is_silent_is_lost_after_late_max_s():
    module = build("silent", answer_s=0.01)
    module.activate(RIG)
    found = drive(module, lambda one: one.status is TrackingStatus.LOST, count=40)
    module.note_failure()
    assert found[-1].status is TrackingStatus.LOST and 14 <= len(found) <= 18  # 0.5 s at 30 Hz


def test_a_node_that_is_unsure_is_lost():
    with active("unsure") as module:
        began_s = monotonic()
        statuses = []
        for index in range(15):  # before late_max_s is over
            statuses.append(module.track(room_observation(index)).status)
            if statuses[-1] is TrackingStatus.LOST or monotonic() - began_s > 20:
                break
        assert statuses[-1] is TrackingStatus.LOST


def answered(said):
    """Return the client's poses and statuses for what a node said of a robot at rest."""
    client = NodeClient({"topics": NONE, "needs": ["scan"], "deviation_max_m": 1.0})
    client._T_frame_base = np.eye(4)
    client._sent = dict.fromkeys(said)
    client._first = (min(said), None)
    reply = client._answer(said)
    return dict(zip(reply["stamps_ns"].tolist(), reply["T_local_base"], strict=True)), reply[
        "status"
    ].tolist()


@pytest.mark.parametrize("first_ns", [0, -(10**9)])
def test_a_pose_at_any_first_stamp_counts(first_ns):
    T_world_base = {first_ns: se3.from_xy_yaw(3.0, 1.0, 0.5), 10**8: se3.from_xy_yaw(4.0, 1.0, 0.5)}
    found, statuses = answered({ns: (T, 0.1) for ns, T in T_world_base.items()})
    assert list(found) == [first_ns, 10**8] and statuses == [TRACKING, TRACKING]
    np.testing.assert_allclose(found[first_ns], np.eye(4), atol=1e-12)


@pytest.mark.parametrize("deviation_m", [100.0, np.nan])
def test_local_is_where_the_node_first_knows_the_pose(deviation_m):
    nowhere, T_world_base = se3.from_xy_yaw(50.0, 0.0, 1.0), se3.from_xy_yaw(3.0, 1.0, 0.5)
    found, statuses = answered({1: (nowhere, deviation_m), 2: (T_world_base, 0.1)})
    assert statuses == [LOST, TRACKING]
    np.testing.assert_allclose(found[2], np.eye(4), atol=1e-12)


class TfNode:
    """A client whose node publishes map -> odom without DDS, and whose robot is 50 m from odom."""

    T_odom_base = se3.from_xy_yaw(50.0, 0.0, 0.3)

    def __init__(self, **settings):
        self._heard, self._stamp_ns = {}, 0
        transport = SimpleNamespace(
            subscribe=lambda topic, kind, hear, qos: self._heard.update({topic: hear}),
            publisher=lambda *topic: SimpleNamespace(publish=lambda cdr: None),
        )
        topics = dict.fromkeys((*NONE, "odometry", "pose"))
        kinds = {"pose_kind": "tf", "map_kind": "grid", "needs": ["odometry"], "topics": topics}
        values = {"deviation_max_m": 1.0, "closes_loops": True, "tf_age_max_s": 1.0}
        values |= kinds | settings
        self._client = NodeClient(values)
        self._client._transport, self._client._camera = transport, None
        self._client._T_frame_base = np.eye(4)
        self._client._heard = NodeListener(transport, values)

    def publish(self, T_map_odom):
        cdr = Encoder().transforms(0, "map", {"odom": T_map_odom})
        self._heard["/tf"](Arrival(topic="/tf", cdr=cdr, arrived_ns=0))

    def track(self, after_s=0.1):
        self._stamp_ns += round(after_s * 1e9)
        observation = {"stamp_ns": np.array(self._stamp_ns), "T_odom_base": self.T_odom_base}
        return self._client.track(observation)


@pytest.mark.parametrize(("closes_loops", "counted"), [(True, [0, 0, 1, 1, 2]), (False, [0] * 5)])
def test_a_jump_of_map_to_odom_is_a_revision_of_a_node_that_closes_loops(closes_loops, counted):
    node, found = TfNode(closes_loops=closes_loops), []
    for x_m, yaw_deg, after_s in (
        (0.0, 0.0, 0.1),
        (0.05, 0.0, 0.1),
        (0.85, 0.0, 0.1),
        (0.85, 0.5, 5.0),
        (0.85, 3.5, 0.1),
    ):
        T_turn = se3.from_xy_yaw(0.0, 0.0, np.radians(yaw_deg))  # about the robot, not about odom
        T_map_base = se3.from_xy_yaw(x_m, 0.0, 0.0) @ node.T_odom_base @ T_turn
        node.publish(T_map_base @ se3.inverse(node.T_odom_base))
        found.append(int(node.track(after_s)["revision"]))
    assert found == counted


@pytest.mark.parametrize(
    ("x_m", "after_s", "counted"),
    [
        ([0.0, 0.5, 0.0, 0.5, 0.0], 0.5, [0, 1, 1, 1, 1]),  # it flaps: no loop closes so often
        ([0.0, 0.1, 0.2, 0.3, 0.4], 1.0, [0, 0, 0, 0, 0]),  # slip between poses a second apart
        ([0.0, 0.1, 0.1, 0.1, 0.1], 0.1, [0, 1, 1, 1, 1]),
    ],
)
def test_a_jump_soon_after_another_or_no_larger_than_slip_is_no_revision(x_m, after_s, counted):
    node, found = TfNode(), []
    for shift_m in x_m:
        node.publish(se3.from_xy_yaw(shift_m, 0.0, 0.0))
        found.append(int(node.track(after_s)["revision"]))
    assert found == counted


@pytest.mark.parametrize(("tf_age_max_s", "is_kept"), [(1.0, False), (None, True)])
def test_a_node_that_stops_publishing_tf_gives_no_poses(monkeypatch, tf_age_max_s, is_kept):
    clock = SimpleNamespace(now_s=100.0)
    listener = "sceneslam.modules.slam.ros2_node.listener"
    monkeypatch.setattr(f"{listener}.monotonic", lambda: clock.now_s)
    node = TfNode(tf_age_max_s=tf_age_max_s)

    def count(now_s):
        clock.now_s = now_s
        return len(node.track()["stamps_ns"])

    assert count(100.0) == 0  # nothing was published
    node.publish(np.eye(4))
    assert [count(100.9), count(101.1)] == [1, is_kept]
    node.publish(np.eye(4))
    assert count(101.2) == 1


def test_a_node_that_answers_sweeps_by_their_headers_has_a_pose_for_each():
    """The middle of a sweep is 50 ms after the observation, as of a scan with time_increment."""
    heard, headers_ns = {}, []
    store = get_typestore(Stores.ROS2_HUMBLE)

    def answer(cdr):
        message = store.deserialize_cdr(cdr, "sensor_msgs/msg/LaserScan")
        headers_ns.append(decode.stamp_ns(message))
        pose = Encoder().odometry(headers_ns[-1], np.eye(4), names.MAP)
        heard["/pose"](Arrival(topic="/pose", cdr=pose, arrived_ns=0))

    transport = SimpleNamespace(
        subscribe=lambda topic, kind, hear, qos: heard.update({topic: hear}),
        publisher=lambda *topic: SimpleNamespace(publish=answer),
    )
    settings = {"pose_kind": "odometry", "map_kind": "grid", "needs": ["scan"], "answer_s": 0.01}
    settings |= {"topics": NONE | {"scan": "/scan", "pose": "/pose"}, "deviation_max_m": 1.0}
    client = NodeClient(settings)
    client._transport, client._camera, client._T_frame_base = transport, None, np.eye(4)
    client._heard = NodeListener(transport, settings)
    scan = replace(room_observation(0).scan, stamp_ns=150_000_000)
    reply = client.track(observation_fields(Observation(stamp_ns=100_000_000, scan=scan)))
    assert headers_ns == reply["stamps_ns"].tolist() == [100_000_000]


def test_a_node_is_started_on_the_domain_of_its_module():
    ends = "import os, sys; sys.exit(int(os.environ['ROS_DOMAIN_ID']))"
    settings = {"command": [sys.executable, "-c", ends], "network": Network(domain_id=7)}
    with active("", **settings) as module, pytest.raises(ModuleError, match="node ended with 7"):
        drive(module, lambda found: False)


CONF = Path(__file__).resolve().parents[1] / "conf"


@pytest.mark.parametrize(
    ("changes", "is_echo"),
    [
        ({}, True),
        ({"domain_id": 3}, True),  # as ROS_DOMAIN_ID
        ({"domain_id": 4}, False),
        ({"map_frame": "sceneslam_map"}, False),
        ({"map_frame": "sceneslam_map", "map": "/map"}, True),
        ({"pose_kind": "odometry"}, False),
        ({"pose_kind": "odometry", "map": "/map"}, True),
    ],
)
def test_a_sink_does_not_publish_on_the_nodes_domain_what_is_read_from_the_node(
    monkeypatch, changes, is_echo
):
    monkeypatch.setenv("ROS_DOMAIN_ID", "3")
    node = yaml.safe_load((CONF / "slam/ros2_node.yaml").read_text())
    sink = yaml.safe_load((CONF / "sinks/ros2.yaml").read_text())
    for key, value in changes.items():
        {"map": node["topics"], "pose_kind": node}.get(key, sink)[key] = value
    named = r"slam\.only\.network\.domain_id.*sinks\.robot\.domain_id"
    with pytest.raises(ConfigError, match=named) if is_echo else nullcontext():
        check_echo({"only": node}, {"robot": sink})


def test_a_node_that_ends_ends_the_session_with_a_sentence():
    with active("ends") as module, pytest.raises(ModuleError, match="the node ended"):
        for index in range(300):
            module.track(room_observation(index))
            sleep(0.01)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("command", ["no-such-program"]),
        ("pose_kind", "twist"),
        ("pose_frame", "laser"),
        ("needs", ["sonar"]),
        ("answer_s", 0.0),
        ("tf_age_max_s", 0.0),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(key, value):
    with pytest.raises(ConfigError, match=key):
        build("good", **{key: value})


def test_a_pose_by_tf_is_that_of_base():
    with pytest.raises(ConfigError, match=r"pose_frame: got 'camera', allowed: base"):
        build("good", pose_kind="tf", pose_frame="camera")


def test_a_pose_of_a_camera_that_the_rig_does_not_have_is_named():
    module = build("good", pose_frame="camera")
    try:
        with pytest.raises(ConfigError, match=r"pose_frame: got 'camera', allowed: base"):
            module.activate(replace(RIG, camera=None, sensors=frozenset({Sensor.ODOMETRY})))
    finally:
        module.note_failure()


@pytest.mark.parametrize("preset", ["slam_toolbox", "cartographer", "rtabmap", "orb_slam3"])
def test_a_preset_is_a_whole_configuration(preset):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        overrides = ["+scenario=single", f"slam@slam.only=ros2/{preset}"]
        if preset == "orb_slam3":
            overrides.append("slam.only.command=[my_orb_slam]")
        node = compose("config", overrides=overrides).slam.only
    plain = OmegaConf.to_container(node, resolve=True)
    program = plain["command"][0]
    with pytest.raises(ConfigError, match=rf"allow_targets=\[{program}\]"):
        check_node(plain, "slam.only", allow=[])
    node.command = ["true"]  # the real one is not installed here
    assert isinstance(instantiate(node, _convert_="all"), Ros2Node)


def listened(T_world_grid):
    """Return the map that a listener has after a grid of one cell at a pose."""
    heard = {}
    transport = SimpleNamespace(
        subscribe=lambda topic, kind, hear, qos: heard.update({topic: hear})
    )
    topics = NONE | {"pose": "/pose", "map": "/map"}
    listener = NodeListener(transport, {"topics": topics, "pose_kind": "pose", "map_kind": "grid"})
    cell = GridLayer(log_odds=np.ones((1, 1)), resolution_m=0.05, origin_xy_m=(0.0, 0.0))
    encoder, kind = ResultEncoder(), "nav_msgs/msg/OccupancyGrid"
    message = encoder._store.deserialize_cdr(encoder.grid(0, cell, "map"), kind)
    message.info.origin = encoder._pose(T_world_grid)
    cdr = bytes(encoder._store.serialize_cdr(message, kind))
    heard["/map"](Arrival(topic="/map", cdr=cdr, arrived_ns=0))
    return listener.map()


def test_a_grid_that_is_rotated_in_its_map_is_refused():
    origin_xy_m = listened(se3.from_xy_yaw(1.0, 2.0, 0.0))["grid.origin_xy_m"]
    np.testing.assert_allclose(origin_xy_m, [1.0, 2.0])
    with pytest.raises(InputError, match=r"grid: expected the orientation 0 0 0 1 .* got 0 0 0.14"):
        listened(se3.from_xy_yaw(1.0, 2.0, 0.3))


def test_a_grid_is_moved_unless_it_would_have_to_be_turned():
    grid = {
        "grid.log_odds": np.zeros((2, 3), np.float32),
        "grid.resolution_m": np.array(0.05),
        "grid.origin_xy_m": np.array([1.0, 2.0]),
    }
    found = moved(grid, se3.from_xy_yaw(0.5, -0.5, 0.0))
    np.testing.assert_allclose(found["grid.origin_xy_m"], [1.5, 1.5])
    assert moved(grid, se3.from_xy_yaw(0.0, 0.0, 0.3)) == {}
