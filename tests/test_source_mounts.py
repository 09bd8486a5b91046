"""Where the sensors of a recording are on the robot: transforms, odometry, IMUs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_recordings import STAMP_NS, Recorder, make_source
from rosbags.typesys import Stores, get_typestore

from sceneslam.ros.encode import Encoder
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.sources.bag.topics import inertial_sensors
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor, optical_to_rep103

COLOR = np.full((30, 40, 3), 90, np.uint8)


def test_mounts_come_from_the_transform_tree(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        tree = [
            recorder.transform("base_footprint", "base_link", 0.0),
            recorder.transform("base_link", "mast", 0.5),
            recorder.transform("mast", "laser", 0.25),
        ]
        recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.scan("/scan", STAMP_NS, [1.0, 2.0])
    source = make_source("mcap", tmp_path / "a.mcap")
    assert source.rig.laser.T_base_laser[0, 3] == 0.75
    other = make_source("mcap", tmp_path / "a.mcap", base_frame="mast")
    assert other.rig.laser.T_base_laser[0, 3] == 0.25
    with pytest.raises(ConfigError, match="base_link, laser, mast"):
        make_source("mcap", tmp_path / "a.mcap", base_frame="robot")


def odometry(recorder: Recorder, stamp_ns: int, T_odom_child: np.ndarray, child: str) -> Any:
    """Return an Odometry of the frame `child`."""
    data = Encoder().odometry(stamp_ns, T_odom_child, "odom")
    message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, "nav_msgs/msg/Odometry")
    message.child_frame_id = child
    return message


@pytest.mark.parametrize(("child", "moved_m"), [("t265", 0.0), ("base_link", -1.0), ("", -1.0)])
def test_odometry_of_another_frame_is_brought_to_the_base(
    tmp_path: Path, child: str, moved_m: float
) -> None:
    """A camera 0.5 m ahead goes round the robot, which turns on the spot."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        tree = [recorder.transform("base_link", "t265", 0.5)]
        recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        for number, T_odom_child in enumerate(
            (se3.from_xy_yaw(0.5, 0.0, 0.0), se3.from_xy_yaw(-0.5, 0.0, np.pi))
        ):
            stamp_ns = STAMP_NS + number * 10**8
            recorder.add("/odom", stamp_ns, odometry(recorder, stamp_ns, T_odom_child, child))
    source = make_source("mcap", tmp_path / "a.mcap")
    poses = [one.T_odom_base for one in source]
    np.testing.assert_allclose((poses[1] - poses[0])[:2, 3], [moved_m, 0.0], atol=1e-12)
    np.testing.assert_allclose(poses[1][:2, :2], -np.eye(2), atol=1e-12)
    np.testing.assert_allclose(source.survey().T_odom_base[-1], poses[1])


def add_placed_scan(recorder: Recorder) -> None:
    tree = [recorder.transform("base_link", "laser", 0.5)]
    recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
    recorder.scan("/scan", STAMP_NS, [1.0, 2.0])


@pytest.mark.parametrize(
    ("child", "unplaced"),
    [("t265", ["t265"]), ("laser", []), ("base_footprint", []), ("husky/base_link", []), ("", [])],
)
def test_frame_of_odometry_that_no_transform_places_is_named(
    tmp_path: Path, child: str, unplaced: list[str]
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        add_placed_scan(recorder)
        recorder.add("/odom", STAMP_NS, odometry(recorder, STAMP_NS, np.eye(4), child))
    assert make_source("mcap", tmp_path / "a.mcap").survey().unplaced == unplaced


@pytest.mark.parametrize(
    ("child", "given", "is_odd"),
    [
        ("vicon", None, True),
        ("vicon", "base", False),
        ("laser", None, False),
        ("husky/base_link", None, False),
        ("", None, False),
    ],
)
def test_body_of_the_truth_that_no_transform_places_is_named(
    tmp_path: Path, child: str, given: str | None, is_odd: bool
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        add_placed_scan(recorder)
        recorder.add("/ground_truth", STAMP_NS, odometry(recorder, STAMP_NS, np.eye(4), child))
    survey = make_source("mcap", tmp_path / "a.mcap", ground_truth_frame=given).survey()
    assert ["frame 'vicon'" in one for one in survey.odd] == [True] * is_odd


@pytest.mark.parametrize(
    ("topic", "parent", "laser"),
    [
        ("/robot1/tf_static", "base_link", "laser"),
        ("/robot1/tf", "base_link", "laser"),
        ("/tf_static", "husky/base_link", "husky/laser"),
    ],
)
def test_mounts_of_a_robot_with_a_namespace_are_known(
    tmp_path: Path, topic: str, parent: str, laser: str
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        tree = [recorder.transform(parent, laser, 0.5)]
        recorder.add(topic, 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.scan("/robot1/scan", STAMP_NS, [1.0, 2.0], frame=laser)
    source = make_source("mcap", tmp_path / "a.mcap")
    assert source.rig.laser.T_base_laser[0, 3] == 0.5
    assert source.survey().unplaced == []


@pytest.mark.parametrize(("robot", "x_m"), [("robot1", 0.1), ("robot2", 0.2)])
def test_of_several_robots_the_one_whose_topics_are_used_places_its_sensors(
    tmp_path: Path, robot: str, x_m: float
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        for name, at_m in (("robot1", 0.1), ("robot2", 0.2)):
            tree = [recorder.transform("base_link", "laser", at_m)]
            message = recorder.new("tf2_msgs/msg/TFMessage", transforms=tree)
            recorder.add(f"/{name}/tf_static", 0, message)
            recorder.scan(f"/{name}/scan", STAMP_NS, [1.0, 2.0], frame="laser")
    source = make_source("mcap", tmp_path / "a.mcap", topics={"scan": f"/{robot}/scan"})
    assert source.rig.laser.T_base_laser[0, 3] == x_m


@pytest.mark.parametrize("robot", ["robot1", "uav1"])
def test_frames_of_the_robots_own_namespace_hold_before_those_without_one(
    tmp_path: Path, robot: str
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        for topic, at_m in (("/tf_static", 0.1), (f"/{robot}/tf_static", 0.2)):
            tree = [recorder.transform("base_link", "laser", at_m)]
            recorder.add(topic, 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.scan(f"/{robot}/scan", STAMP_NS, [1.0, 2.0], frame="laser")
    source = make_source("mcap", tmp_path / "a.mcap")
    assert source.rig.laser.T_base_laser[0, 3] == 0.2


@pytest.mark.parametrize(
    ("topic", "parent", "moved_m", "x_m", "is_odd"),
    [
        ("/tf_static", "base_link", 0.2, 0.7, True),
        ("/tf_static", "base_link", 0.0005, 0.5005, False),
        ("/tf_static", "mast", 0.0, 0.8, True),
        ("/tf", "base_link", 0.2, 0.5, False),  # it may move there
    ],
)
def test_the_last_transform_of_a_static_frame_holds_and_a_change_is_named(
    tmp_path: Path, topic: str, parent: str, moved_m: float, x_m: float, is_odd: bool
) -> None:
    """As in tf2; two nodes may place one frame, or a calibration may be published again."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        for number, (above, at_m) in enumerate((("base_link", 0.5), (parent, 0.5 + moved_m))):
            tree = [
                recorder.transform("base_link", "mast", 0.3),
                recorder.transform(above, "laser", at_m),
            ]
            recorder.add(topic, number, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.scan("/scan", STAMP_NS, [1.0, 2.0])
    source = make_source("mcap", tmp_path / "a.mcap")
    assert source.rig.laser.T_base_laser[0, 3] == pytest.approx(x_m)
    odd = source.survey().odd
    assert ["/tf_static places frame 'laser' at different" in one for one in odd] == [True] * is_odd


def record_placed(path: Path, tree: dict[str, tuple[str, float]], **frames: str) -> Path:
    """Write `tree`, child -> parent and how far ahead of it [m]; and frames of a scan and an Imu.

    Odometry reports the pose of a frame that is on no transform.
    """
    with Recorder(path) as recorder:
        entries = [recorder.transform(parent, child, x_m) for child, (parent, x_m) in tree.items()]
        recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=entries))
        recorder.scan("/scan", STAMP_NS, [1.0, 2.0], frame=frames["scan"])
        recorder.add("/odom", STAMP_NS, odometry(recorder, STAMP_NS, np.eye(4), "wheels"))
        if "imu" in frames:
            data = Encoder().imu(STAMP_NS, {Sensor.GYRO: np.ones(3)})
            message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, "sensor_msgs/msg/Imu")
            message.header.frame_id = frames["imu"]
            recorder.add("/imu", STAMP_NS, message)
    return path


ROBOTS = {f"{robot}/laser": (f"{robot}/base_link", x_m) for robot, x_m in (("a", 0.1), ("b", 0.2))}
BOTH_ON_MAP = ROBOTS | {f"{robot}/base_link": ("map", 1.0) for robot in "ab"}
ARM = {
    "a/base_link": ("a/base_footprint", 0.0),
    "a/arm/base_link": ("a/base_link", 0.3),
    "a/laser": ("a/base_link", 0.1),
    "a/imu": ("a/arm/base_link", 0.1),
}


@pytest.mark.parametrize(
    ("tree", "frames", "x_m"),
    [
        (ROBOTS, {"scan": "a/laser"}, 0.1),
        (ROBOTS, {"scan": "b/laser"}, 0.2),
        (BOTH_ON_MAP, {"scan": "b/laser", "imu": "imu"}, 0.2),
        (ARM, {"scan": "a/laser", "imu": "a/imu"}, 0.1),
        (ARM, {"scan": "a/imu"}, 0.4),  # the outermost
        (ROBOTS, {"scan": "laser"}, None),  # neither of both holds it
    ],
)
def test_of_several_bases_the_one_that_holds_the_sensors_is_taken(
    tmp_path: Path, tree: dict[str, Any], frames: dict[str, str], x_m: float | None
) -> None:
    source = make_source("mcap", record_placed(tmp_path / "a.mcap", tree, **frames))
    assert source.rig.laser.T_base_laser[0, 3] == pytest.approx(x_m or 0.0)
    assert (frames["scan"] in source.survey().unplaced) == (x_m is None)


@pytest.mark.parametrize(
    ("tree", "frames", "fit"),
    [
        (ROBOTS, {"scan": "a/laser", "imu": "b/laser"}, ["a/base_link", "b/base_link"]),
    ],
)
def test_of_several_bases_that_hold_the_sensors_one_has_to_be_given(
    tmp_path: Path, tree: dict[str, Any], frames: dict[str, str], fit: list[str]
) -> None:
    path = record_placed(tmp_path / "a.mcap", tree, **frames)
    said = rf"base_frame: several .*\({', '.join(fit)}\).* source\.base_frame={fit[0]}"
    with pytest.raises(InputError, match=said):
        make_source("mcap", path)
    make_source("mcap", path, base_frame=fit[0])


def test_a_laser_without_a_known_base_is_named_where_there_are_transforms(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        tree = [recorder.transform("chassis", "laser", 0.5)]
        recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.scan("/scan", STAMP_NS, [1.0, 2.0], frame="laser")
    source = make_source("mcap", tmp_path / "a.mcap")
    assert source.survey().unplaced == ["laser"]
    placed = make_source("mcap", tmp_path / "a.mcap", base_frame="chassis")
    assert placed.survey().unplaced == [] and placed.rig.laser.T_base_laser[0, 3] == 0.5


@pytest.mark.parametrize(
    ("connected", "unplaced"),
    [((), ["laser", "imu"]), (("laser",), ["imu"]), (("laser", "imu"), [])],
)
def test_sensors_that_no_transform_places_are_named(
    tmp_path: Path, connected: tuple[str, ...], unplaced: list[str]
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        tree = [recorder.transform("base_link", child, 0.5) for child in connected]
        if tree:
            recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.scan("/scan", STAMP_NS, [1.0, 2.0])
        data = Encoder().imu(STAMP_NS, {Sensor.GYRO: np.zeros(3)})
        message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, "sensor_msgs/msg/Imu")
        message.header.frame_id = "imu"
        recorder.add("/imu", STAMP_NS, message)
    assert make_source("mcap", tmp_path / "a.mcap").survey().unplaced == unplaced
    if not connected:  # a laser alone is where the robot is
        alone = make_source("mcap", tmp_path / "a.mcap", topics={"imu": "none"})
        assert alone.survey().unplaced == []


@pytest.mark.parametrize(
    ("frame", "is_connected", "gyro_base", "unplaced"),
    [
        ("gyro", True, [-2.0, 1.0, 3.0], ["cam"]),  # as the camera's transforms say
        ("gyro", False, [1.0, 2.0, 3.0], ["cam", "gyro"]),
        ("imu_optical_frame", False, [3.0, -1.0, -2.0], ["cam", "imu_optical_frame"]),
    ],
)
def test_imu_of_a_camera_without_a_robot_has_the_cameras_axes(
    tmp_path: Path, frame: str, is_connected: bool, gyro_base: list[float], unplaced: list[str]
) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Recorder(tmp_path / "a.mcap") as recorder:
        if is_connected:
            children = {"cam": optical_to_rep103(), frame: se3.from_xy_yaw(0.01, 0.02, np.pi / 2)}
            data = Encoder().transforms(STAMP_NS, "camera_link", children)
            recorder.add("/tf_static", 0, store.deserialize_cdr(data, "tf2_msgs/msg/TFMessage"))
        for stamp_ns in (STAMP_NS, STAMP_NS + 10**7):
            data = Encoder().imu(stamp_ns, {Sensor.GYRO: np.array([1.0, 2.0, 3.0])})
            message = store.deserialize_cdr(data, "sensor_msgs/msg/Imu")
            message.header.frame_id = frame
            recorder.add("/imu", stamp_ns, message)
            recorder.image("/rgb", stamp_ns, COLOR, "bgr8")
    source = make_source("mcap", tmp_path / "a.mcap")
    np.testing.assert_allclose(list(source)[-1].gyro_base[-1, 1:], gyro_base, atol=1e-12)
    assert source.survey().unplaced == unplaced


@pytest.mark.parametrize(
    ("frame", "T_base_lidar"),
    [("camera_depth_optical_frame", optical_to_rep103()), ("lidar", np.eye(4))],
)
def test_points_of_an_optical_frame_without_transforms_look_ahead(
    tmp_path: Path, frame: str, T_base_lidar: np.ndarray
) -> None:
    data = Encoder().points(STAMP_NS, np.ones((2, 3), np.float32), None)
    store = get_typestore(Stores.ROS2_HUMBLE)
    message = store.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")
    message.header.frame_id = frame
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add("/points", STAMP_NS, message)
    source = make_source("mcap", tmp_path / "a.mcap")
    np.testing.assert_array_equal(source.rig.lidar.T_base_lidar, T_base_lidar)


def test_a_scan_without_transforms_is_level_in_an_optical_frame_as_well(tmp_path: Path) -> None:
    """`depthimage_to_laserscan` may have been given the frame of its images."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.scan("/scan", STAMP_NS, [1.0] * 21, frame="camera_depth_optical_frame")
    source = make_source("mcap", tmp_path / "a.mcap")
    np.testing.assert_array_equal(source.rig.laser.T_base_laser, np.eye(4))


@pytest.mark.parametrize(
    ("frame", "T_base_cam", "is_odd"),
    [
        ("camera_link", se3.identity(), True),
        ("camera_link", se3.exp(np.array([0.2, 0.0, 0.3, 0.0, 0.6, 0.0])), True),  # tilted
        ("camera_link", optical_to_rep103(), False),
        ("ceiling_optical", se3.identity(), False),
    ],
)
def test_a_camera_in_the_frame_of_its_body_is_named(
    tmp_path: Path, frame: str, T_base_cam: np.ndarray, is_odd: bool
) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    data = Encoder().transforms(STAMP_NS, "base_link", {frame: T_base_cam})
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add("/tf_static", 0, store.deserialize_cdr(data, "tf2_msgs/msg/TFMessage"))
        recorder.image("/rgb", STAMP_NS, COLOR, frame=frame)
    odd = make_source("mcap", tmp_path / "a.mcap").survey().odd
    assert ["frame 'camera_link' looks up" in one for one in odd] == [True] * is_odd


def test_gyro_and_accelerometer_may_come_in_messages_of_their_own(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    samples = {
        Sensor.GYRO: np.array([0.1, 0.2, 0.3]),
        Sensor.ACCELEROMETER: np.array([0.0, 0.0, 9.81]),
    }
    with Recorder(tmp_path / "a.mcap") as recorder:
        for number in range(20):
            stamp_ns = STAMP_NS + number * 10**7
            for later_ns, (sensor, vector) in enumerate(samples.items()):
                data = Encoder().imu(stamp_ns + later_ns, {sensor: vector})
                message = store.deserialize_cdr(data, "sensor_msgs/msg/Imu")
                recorder.add("/imu", stamp_ns + later_ns, message)
            recorder.scan("/scan", stamp_ns + 5, [1.0] * 21)
    source = make_source("mcap", tmp_path / "a.mcap")
    assert source.rig.sensors == {Sensor.SCAN, *samples}
    assert sum(len(one.gyro_base) for one in source) == 20
    assert sum(len(one.accelerometer_base) for one in source) == 20
    survey = source.survey()
    np.testing.assert_allclose(survey.gyro_radps[0], samples[Sensor.GYRO])
    np.testing.assert_allclose(survey.forces_mps2[0], samples[Sensor.ACCELEROMETER])
    assert survey.stream(Sensor.GYRO).rate_hz == pytest.approx(100.0)


def record_imus(path: Path, turned_from: int = 0, **vectors: list[float]) -> Path:
    """Write 200 Imu messages to /NAME/sample each: gyro and accelerometer, six numbers.

    As RealSense's driver does it, none says that a vector is missing. Before the message
    `turned_from` the gyro is zero.
    """
    store, encoder = get_typestore(Stores.ROS2_HUMBLE), Encoder()
    with Recorder(path) as recorder:
        for number in range(200):
            stamp_ns = STAMP_NS + number * 10**7
            recorder.scan("/scan", stamp_ns, [1.0])
            for topic, vector in vectors.items():
                gyro = np.array(vector[:3]) if number >= turned_from else np.zeros(3)
                measured = {Sensor.GYRO: gyro, Sensor.ACCELEROMETER: np.array(vector[3:])}
                data = encoder.imu(stamp_ns, measured)
                message = store.deserialize_cdr(data, "sensor_msgs/msg/Imu")
                recorder.add(f"/{topic}/sample", stamp_ns, message)
    return path


def test_half_of_a_split_imu_that_is_zero_is_not_measured(tmp_path: Path) -> None:
    path = record_imus(tmp_path / "a.mcap", accel=[0, 0, 0, 0, 0, 9.8], gyro=[0, 0, 0.1, 0, 0, 0])
    with pytest.raises(InputError, match=r"several .*source\.topics\.imu=/gyro/sample"):
        make_source("mcap", path)
    for topic, sensor in (("gyro", Sensor.GYRO), ("accel", Sensor.ACCELEROMETER)):
        source = make_source("mcap", path, topics={"imu": f"/{topic}/sample"})
        assert source.rig.sensors == {Sensor.SCAN, sensor}
        live = inertial_sensors(open_recording(path), f"/{topic}/sample", is_live=True)
        assert live == {sensor}


@pytest.mark.parametrize(("turned_from", "is_gyro"), [(0, True), (150, True), (200, False)])
def test_gyro_of_a_simulated_robot_may_be_zero_at_rest(
    tmp_path: Path, turned_from: int, is_gyro: bool
) -> None:
    path = record_imus(tmp_path / "a.mcap", turned_from, imu=[0, 0, 0.1, 0, 0, 9.8])
    assert (Sensor.GYRO in make_source("mcap", path).rig.sensors) == is_gyro
    both = {Sensor.GYRO, Sensor.ACCELEROMETER}  # it may turn later
    assert inertial_sensors(open_recording(path), "/imu/sample", is_live=True) == both


def test_imu_of_an_orientation_alone_measures_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its vectors are zeros: as a gyro, it would say that a robot that turns does not turn."""
    path = record_imus(tmp_path / "a.mcap", imu=[0.0] * 6)
    assert make_source("mcap", path).rig.sensors == {Sensor.SCAN}
    assert "/imu/sample holds no gyro, only zeros" in caplog.text
    both = {Sensor.GYRO, Sensor.ACCELEROMETER}  # it may measure later
    assert inertial_sensors(open_recording(path), "/imu/sample", is_live=True) == both


@pytest.mark.parametrize(
    ("step_m", "speed_mps", "is_used"), [(0.0, 0.4, False), (0.04, 0.4, True), (0.0, 0.0, True)]
)
def test_odometry_whose_twist_alone_moves_is_not_used(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    step_m: float,
    speed_mps: float,
    is_used: bool,
) -> None:
    """Its pose says that the robot stands: a laser that is right would be taken to be wrong."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        for number in range(150):
            stamp_ns = STAMP_NS + number * 10**8
            moved_m = step_m * max(0, number - 120)
            message = odometry(recorder, stamp_ns, se3.from_xy_yaw(moved_m, 0.0, 0.0), "base_link")
            message.twist.twist.linear.x = speed_mps
            recorder.add("/odom", stamp_ns, message)
            recorder.scan("/scan", stamp_ns, [1.0, 2.0])
    rig = make_source("mcap", tmp_path / "a.mcap").rig
    assert (Sensor.ODOMETRY in rig.sensors) == is_used
    said = "/odom: its pose does not move although its twist does"
    assert (said in caplog.text) != is_used


def pose_truth(path: Path) -> Path:
    with Recorder(path) as recorder:
        recorder.image("/rgb", STAMP_NS, COLOR, "bgr8")
        recorder.camera_info("/camera_info", STAMP_NS, (40, 30))
        pose = recorder.new(
            "geometry_msgs/msg/Pose",
            position=recorder.new("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0),
            orientation=recorder.new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        )
        header = recorder.header(STAMP_NS, "world")
        stamped = recorder.new("geometry_msgs/msg/PoseStamped", header=header, pose=pose)
        recorder.add("/ground_truth", STAMP_NS, stamped)
    return path


def test_poses_without_a_robot_are_the_cameras(tmp_path: Path) -> None:
    path = pose_truth(tmp_path / "a.mcap")
    expected = {"base": np.eye(3), "camera": optical_to_rep103()[:3, :3].T}
    for frame, rotation in ((None, expected["camera"]), *expected.items()):
        source = make_source("mcap", path, ground_truth_frame=frame)
        (T_gt_base,) = source.ground_truth().trajectory.T_world_base
        np.testing.assert_allclose(T_gt_base[:3, :3], rotation, atol=1e-12)
        np.testing.assert_allclose(T_gt_base[:3, 3], [1, 2, 3])
