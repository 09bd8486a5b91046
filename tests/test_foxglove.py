"""Foxglove's own protocol against a run: what is shown, what is steered, where it listens."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from foxglove_client import FoxgloveClient
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from test_sink_ros2 import at, seen

from sceneslam.modules.maps.live_map import GridAndPoints
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.sinks.foxglove import FoxgloveSink
from sceneslam.types import se3
from sceneslam.types.command import Pause, SelectScene
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Laser, Rig, Sensor

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed: sceneslam[foxglove]")
S = 1_000_000_000
RIG = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())


def make(**words):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        settings = OmegaConf.to_container(compose("viewer/foxglove").sinks.live)
    settings.pop("_target_")
    mapper = settings.pop("mapper")
    mapper.pop("_target_")
    settings |= {"port": 0, "map_every_s": 0.0, "image_every": 1} | words
    return FoxgloveSink(**settings, mapper=GridAndPoints(**mapper))


@pytest.fixture
def sink(tmp_path):
    made = make()
    made.open(RIG, tmp_path)
    yield made
    made.close()


@pytest.fixture
def client(sink):
    made = FoxgloveClient(int(sink._transport.url.rpartition(":")[2]))
    yield made
    made.close()


def decoded(client, topic):
    schema = client.channels[topic]["schemaName"]
    decoder = MessageDecoder({topic: TopicType.of_network(schema)})
    return decoder.decode(topic, client.message(topic))


def drive(sink, count=3):
    for index in range(count):
        observation = Observation(
            stamp_ns=index * S,
            image_bgr=np.full((6, 8, 3), 90, np.uint8),
            scan=seen(index * S).scan,
            T_odom_base=at(0.5 * index),
        )
        sink.write(observation, at(0.5 * index), "laser")


def until_asked(sink):
    tick = threading.Event()
    for _ in range(200):
        commands = sink.commands()
        if commands:
            return list(commands)
        tick.wait(0.05)
    raise AssertionError("nothing was asked")


def test_topics_are_announced_with_their_definitions(client):
    client.subscribe("/map", "/tf", "/camera/color/image/compressed")
    assert client.channels["/map"]["encoding"] == "cdr"
    assert "OccupancyGrid" in client.channels["/map"]["schemaName"]
    assert "MapMetaData info" in client.channels["/map"]["schema"]


def test_poses_frames_pictures_and_map_are_shown(sink, client):
    client.subscribe("/tf", "/camera/color/image/compressed", "/map", "/sceneslam/odometry")
    tick, is_over = threading.Event(), threading.Event()

    def go():
        for _ in range(100):
            drive(sink)
            if is_over.is_set() or tick.wait(0.1):
                return

    thread = threading.Thread(target=go)
    thread.start()
    frames = {decoded(client, "/tf").transforms[0].child_frame_id for _ in range(2)}
    assert frames == {"odom", "base_link"}
    assert decoded(client, "/camera/color/image/compressed").data[:2].tobytes() == b"\xff\xd8"
    assert decoded(client, "/map").info.width > 0
    assert decoded(client, "/sceneslam/odometry").header.frame_id == "map"
    is_over.set()
    thread.join()


def test_after_a_reset_of_odometry_and_clock_the_robot_is_where_the_map_says(sink, client):
    """The run has smooth odometry and stamps; what is published fits the robot's own."""
    T_smooth_odom, T_map_base = se3.from_xy_yaw(10.0, 0.0, 1.0), at(1.0)
    jump = {"event": "odometry_jump", "stamp_ns": 0, "T_smooth_odom": T_smooth_odom.tolist()}
    sink.write_event(jump)
    sink.write_event({"event": "clock_jump", "stamp_ns": 0, "shift_ns": 100 * S, "paces": True})
    client.subscribe("/tf")
    tick, found = threading.Event(), {}
    for _ in range(100):
        sink.write(Observation(stamp_ns=101 * S, T_odom_base=at(3.0)), T_map_base, "laser")
        tick.wait(0.02)
    while len(found) < 2:
        (one,) = decoded(client, "/tf").transforms
        found[one.child_frame_id] = one
    moves = [found[name].transform for name in ("odom", "base_link")]
    T_map_odom, T_odom_base = (
        se3.from_quat_xyzw(
            np.array([one.translation.x, one.translation.y, one.translation.z]),
            np.array([one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w]),
        )
        for one in moves
    )
    np.testing.assert_allclose(T_map_odom @ T_odom_base, T_map_base, atol=1e-9)
    assert {one.header.stamp.sec for one in found.values()} == {1}


def test_who_connects_late_hears_who_works_and_why(sink, client):
    drive(sink)
    client.subscribe("/sceneslam/module", "/tf_static", "/sceneslam/path")
    assert decoded(client, "/sceneslam/module").data == "laser"
    assert decoded(client, "/tf_static").transforms[0].child_frame_id == "laser"
    client.subscribe("/sceneslam/events")
    sink.write_event({"event": "vote", "stamp_ns": 0})
    event = {"event": "decision", "stamp_ns": 1, "to": "laser", "reason": "scene"}
    tick = threading.Event()
    for _ in range(20):  # until the subscription is there
        sink.write_event(event)
        tick.wait(0.01)
    assert json.loads(decoded(client, "/sceneslam/events").data) == event


def test_panels_steer_by_parameters_and_by_messages(sink, client):
    assert client.parameters() == {"scene": "", "module": "", "paused": False, "save_map": ""}
    client.set_parameter("scene", "Dark")
    assert until_asked(sink) == [SelectScene(scene="Dark")]
    assert client.text("parameterValues")["parameters"]
    client.publish("/sceneslam/pause", "std_msgs/msg/Bool", {"data": True})
    assert until_asked(sink) == [Pause(is_paused=True)]
    client.set_parameter("save_map", "floor1")
    (save,) = until_asked(sink)
    assert save.name == "floor1"


def test_message_of_no_sense_is_left_out(sink, client, caplog):
    client.publish("/sceneslam/pause", "std_msgs/msg/Bool", {"data": "yes"})
    client.publish("/sceneslam/select_scene", "std_msgs/msg/String", {"data": "Bright"})
    assert until_asked(sink) == [SelectScene(scene="Bright")]
    assert "cannot be made of 'yes'" in caplog.text


def test_port_in_use_and_impossible_settings_are_refused(sink, tmp_path):
    port = int(sink._transport.url.rpartition(":")[2])
    with pytest.raises(ConfigError, match="a port that is free"):
        make(port=port).open(RIG, tmp_path)
    for key, value in (("port", 80), ("image_every", 0), ("jpeg_quality", 101)):
        with pytest.raises(ConfigError, match=key):
            make(**{key: value})


def test_layout_lies_in_the_runs_folder_and_names_topics_that_there_are(sink, tmp_path, client):
    text = (tmp_path / "foxglove_layout.json").read_text()
    layout = json.loads(text)
    client.subscribe("/sceneslam/path")
    for topic in layout["configById"]["3D!map"]["topics"]:
        assert topic in client.channels
    assert json.dumps(layout["layout"]).count("!") == len(layout["configById"])


def test_it_listens_on_this_machine_only(sink):
    assert sink._transport.url.startswith("ws://127.0.0.1:")
    port = int(sink._transport.url.rpartition(":")[2])
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    assert {row[1] for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"} == {
        f"0100007F:{port:04X}"
    }
