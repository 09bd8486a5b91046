"""What is recorded is read back: observations, rig and truth."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from ros_recordings import STAMP_NS, make_source

from sceneslam.interfaces import Sink
from sceneslam.ros import names
from sceneslam.ros.writer import ObservationWriter
from sceneslam.sinks.mcap import McapSink
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import GridLayer, PointLayer
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Lidar, Rig, Sensor, optical_to_rep103
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange, placed_by_pose

STEP_NS = 33_333_333
T_BASE_CAM = se3.from_parts(optical_to_rep103()[:3, :3], np.array([0.1, 0.0, 0.3]))
RIG = Rig(
    sensors=frozenset(Sensor),
    camera=Camera(
        size_wh=(64, 48),
        fx=50.5,
        fy=51.0,
        cx=31.0,
        cy=23.0,
        distortion=(0.1, -0.2, 0.001, 0.002, 0.05),
        depth_range_m=(0.4, 4.5),
        T_base_cam=T_BASE_CAM,
    ),
    laser=Laser(T_base_laser=se3.from_xy_yaw(0.2, 0.0, 0.5)),
    lidar=Lidar(range_m=(0.5, 20.0), T_base_lidar=se3.from_xy_yaw(0.0, 0.1, -1.0)),
)


def observations(count: int) -> list[Observation]:
    rng = np.random.default_rng(7)
    made = []
    for index in range(count):
        stamp_ns = STAMP_NS + index * STEP_NS
        depth_mm = rng.integers(400, 4500, (48, 64))
        depth_mm[rng.random((48, 64)) < 0.2] = 0
        ranges_m = rng.uniform(0.2, 9.0, 90).astype(np.float32)
        ranges_m[:3] = np.inf, np.nan, 5.0
        scan = LaserScan(
            stamp_ns=stamp_ns - 1_000_000,
            ranges_m=ranges_m,
            angle_min_rad=-1.5,
            angle_step_rad=0.03125,
            range_min_m=0.125,
            range_max_m=10.0,
        )
        gyro = np.column_stack([[-0.02, -0.01, 0.0], rng.normal(size=(3, 3))])
        made.append(
            Observation(
                stamp_ns=stamp_ns,
                image_bgr=rng.integers(0, 256, (48, 64, 3), dtype=np.uint8),
                depth_m=(depth_mm / 1000).astype(np.float32),
                scan=scan,
                points_lidar=rng.normal(size=(40, 3)).astype(np.float32),
                point_times_s=np.linspace(0, 0.1, 40),
                T_odom_base=se3.exp(rng.normal(size=6) * 0.3),
                gyro_base=gyro,
                accelerometer_base=gyro + np.array([0.0, 0.0, 0.0, 9.81]),
            )
        )
    return made


def truth(seen: list[Observation]) -> GroundTruth:
    rng = np.random.default_rng(8)
    stamps_ns = np.array([observation.stamp_ns for observation in seen])
    poses = np.stack([se3.exp(rng.normal(size=6)) for _ in seen])
    return GroundTruth(
        trajectory=Trajectory(stamps_ns=stamps_ns, T_world_base=poses),
        scenes=(
            SceneChange(stamp_ns=seen[0].stamp_ns, scene="Bright"),
            SceneChange(stamp_ns=seen[2].stamp_ns, scene="Dark"),
        ),
    )


def record(path: Path, image_format: str = "png", count: int = 5) -> list[Observation]:
    made = observations(count)
    writer = ObservationWriter(path, rig=RIG, image_format=image_format)
    for observation in made:
        writer.write(observation)
    writer.write_truth(truth(made))
    writer.close()
    writer.close()
    return made


def test_what_is_recorded_is_read_back(tmp_path: Path) -> None:
    made = record(tmp_path / "run.mcap")
    source = make_source("mcap", tmp_path / "run.mcap")
    read = list(source)
    assert source.length == len(read) == len(made)
    assert source.faults == []
    for before, after in zip(made, read, strict=True):
        assert after.stamp_ns == before.stamp_ns
        np.testing.assert_array_equal(after.image_bgr, before.image_bgr)
        np.testing.assert_array_equal(after.depth_m, before.depth_m)
        np.testing.assert_array_equal(after.points_lidar, before.points_lidar)
        np.testing.assert_array_equal(after.point_times_s, before.point_times_s)
        np.testing.assert_allclose(after.T_odom_base, before.T_odom_base, atol=1e-14)
        np.testing.assert_allclose(after.gyro_base, before.gyro_base, atol=1e-9)
        assert after.scan.stamp_ns == before.scan.stamp_ns
        np.testing.assert_array_equal(after.scan.ranges_m, before.scan.ranges_m)
        assert after.scan.angle_min_rad == before.scan.angle_min_rad
        assert after.scan.angle_step_rad == before.scan.angle_step_rad
        assert after.scan.range_max_m == before.scan.range_max_m


@pytest.mark.parametrize("has_camera", [False, True])
def test_scans_whose_sweeps_end_after_their_observations_are_read_back(
    tmp_path: Path, has_camera: bool
) -> None:
    """A camera's pace is 33 ms; a scan, of every third image, is half a sweep of 100 ms ahead."""
    sensors = {Sensor.SCAN, Sensor.ODOMETRY} | ({Sensor.IMAGE} if has_camera else set())
    rig = replace(RIG, sensors=frozenset(sensors), lidar=None)
    made = []
    for index, seen in enumerate(observations(9)):
        is_swept = index % 3 == 0 or not has_camera
        ahead = replace(seen.scan, stamp_ns=seen.stamp_ns + 50_000_000)
        one = Observation(stamp_ns=seen.stamp_ns, T_odom_base=seen.T_odom_base)
        one = replace(one, scan=ahead if is_swept else None)
        made.append(replace(one, image_bgr=seen.image_bgr if has_camera else None))
    writer = ObservationWriter(tmp_path / "run.mcap", rig=rig, image_format="png")
    for one in made:
        writer.write(one)
    writer.close()
    read = list(make_source("mcap", tmp_path / "run.mcap"))
    assert [one.stamp_ns for one in read] == [one.stamp_ns for one in made]
    for before, after in zip(made, read, strict=True):
        np.testing.assert_allclose(after.T_odom_base, before.T_odom_base, atol=1e-14)
        assert (after.scan is None) == (before.scan is None)
        if after.scan is not None:
            assert abs(after.scan.stamp_ns - before.scan.stamp_ns) < 10  # float32
            np.testing.assert_array_equal(after.scan.ranges_m, before.scan.ranges_m)


def test_rig_and_truth_are_read_back(tmp_path: Path) -> None:
    expected = truth(record(tmp_path / "run.mcap"))
    source = make_source("mcap", tmp_path / "run.mcap")
    rig = source.rig
    assert rig.sensors == RIG.sensors
    assert rig.camera.size_wh == RIG.camera.size_wh
    assert rig.camera.distortion == RIG.camera.distortion
    assert rig.camera.depth_range_m == RIG.camera.depth_range_m
    assert rig.lidar.range_m == RIG.lidar.range_m
    np.testing.assert_array_equal(rig.camera.K, RIG.camera.K)
    np.testing.assert_allclose(rig.camera.T_base_cam, T_BASE_CAM, atol=1e-15)
    np.testing.assert_allclose(rig.laser.T_base_laser, RIG.laser.T_base_laser, atol=1e-15)
    np.testing.assert_allclose(rig.lidar.T_base_lidar, RIG.lidar.T_base_lidar, atol=1e-15)
    found = source.ground_truth()
    np.testing.assert_array_equal(found.trajectory.stamps_ns, expected.trajectory.stamps_ns)
    np.testing.assert_allclose(
        found.trajectory.T_world_base, expected.trajectory.T_world_base, atol=1e-14
    )
    assert found.scenes == expected.scenes


def test_every_whole_millimetre_of_depth_survives(tmp_path: Path) -> None:
    rig = Rig(
        sensors=frozenset({Sensor.DEPTH}),
        camera=Camera(size_wh=(256, 256), fx=1, fy=1, cx=0, cy=0, depth_range_m=(0.001, 70.0)),
    )
    depth_m = (np.arange(65536).reshape(256, 256) / 1000).astype(np.float32)
    writer = ObservationWriter(tmp_path / "d.mcap", rig=rig, image_format="png")
    writer.write(Observation(stamp_ns=STAMP_NS, depth_m=depth_m))
    writer.close()
    (read,) = make_source("mcap", tmp_path / "d.mcap")
    np.testing.assert_array_equal(read.depth_m, depth_m)


def test_depth_that_is_no_number_is_recorded_as_missing(tmp_path: Path) -> None:
    rig = Rig(
        sensors=frozenset({Sensor.DEPTH}), camera=Camera(size_wh=(4, 1), fx=1, fy=1, cx=0, cy=0)
    )
    depth_m = np.array([[np.nan, np.inf, -1.0, 2.0]], np.float32)
    writer = ObservationWriter(tmp_path / "d.mcap", rig=rig, image_format="png")
    writer.write(Observation(stamp_ns=STAMP_NS, depth_m=depth_m))
    writer.close()
    (read,) = make_source("mcap", tmp_path / "d.mcap")
    np.testing.assert_array_equal(read.depth_m, np.array([[0, 0, 0, 2]], np.float32))


def test_two_recordings_of_the_same_are_the_same_bytes(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", "jpeg")
    record(tmp_path / "b.mcap", "jpeg")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_reading_twice_starts_anew(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap")
    source = make_source("mcap", tmp_path / "run.mcap")
    assert [one.stamp_ns for one in source] == [one.stamp_ns for one in source]


def test_an_unknown_image_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="image_format"):
        ObservationWriter(tmp_path / "x.mcap", rig=RIG, image_format="gif")


def test_the_sink_refuses_an_unknown_image_format_before_the_run() -> None:
    with pytest.raises(ConfigError) as caught:
        McapSink("run.mcap", "bmp", 90, 1, 1)
    assert caught.value.key == "image_format"


def test_the_sinks_poses_are_results_and_no_input(tmp_path: Path) -> None:
    sink = McapSink("run.mcap", "jpeg", 90, 1, 1)
    assert isinstance(sink, Sink)
    sink.open(RIG, tmp_path)
    made = observations(3)
    for observation in made:
        sink.write(observation, se3.from_xy_yaw(9.0, 9.0, 1.0), "visual")
    sink.write_event({"event": "vote", "stamp_ns": STAMP_NS, "scene": "Dark"})
    sink.write_truth(truth(made))
    sink.close()
    sink.close()
    source = make_source("mcap", tmp_path / "run.mcap")
    read = list(source)
    np.testing.assert_allclose(read[1].T_odom_base, made[1].T_odom_base, atol=1e-14)
    assert len(source.ground_truth().trajectory) == 3


def test_a_warning_without_a_stamp_does_not_begin_the_recording(tmp_path: Path) -> None:
    sink = McapSink("run.mcap", "jpeg", 90, 1, 1)
    sink.open(RIG, tmp_path)
    warning = {"event": "warning", "stamp_ns": 0, "what": "a lens"}
    sink.write_event(warning)
    made = observations(2)
    for observation in made:
        sink.write(replace(observation, gyro_base=None, accelerometer_base=None), None, "")
    sink.write_event(warning)
    sink.close()
    recording = open_recording(tmp_path / "run.mcap")
    times_ns = [one.log_ns for one in recording.messages({names.RESULT_EVENTS})]
    assert times_ns == [made[0].stamp_ns] * 2
    sink.open(RIG, tmp_path / "next")  # a run without an observation
    sink.write_event(warning)
    sink.close()
    assert (
        len(list(open_recording(tmp_path / "next" / "run.mcap").messages({names.RESULT_EVENTS})))
        == 1
    )


def test_truth_that_is_longer_than_the_run_moves_neither_map_nor_path(tmp_path: Path) -> None:
    sink = McapSink("run.mcap", "jpeg", 75, 1, 2)
    sink.open(RIG, tmp_path)
    (made,) = observations(1)
    sink.write(made, np.eye(4), "visual")
    later_ns = made.stamp_ns + np.array([30, 600]) * 10**9
    path = Trajectory(stamps_ns=later_ns, T_world_base=np.stack([np.eye(4)] * 2))
    sink.write_truth(GroundTruth(trajectory=path, scenes=()))
    run = Trajectory(stamps_ns=np.array([made.stamp_ns]), T_world_base=np.eye(4)[None])
    none = SimpleNamespace(grid=None, points=PointLayer(points=np.zeros((0, 3), np.float32)))
    sink.write_result(SimpleNamespace(trajectory=run, map=none))
    sink.close()
    recording = open_recording(tmp_path / "run.mcap")
    (told,) = recording.messages({names.RESULT_PATH})
    assert told.log_ns == made.stamp_ns
    frames = [recording.decode(one) for one in recording.messages({names.TF_STATIC})]
    children = {each.child_frame_id for one in frames for each in one.transforms}
    assert names.GT not in children  # where the truth lies in the map is not known


@pytest.mark.parametrize(("apart_ms", "is_known"), [(200, True), (2000, False)])
def test_truth_between_whose_poses_the_run_begins_is_interpolated(apart_ms, is_known) -> None:
    stamps_ns = STAMP_NS + np.array([0, apart_ms, 2 * apart_ms]) * 10**6
    poses = np.stack([se3.from_xy_yaw(x_m, 0.0, 0.0) for x_m in (0.0, 1.0, 2.0)])
    true = Trajectory(stamps_ns=stamps_ns, T_world_base=poses)
    begin_ns = STAMP_NS + apart_ms * 3 * 10**6 // 2
    T_map_gt = placed_by_pose(true, begin_ns, se3.from_xy_yaw(0.0, 4.0, 0.0))
    assert (T_map_gt is not None) is is_known
    if T_map_gt is not None:
        np.testing.assert_allclose(T_map_gt[:2, 3], [-1.5, 4.0])
    just_before = placed_by_pose(true, STAMP_NS - 40_000_000, np.eye(4))
    np.testing.assert_allclose(just_before, np.eye(4))
    assert placed_by_pose(true, STAMP_NS - 60_000_000, np.eye(4)) is None


def test_truth_of_a_slow_sensor_has_its_frame(tmp_path: Path) -> None:
    made = observations(5)
    writer = ObservationWriter(tmp_path / "run.mcap", rig=RIG, image_format="jpeg")
    writer.write_pose(made[0].stamp_ns, np.eye(4))
    stamps_ns = made[0].stamp_ns + np.array([-100, 100]) * 10**6
    true = Trajectory(stamps_ns=stamps_ns, T_world_base=np.stack([np.eye(4)] * 2))
    writer.write_truth(GroundTruth(trajectory=true))
    writer.close()
    recording = open_recording(tmp_path / "run.mcap")
    frames = [recording.decode(one) for one in recording.messages({names.TF_STATIC})]
    children = {each.child_frame_id for one in frames for each in one.transforms}
    assert names.GT in children


def test_recordings_open_with_the_reference_reader(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    record(tmp_path / "run.mcap")
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        topics = {channel.topic for _, channel, _ in reader.iter_messages()}
        assert {"/scan", "/points", "/odom", "/imu", "/tf_static"} <= topics


def test_looked_at_a_recording_of_a_run_shows_map_path_truth_and_velocity(tmp_path: Path) -> None:
    """As Foxglove draws the paper's Fig. 7: everything in frames that tf connects."""
    sink = McapSink("run.mcap", "jpeg", 75, 1, 2)
    sink.open(RIG, tmp_path)
    made = observations(5)
    for index, observation in enumerate(made):
        at = se3.from_xy_yaw(0.2 * index, 0.0, 0.0)
        sink.write(observation, at, "visual")
    sink.write_truth(truth(made))
    grid = GridLayer(
        log_odds=np.ones((4, 5), np.float32), resolution_m=0.1, origin_xy_m=(-1.0, -2.0)
    )
    points = PointLayer(points=np.ones((3, 3), np.float32))
    trajectory = Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in made]), T_world_base=np.stack([np.eye(4)] * 5)
    )
    result = SimpleNamespace(trajectory=trajectory, map=SimpleNamespace(grid=grid, points=points))
    sink.write_result(result)
    sink.close()
    recording = open_recording(tmp_path / "run.mcap")
    heard = {topic: [] for topic in recording.topics}
    for message in recording.messages(heard.keys()):
        heard[message.topic].append(recording.decode(message))
    assert len(heard[names.IMAGE]) == 5 and len(heard[names.DEPTH]) == 3
    assert heard["/map"][0].info.width == 5 and heard["/sceneslam/points"][0].width == 3
    assert len(heard["/sceneslam/path"][0].poses) == 5
    period_s = (made[1].stamp_ns - made[0].stamp_ns) / 1e9
    speed = heard["/sceneslam/odometry"][1].twist.twist.linear.x
    np.testing.assert_allclose(speed, 0.2 / period_s)
    static = [entry for one in heard["/tf_static"] for entry in one.transforms]
    assert ("map", "gt") in [(one.header.frame_id, one.child_frame_id) for one in static]
