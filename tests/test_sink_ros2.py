"""What a robot hears of a run: REP-105's tree, paths, maps; and what its operator may ask."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from configured import config
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from test_source_ros2 import CAMERA, scan

from sceneslam.app import run
from sceneslam.engine.steering import Operator
from sceneslam.executors import InStep
from sceneslam.modules.maps.live_map import GridAndPoints
from sceneslam.ros import decode
from sceneslam.ros.encode_results import ResultEncoder
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.ros.transport.transport import Arrival
from sceneslam.sinks.live_map import NOTHING
from sceneslam.sinks.ros2 import requests, topics
from sceneslam.sinks.ros2 import sink as under_test
from sceneslam.types import se3
from sceneslam.types.command import Pause, SaveMap, SelectModule, SelectScene
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import GridLayer, MovedMap
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Laser, Rig, Sensor

S = 1_000_000_000
RIG = Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())
TYPES = {topic: kind for topic, (kind, _) in topics.TYPES.items()}


class Air:
    """A transport whose other side is the test's."""

    def __init__(self):
        self.sent, self.heard, self.is_closed = {}, {}, False
        self.map_came = threading.Event()
        self._decoder = MessageDecoder(
            {topic: TopicType.of_network(kind) for topic, kind in TYPES.items()}
        )

    def subscribe(self, topic, msgtype, heard, qos=None):
        self.heard[topic] = heard

    def unsubscribe(self, topic):
        self.heard.pop(topic, None)

    def publisher(self, topic, msgtype, qos=None):
        air = self

        class Publisher:
            def publish(self, cdr):
                air.sent.setdefault(topic, []).append(air._decoder.decode(topic, cdr))
                if topic == topics.MAP:
                    air.map_came.set()

        return Publisher()

    def close(self):
        self.is_closed = True

    def ask(self, topic, cdr):
        self.heard[topic](Arrival(topic=topic, cdr=cdr, arrived_ns=0))

    def last(self, topic):
        return self.sent[topic][-1]


@pytest.fixture
def air(monkeypatch):
    made = Air()
    monkeypatch.setattr(under_test, "open_transport", lambda network: made)
    return made


@pytest.fixture
def sink(air, tmp_path):
    made = make()
    made.open(RIG, tmp_path)
    yield made
    made.close()


def make(**words):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        settings = OmegaConf.to_container(compose("sinks/ros2").sinks)
    settings.pop("_target_")
    mapper = settings.pop("mapper")
    mapper.pop("_target_")
    return under_test.Ros2Sink(
        **(settings | {"map_every_s": 0.0} | words), mapper=GridAndPoints(**mapper)
    )


def at(x_m, y_m=0.0, yaw_rad=0.0):
    return se3.from_xy_yaw(x_m, y_m, yaw_rad)


def seen(stamp_ns, T_odom_base=None):
    return Observation(stamp_ns=stamp_ns, T_odom_base=T_odom_base, scan=scan(stamp_ns))


def transform(message):
    (entry,) = message.transforms
    at_, turn = entry.transform.translation, entry.transform.rotation
    T = se3.from_quat_xyzw(
        np.array([at_.x, at_.y, at_.z]), np.array([turn.x, turn.y, turn.z, turn.w])
    )
    return entry.header.frame_id, entry.child_frame_id, T, stamp_ns(entry)


def stamp_ns(message):
    return message.header.stamp.sec * S + message.header.stamp.nanosec


def test_map_to_odom_leads_to_the_pose_over_the_robots_own_odometry(air, sink):
    T_odom_base, T_map_base = at(2.0, 1.0, 0.7), at(5.0, -1.0, 0.2)
    sink.write(seen(3 * S, T_odom_base), T_map_base, "laser")
    frame, child, T_map_odom, at_ns = transform(air.last("/tf"))
    assert (frame, child, at_ns) == ("map", "odom", 3 * S + 100_000_000)
    np.testing.assert_allclose(T_map_odom @ T_odom_base, T_map_base, atol=1e-9)
    assert len(air.sent["/tf"]) == 1  # odom -> base_link is the robot's


def test_base_keeps_its_one_parent_while_odometry_is_silent(air, sink):
    sink.write(seen(S), at(0.0), "laser")
    assert "/tf" not in air.sent
    sink.write(seen(2 * S, at(2.0)), at(5.0), "laser")
    sink.write(seen(3 * S), at(6.0), "laser")
    sent = [transform(message) for message in air.sent["/tf"]]
    assert [(frame, child) for frame, child, _, _ in sent] == [("map", "odom")] * 2
    np.testing.assert_allclose(sent[1][2], sent[0][2])
    assert sent[1][3] == 3 * S + 100_000_000


def test_robot_without_odometry_gets_map_to_base(air, tmp_path):
    sink = make()
    sink.open(replace(RIG, sensors=frozenset({Sensor.SCAN})), tmp_path)
    sink.write(seen(S), at(1.0), "laser")
    frame, child, T_map_base, _ = transform(air.last("/tf"))
    assert (frame, child) == ("map", "base_link")
    np.testing.assert_allclose(T_map_base, at(1.0), atol=1e-9)


def test_reset_odometry_and_a_clock_that_jumped_are_the_robots_in_what_is_sent(air, sink):
    sink.write_event(
        {"event": "clock_jump", "stamp_ns": 0, "topic": "/odom", "shift_ns": 100 * S, "paces": True}
    )
    T_smooth_odom = at(3.0, 0.0, 0.5)
    sink.write_event(
        {"event": "odometry_jump", "stamp_ns": 0, "T_smooth_odom": T_smooth_odom.ravel().tolist()}
    )
    T_odom_base, T_map_base = at(0.1), at(3.2)
    sink.write(seen(107 * S, T_smooth_odom @ T_odom_base), T_map_base, "laser")
    _, _, T_map_odom, at_ns = transform(air.last("/tf"))
    assert at_ns == 7 * S + 100_000_000 and stamp_ns(air.last("/sceneslam/odometry")) == 7 * S
    np.testing.assert_allclose(T_map_odom @ T_odom_base, T_map_base, atol=1e-9)


def test_path_and_health_go_on_when_the_robots_clock_was_set_back(air, sink):
    sink.write(seen(1000 * S, at(0.0)), at(0.0), "laser")
    sink.write_event(
        {"event": "clock_jump", "stamp_ns": 0, "topic": "/odom", "shift_ns": 100 * S, "paces": True}
    )
    sink.write(seen(1001 * S, at(0.0)), at(0.0), "laser")
    assert len(air.sent["/sceneslam/path"]) == len(air.sent["/diagnostics"]) == 2
    assert stamp_ns(air.last("/diagnostics")) == 901 * S


def test_covariance_is_along_the_axes_of_the_map(air, sink):
    sink.write_covariance(S, np.diag([0.04, 0.01, 0, 0, 0, 0.02]))
    sink.write(seen(S, at(0.0)), at(0.0, 0.0, np.pi / 2), "laser")
    message = air.last("/sceneslam/odometry")
    assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
    told = np.reshape(message.pose.covariance, (6, 6))
    np.testing.assert_allclose(np.diag(told), [0.01, 0.04, 0, 0, 0, 0.02], atol=1e-12)
    sink.write(seen(2 * S, at(0.0)), at(0.0), "laser")  # of which nobody told how certain it is
    assert not np.any(air.last("/sceneslam/odometry").pose.covariance)


def test_scene_and_module_are_said_when_they_change(air, sink):
    for index, module in enumerate(["a", "a", "b"]):
        sink.write(seen(index * S, at(0.0)), at(0.0), module)
    sink.write_event({"event": "scene", "stamp_ns": 0, "scene": "Dark", "previous": None})
    assert [message.data for message in air.sent["/sceneslam/module"]] == ["a", "b"]
    assert air.last("/sceneslam/scene").data == "Dark"


def test_diagnostics_say_who_tracks_and_how_well(air, sink):
    sink.write(seen(S, at(0.0)), at(0.0), "laser")
    assert air.last("/diagnostics").status[0].level == 2  # nobody said that it tracks
    sink.write_event({"event": "tracking", "stamp_ns": S, "module": "laser", "status": "tracking"})
    sink.write(seen(3 * S, at(0.0)), at(0.0), "laser")
    status = air.last("/diagnostics").status[0]
    assert (status.level, status.message) == (0, "laser: tracking")


def test_diagnostics_warn_while_the_robot_is_not_in_the_loaded_map(air, sink):
    sink.write_event({"event": "tracking", "stamp_ns": S, "module": "laser", "status": "tracking"})
    for second, (event, level) in enumerate(
        [("not_relocalized", 1), ("relocalized", 0), ("relocalization_withdrawn", 1)]
    ):
        sink.write_event({"event": event, "stamp_ns": 2 * second * S})
        sink.write(seen(2 * second * S, at(0.0)), at(0.0), "laser")
        status = air.last("/diagnostics").status[0]
        said = "laser: tracking, not found in the loaded map" if level else "laser: tracking"
        assert (status.level, status.message) == (level, said)


def test_path_stays_short_however_long_the_run(air, sink, monkeypatch):
    monkeypatch.setattr(topics, "_PATH_POSES", 10)
    for index in range(100):
        sink.write(seen(index * S // 10, at(0.0)), at(0.1 * index), "laser")
    poses = air.last("/sceneslam/path").poses
    assert 5 <= len(poses) <= 10 and poses[0].pose.position.x == 0.0
    steps = np.diff([pose.pose.position.x for pose in poses])
    np.testing.assert_allclose(steps, steps[0], atol=1e-6)


@pytest.mark.parametrize("shift_s", [0, 60])
def test_loops_move_the_path(air, sink, shift_s):
    """The robot's clock may have jumped since: poses are found by the run's."""
    sink.write(seen(0, at(0.0)), at(0.0), "laser")
    sink.write(seen(S, at(1.0)), at(1.0), "laser")
    sink.write_event({"event": "clock_jump", "stamp_ns": S, "paces": True, "shift_ns": shift_s * S})
    ahead = {0: 0.0, S: 2.0}

    def moved(stamps_ns, T_map_base):
        return [at(ahead[ns]) @ T for ns, T in zip(stamps_ns.tolist(), T_map_base, strict=True)]

    sink.write_map(MovedMap(loaded=None, moved=moved))
    sink.write(seen(3 * S, at(4.0)), at(4.0), "laser")
    xs = [pose.pose.position.x for pose in air.last("/sceneslam/path").poses]
    assert xs == [0.0, 3.0, 4.0]


@pytest.mark.parametrize("frame", ["map", "odom_", "f", "longer/name", ""])
@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_path_is_the_bytes_that_a_ros_serialises(frame, count):
    rng = np.random.default_rng(count)
    poses = [se3.exp(rng.normal(size=6)) for _ in range(count)]
    stamps_ns = [1_700_000_000_987_654_321 + index * S for index in range(count)]
    encoder = ResultEncoder()
    data = encoder.path(stamps_ns, poses, frame)
    decoder = MessageDecoder({"/path": TopicType.of_network("nav_msgs/msg/Path")})
    message = decoder.decode("/path", data)
    assert [decode.frame_id(one) for one in message.poses] == [frame] * count
    assert [decode.stamp_ns(one) for one in message.poses] == stamps_ns
    for T, one in zip(poses, message.poses, strict=True):
        told = decode.transform(one.pose.position, one.pose.orientation)
        np.testing.assert_allclose(told, T, atol=1e-12)
    fields = {"header": message.header, "poses": message.poses}
    assert encoder._cdr("nav_msgs/msg/Path", **fields) == data


def test_grid_shows_the_wall_where_the_scan_met_it(air, sink):
    for index in range(8):
        sink.write(seen(index * S, at(0.0)), at(2.0 + 0.2 * index), "laser")
    assert air.map_came.wait(10.0)
    sink.close()
    message = air.last("/map")
    grid = np.reshape(message.data, (message.info.height, message.info.width))
    origin = message.info.origin.position
    column = int((3.0 - origin.x) / message.info.resolution)  # a metre ahead of the first place
    row = int((0.0 - origin.y) / message.info.resolution)
    assert grid[row, column - 10] < 50 and grid.max() == 100 and grid.min() == -1


def test_walls_are_100_as_nav2_wants_them_free_is_0_and_the_rest_unknown(air, sink):
    log_odds = np.array([[3.5, 0.63, 0.61], [0.0, -1.4, -1.42]], np.float32)
    layer = GridLayer(log_odds=log_odds, resolution_m=0.05, origin_xy_m=(0.0, 0.0))
    sink._publish_map(replace(NOTHING, grid=layer))
    assert list(air.last("/map").data) == [100, 100, -1, -1, -1, 0]


def draw_arrow(air, T_frame_base):
    encoder = ResultEncoder()
    message = encoder._new(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=encoder._header(0, "map"),
        pose=encoder._new(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=encoder._pose(T_frame_base),
            covariance=np.zeros(36),
        ),
    )
    cdr = bytes(encoder._store.serialize_cdr(message, message.__msgtype__))
    air.ask(requests.INITIAL_POSE, cdr)


def test_initial_pose_moves_the_map_under_the_robot(air, sink):
    T_map_base, T_said = at(2.0, 0.0, 0.1), at(10.0, 5.0, 1.0)
    draw_arrow(air, T_said)
    for x_m in (2.0, 3.0):
        sink.write(seen(S, at(0.0)), at(x_m, 0.0, 0.1), "laser")
        _, _, T_frame_odom, _ = transform(air.last("/tf"))
        expected = T_said @ se3.inverse(T_map_base) @ at(x_m, 0.0, 0.1)
        np.testing.assert_allclose(T_frame_odom, expected, atol=1e-9)


@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, -2.5])
def test_grid_lies_along_the_axes_of_the_frame_that_an_arrow_has_turned(air, sink, yaw_rad):
    T_frame_map = at(10.0, -5.0, yaw_rad)
    draw_arrow(air, T_frame_map)
    sink.write(seen(S, at(0.0)), at(0.0), "laser")
    log_odds = np.full((40, 60), -2.0, np.float32)
    walls = np.array([[5, 7], [20, 30], *([30, column] for column in range(60))])
    log_odds[tuple(walls.T)] = 2.0
    layer = GridLayer(log_odds=log_odds, resolution_m=0.05, origin_xy_m=(1.0, 2.0))
    sink._publish_map(replace(NOTHING, grid=layer))
    info, data = air.last("/map").info, air.last("/map").data
    turn, corner = info.origin.orientation, info.origin.position
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0)
    cells = np.reshape(data, (info.height, info.width))
    found = (np.argwhere(cells == 100)[:, ::-1] + 0.5) * info.resolution + [corner.x, corner.y]
    centres = (walls[:, ::-1] + 0.5) * 0.05 + [1.0, 2.0]
    expected = centres @ T_frame_map[:2, :2].T + T_frame_map[:2, 3]
    apart_m = np.linalg.norm(found[:, None] - expected, axis=2)
    assert apart_m.min(axis=0).max() < 0.05 and apart_m.min(axis=1).max() < 0.05
    assert abs(np.count_nonzero(cells == 0) - np.count_nonzero(log_odds < 0)) < 60


def test_operators_wishes_become_commands(air, sink):
    encoder = ResultEncoder()
    air.ask(requests.SELECT_SCENE, encoder.text("Dark"))
    air.ask(requests.SELECT_MODULE, encoder.text("laser"))
    air.ask(requests.SAVE_MAP, encoder.text("floor1"))
    air.ask(requests.PAUSE, bytes([0, 1, 0, 0, 1]))
    air.ask(requests.PAUSE, b"\x00\x01")  # cut off
    *others, save = sink.commands()
    assert others == [
        SelectScene(scene="Dark"), SelectModule(module="laser"), Pause(is_paused=True),
    ]  # fmt: skip
    assert isinstance(save, SaveMap) and save.name == "floor1" and not sink.commands()


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ({"map_frame": "odom"}, "map_frame"),
        ({"base_frame": ""}, "map_frame"),
        ({"tf_ahead_s": -1.0}, "tf_ahead_s"),
        ({"transport": "x"}, "transport"),
    ],
)
def test_impossible_settings_are_refused(words, key):
    with pytest.raises(ConfigError, match=key):
        make(**words)


class Desk:
    """An operator with nothing behind it."""

    def __init__(self, folder):
        self.selected, self.events, self.saved = "", [], []
        table = {"Bright": ("rgbd", "laser"), "Dark": ("laser",)}
        self.operator = Operator(
            ("Bright", "Dark"),
            self.select,
            table,
            lambda hybrid, path: self.saved.append(path),
            folder,
            lambda event, stamp_ns, **fields: self.events.append({"event": event, **fields}),
            InStep(),
        )

    def select(self, scene):
        self.selected = scene


def test_scene_is_selected_by_its_name_or_its_module_until_it_is_given_back(tmp_path):
    desk = Desk(tmp_path)
    for command, scene in [
        (SelectScene(scene="Dark"), "Dark"),
        (SelectScene(scene=""), ""),
        (SelectModule(module="laser"), "Dark"),
        (SelectModule(module=""), ""),
    ]:
        desk.operator.obey(command, 0)
        assert desk.selected == scene
    assert {event["event"] for event in desk.events} == {"command"}


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (SelectScene(scene="Fog"), "the detector's scenes are: Bright, Dark"),
        (SelectModule(module="orb"), "first of a scene are: laser, rgbd"),
        (SaveMap(name="../x", hybrid=None), "expected a name without slashes"),
        (SaveMap(name="", hybrid=None), "expected a name without slashes"),
    ],
)
def test_wish_that_cannot_be_met_is_refused_with_what_can(tmp_path, command, why):
    desk = Desk(tmp_path)
    desk.operator.obey(command, 0)
    assert desk.events[0]["event"] == "command_refused" and desk.events[0]["why"] == why
    assert not desk.selected and not desk.saved


def test_map_is_saved_under_its_name(tmp_path):
    desk = Desk(tmp_path)
    desk.operator.obey(SaveMap(name="floor1", hybrid=None), 0)
    assert desk.saved == [tmp_path / "maps" / "floor1"]


def test_points_have_the_colour_of_their_pixel_and_lie_where_it_looked():
    rig = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH}), camera=CAMERA)
    mapper = GridAndPoints(resolution_m=0.1, voxel_m=0.01, depth_stride_px=1)
    mapper.open(rig)
    image = np.full((6, 8, 3), (1, 2, 3), np.uint8)
    depth_m = np.zeros((6, 8), np.float32)
    depth_m[3, 4] = 2.0  # the principal point: straight ahead
    mapper.add(Observation(stamp_ns=0, image_bgr=image, depth_m=depth_m), at(1.0), at(1.0))
    layer = mapper.map().points
    np.testing.assert_allclose(layer.points, [[3.0, 0.0, 0.0]], atol=1e-6)
    assert layer.colors_bgr.tolist() == [[1, 2, 3]]
    mapper.add(Observation(stamp_ns=1, image_bgr=image, depth_m=depth_m), at(1.0), at(1.0))
    assert len(mapper.map().points.points) == 1


def test_run_says_over_the_air_what_it_says_in_its_folder(air, tmp_path):
    """A whole run, with the sink as it is configured."""
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        settings = OmegaConf.to_container(compose("sinks/ros2").sinks)
    finished = run(config(sinks={"ros2": settings}), tmp_path / "out")
    assert not finished.faults
    assert len(air.sent["/sceneslam/odometry"]) == len(finished.trajectory)
    last = air.last("/sceneslam/path").poses[-1].pose.position
    np.testing.assert_allclose([last.x, last.y], finished.trajectory.positions_m[-1, :2], atol=1e-6)
    assert air.is_closed


def test_a_sink_whose_map_failed_leaves_the_network_and_says_so(air, sink):
    sink._live_map._error = ValueError("a scan of letters")
    with pytest.raises(ValueError, match="letters"):
        sink.close()
    assert air.is_closed
