"""Recordings of others: topics, intrinsics, frames, truth."""

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_recordings import STAMP_NS, Recorder, make_source
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sceneslam.ros.encode import Encoder
from sceneslam.sources.spanned import TimeSpan
from sceneslam.sources.survey.preflight import preflight
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Camera, Sensor, optical_to_rep103

COLOR = np.full((30, 40, 3), 90, np.uint8)
DEPTH = np.full((30, 40), 1500, np.uint16)


@pytest.mark.parametrize("name", ["rgbd_3s.bag", "rgbd_3s_ros2.mcap"])
def test_the_kinect_bags_give_images_depth_and_truth(shared_data: Path, name: str) -> None:
    source = make_source("rosbag", shared_data / "bags" / name)
    found = list(source)
    assert len(found) == source.length == 30
    assert source.faults == []
    assert all(one.has(Sensor.IMAGE) and one.has(Sensor.DEPTH) for one in found)
    assert source.rig.camera.fx == 517.3
    assert source.rig.camera.distortion == (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    assert source.span.start_ns == found[0].stamp_ns
    assert source.span.end_ns == found[-1].stamp_ns


def test_bag_mcap_and_tum_folder_agree(shared_data: Path) -> None:
    bag = make_source("rosbag", shared_data / "bags" / "rgbd_3s.bag")
    mcap = make_source("mcap", shared_data / "bags" / "rgbd_3s_ros2.mcap")
    folder = make_source("tum_rgbd", shared_data / "tum_fr1_rpy")
    one, two = next(iter(bag)), next(iter(mcap))
    np.testing.assert_array_equal(one.image_bgr, two.image_bgr)
    np.testing.assert_array_equal(one.depth_m, two.depth_m)
    near = min(folder, key=lambda frame: abs(frame.stamp_ns - one.stamp_ns))
    assert abs(near.stamp_ns - one.stamp_ns) < 1000
    both = (near.depth_m > 0) & (one.depth_m > 0)
    np.testing.assert_allclose(near.depth_m[both], one.depth_m[both], atol=6e-4)
    truths = [source.ground_truth().trajectory for source in (bag, folder)]
    index = int(np.argmin(np.abs(truths[1].stamps_ns - one.stamp_ns)))
    np.testing.assert_allclose(truths[0].T_world_base[0], truths[1].T_world_base[index], atol=0.02)


@pytest.mark.parametrize("name", ["hokuyo_scan.bag", "hokuyo_scan_ros2.mcap", "hokuyo_scan_db3"])
def test_all_storages_give_the_same_scans(shared_data: Path, name: str) -> None:
    source = make_source("rosbag", shared_data / "bags" / name)
    found = list(source)
    assert len(found) == source.length == 360
    assert found[0].stamp_ns == source.span.start_ns == 1282836370970876375
    assert found[-1].stamp_ns == source.span.end_ns
    assert source.rig.sensors == {Sensor.SCAN}
    assert np.isnan(found[0].scan.ranges_m[16])
    assert source.ground_truth() is None


def write_bags(folder: Path, begins_s: dict[str, int]) -> None:
    """Write ROS 1 bags of three scans each, one per second."""
    store = get_typestore(Stores.ROS1_NOETIC)
    names = ("builtin_interfaces/msg/Time", "std_msgs/msg/Header", "sensor_msgs/msg/LaserScan")
    Time, Header, LaserScan = (store.types[name] for name in names)
    for name, begin_s in begins_s.items():
        with BagWriter(folder / f"{name}.bag") as writer:
            topic = writer.add_connection("/scan", LaserScan.__msgtype__, typestore=store)
            for number in range(begin_s, begin_s + 3):
                stamp = Time(sec=STAMP_NS // 10**9 + number, nanosec=STAMP_NS % 10**9)
                limits = (-1.0, 1.0, 0.1, 0.0, 0.0, 0.1, 10.0)
                ranges = (np.ones(21, np.float32), np.zeros(0, np.float32))
                scan = LaserScan(Header(seq=0, stamp=stamp, frame_id="laser"), *limits, *ranges)
                data = store.serialize_ros1(scan, LaserScan.__msgtype__)
                writer.write(topic, STAMP_NS + number * 10**9, data)


@pytest.mark.parametrize(
    "names",
    [
        ("drive_9", "drive_10"),
        ("2011-03-27-02-59-59_0", "2011-03-27-03-00-02_1"),
        ("a_2011-10-30-02-59-59_0", "a_2011-10-30-02-00-02_1"),  # the end of summer time
    ],
)
def test_a_split_bag_is_read_as_one(tmp_path: Path, names: tuple[str, str]) -> None:
    """Parts as `rosbag record --split` names them."""
    write_bags(tmp_path, {names[1]: 30, names[0]: 27})
    source = make_source("rosbag", tmp_path)
    stamps_ns = [STAMP_NS + number * 10**9 for number in range(27, 33)]
    assert [one.stamp_ns for one in source] == stamps_ns
    assert source.length == 6 and source.faults == []


@pytest.mark.parametrize(
    "names",
    [
        ("garage", "kitchen"),
        ("run1", "run2"),
        ("2011-01-25-06-29-26", "2011-03-27-07-49-54"),
        ("run1_0", "run2_1"),
        ("run_0", "run_2"),
        ("run_1", "run_01"),
    ],
)
def test_bags_of_other_names_are_no_parts(tmp_path: Path, names: tuple[str, str]) -> None:
    write_bags(tmp_path, dict(zip(names, (0, 3), strict=True)))
    with pytest.raises(InputError, match="not parts of one bag, give one of") as caught:
        make_source("rosbag", tmp_path)
    assert all(f"{name}.bag" in str(caught.value) for name in names)


@pytest.mark.parametrize("begin_s", [30, -30])
def test_bags_that_do_not_follow_each_other_are_no_parts(tmp_path: Path, begin_s: int) -> None:
    write_bags(tmp_path, {"run_1": 0, "run_2": begin_s})
    with pytest.raises(InputError, match=r"give one of them: run_2\.bag begins -?\d+\.0 s after"):
        make_source("rosbag", tmp_path)


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE])
@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_recordings_of_every_compression_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: CompressionMode, storage: StoragePlugin
) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    pose = se3.from_xy_yaw(1.0, 2.0, 0.0)
    with writer:
        odom = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        for number in range(5):
            stamp_ns = STAMP_NS + number * 10**8
            writer.write(odom, stamp_ns, Encoder().odometry(stamp_ns, pose, "odom"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    source = make_source("rosbag", tmp_path / "bag")
    unpacked = {path.stat().st_ino for path in tmp_path.glob("tmp*")}
    assert len(unpacked) == (mode is CompressionMode.FILE)
    found = list(source)
    assert len(found) == source.length == 5 and source.span.start_ns == STAMP_NS
    np.testing.assert_allclose(found[0].T_odom_base, pose)
    assert {path.stat().st_ino for path in tmp_path.glob("tmp*")} == unpacked
    del source
    gc.collect()
    assert not list(tmp_path.glob("tmp*"))


def test_points_come_before_scans_and_truth_is_no_odometry(shared_data: Path) -> None:
    source = make_source("rosbag", shared_data / "bags" / "embag_test.bag")
    assert source.rig.sensors == {Sensor.POINTS, Sensor.SCAN}
    found = list(source)  # of clocks that do not agree: the laser never sets the pace
    assert len(found) == 5 and all(one.points_lidar is not None for one in found)
    assert len(source.ground_truth().trajectory) == 5


def test_odometry_alone_will_do(shared_data: Path) -> None:
    source = make_source("mcap", shared_data / "bags" / "nav2_turtlebot.mcap")
    found = list(source)
    assert len(found) == 2639
    assert all(one.T_odom_base is not None for one in found)


def record(path: Path, **images: tuple[np.ndarray, str]) -> Path:
    """Write three frames of each image topic (`left__image` is /left/image)."""
    with Recorder(path) as recorder:
        for index in range(3):
            for name, (stored, encoding) in images.items():
                topic = "/" + name.replace("__", "/")
                recorder.image(topic, STAMP_NS + index * 10**8, stored, encoding)
    return path


def test_two_candidates_for_the_image_have_to_be_chosen_from(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", left__image=(COLOR, "bgr8"), right__image=(COLOR, "bgr8"))
    with pytest.raises(InputError) as caught:
        make_source("mcap", path)
    assert "topics.image" in str(caught.value)
    assert "/left/image, /right/image" in str(caught.value)
    assert "source.topics.image=/left/image" in str(caught.value)
    source = make_source("mcap", path, topics={"image": "/right/image"})
    assert source.rig.sensors == {Sensor.IMAGE}
    assert len(list(source)) == 3


@pytest.mark.parametrize(("topic", "range_m"), [("/front/scan", 1.0), ("/rear/scan", 2.0)])
def test_one_of_two_lasers_can_be_chosen(tmp_path: Path, topic: str, range_m: float) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.scan("/front/scan", STAMP_NS, [1.0])
        recorder.scan("/rear/scan", STAMP_NS, [2.0])
    with pytest.raises(InputError, match=r"source\.topics\.scan=/front/scan"):
        make_source("mcap", tmp_path / "a.mcap")
    (one,) = make_source("mcap", tmp_path / "a.mcap", topics={"scan": topic})
    assert one.scan.ranges_m[0] == range_m


def test_colour_is_preferred_to_infrared_and_raw_to_compressed(tmp_path: Path) -> None:
    infrared = COLOR[..., 0]
    path = record(tmp_path / "a.mcap", infra__image=(infrared, "mono8"), rgb__image=(COLOR, "rgb8"))
    assert len(list(make_source("mcap", path))) == 3


def test_capital_letters_in_topics_do_not_change_their_meaning(tmp_path: Path) -> None:
    """Names as librealsense records them."""
    depth = {"Depth_0__image": (DEPTH, "mono16"), "Aligned_Depth__image": (DEPTH, "mono16")}
    path = record(tmp_path / "a.mcap", Color_0__image=(COLOR, "rgb8"), **depth)
    given = {"fx": 40.0, "fy": 41.0, "cx": 20.0, "cy": 15.0}
    source = make_source("mcap", path, camera=given)
    streams = {stream.sensor: stream.place for stream in source.survey().streams}
    assert streams == {Sensor.IMAGE: "/Color_0/image", Sensor.DEPTH: "/Aligned_Depth/image"}


def test_a_name_that_is_not_there_shows_what_is(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", rgb__image=(COLOR, "bgr8"))
    with pytest.raises(ConfigError, match=r"/rgb/image \(sensor_msgs/msg/Image\)") as caught:
        make_source("mcap", path, topics={"image": "/camera"})
    assert caught.value.key == "topics.image"
    with pytest.raises(ConfigError) as caught:
        make_source("mcap", path, topics={"scan": "/rgb/image"})
    assert caught.value.key == "topics.scan"
    with pytest.raises(ConfigError) as caught:
        make_source("mcap", path, topics={"picture": None})
    assert caught.value.key == "topics.picture"


def test_a_recording_without_any_sensor_says_what_it_has(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", rgb__image=(COLOR, "bgr8"))
    with pytest.raises(InputError, match=r"no image, depth, points.*/rgb/image"):
        make_source("mcap", path, topics={"image": "none"})


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_a_recording_in_an_encoding_that_is_not_read_names_it(
    tmp_path: Path, encoding: str
) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        writer = recorder._writer
        schema = writer.register_schema("foxglove.CompressedImage", encoding, b"{}")
        channel = writer.register_channel("/cam", encoding, schema)
        writer.add_message(channel, STAMP_NS, b"{}", STAMP_NS)
    expected = rf"/cam \(foxglove\.CompressedImage, {encoding}\): only cdr and ros1 are read"
    with pytest.raises(InputError, match=expected):
        make_source("mcap", tmp_path / "a.mcap")
    with pytest.raises(ConfigError, match=expected):
        make_source("mcap", tmp_path / "a.mcap", topics={"image": "/cam"})


def rgbd(path: Path, **camera_info: Any) -> Path:
    with Recorder(path) as recorder:
        for index in range(3):
            stamp_ns = STAMP_NS + index * 10**8
            recorder.image("/cam/depth", stamp_ns + 5_000_000, DEPTH, "16UC1")
            recorder.image("/cam/rgb", stamp_ns, COLOR, "bgr8")
            if camera_info:
                recorder.camera_info("/cam/camera_info", stamp_ns, **camera_info)
    return path


def test_depth_without_intrinsics_asks_for_them(tmp_path: Path) -> None:
    path = rgbd(tmp_path / "a.mcap")
    with pytest.raises(InputError, match=r"depth without intrinsics.*source\.camera\.fx"):
        make_source("mcap", path)
    given = {"fx": 40.0, "fy": 41.0, "cx": 20.0, "cy": 15.0}
    source = make_source("mcap", path, camera=given)
    assert source.rig.camera.fy == 41.0
    assert all(one.has(Sensor.DEPTH) for one in source)


@pytest.mark.parametrize(
    ("frame", "x_m", "fx", "is_odd"),
    [
        ("depth", None, 50.0, False),  # the driver names its own frame, and registers all the same
        ("depth", 0.0, 50.0, False),
        ("depth", 0.025, 50.0, True),
        ("depth", None, 60.0, True),
        ("cam", None, 60.0, False),
    ],
)
def test_depth_that_is_not_registered_to_the_images_is_a_warning(
    tmp_path: Path, frame: str, x_m: float | None, fx: float, is_odd: bool
) -> None:
    info = camera_info(p=[0.0] * 8)
    with Recorder(tmp_path / "a.mcap") as recorder:
        if x_m is not None:
            tree = [recorder.transform("cam", "depth", x_m)]
            recorder.add("/tf_static", 0, recorder.new("tf2_msgs/msg/TFMessage", transforms=tree))
        recorder.add("/rgb/camera_info", STAMP_NS, info)
        info.k = np.array([fx, *info.k[1:]])
        recorder.add("/depth/camera_info", STAMP_NS, info)
        recorder.image("/rgb/image", STAMP_NS, COLOR, "bgr8")
        recorder.image("/depth/image", STAMP_NS, DEPTH, "16UC1", frame=frame)
    source = make_source("mcap", tmp_path / "a.mcap")
    odd = source.survey().odd
    assert len(odd) == is_odd
    assert all("/depth/image (frame 'depth')" in one and "registered" in one for one in odd)
    assert set(odd) <= set(preflight(source.survey(), source.rig).warnings)


def test_float_depth_without_one_number_is_told(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        for index, value in enumerate((np.nan, 1.0, np.nan)):
            stamp_ns = STAMP_NS + index * 10**8
            recorder.image("/depth", stamp_ns, np.full((30, 40), value, np.float32), "32FC1")
            recorder.camera_info("/camera_info", stamp_ns, (40, 30))
    source = make_source("mcap", tmp_path / "a.mcap")
    assert [one.depth_m.any() for one in source] == [False, True, False]
    (fault,) = source.faults
    assert "depth image without one finite value: 2 times, first at stamp" in fault


def record_gaps(path: Path, seen_s: list[tuple[float, float]], late_ms: int = 0) -> Path:
    """Write scans for 14 s, and images within the spans `seen_s`, recorded `late_ms` later."""
    messages: list[tuple[int, str, int]] = []
    for number in range(140):
        stamp_ns = STAMP_NS + number * 10**8
        messages.append((stamp_ns, "/scan", stamp_ns))
        if any(start_s <= number / 10 < end_s for start_s, end_s in seen_s):
            messages.append((stamp_ns + (20 + late_ms) * 10**6, "/rgb", stamp_ns + 20_000_000))
    with Recorder(path) as recorder:
        add = recorder.add
        for log_ns, topic, stamp_ns in sorted(messages):
            recorder.add = lambda name, _, message, at=log_ns: add(name, at, message)  # type: ignore
            if topic == "/scan":
                recorder.scan(topic, stamp_ns, [1.0] * 5)
            else:
                recorder.image(topic, stamp_ns, COLOR)
    return path


@pytest.mark.parametrize("late_ms", [0, 300])
@pytest.mark.parametrize(
    ("seen_s", "scans", "length"),
    [
        ([(3, 5), (9, 11)], 140, None),
        ([(0, 4)], 140, None),
        ([(10, 14)], 140, None),
        ([(0, 3), (6, 14)], 140, 110),
        ([(0, 3), (3.9, 14)], 131, 131),  # too short a gap
        ([(0, 14)], 140, 140),
    ],
)
def test_while_the_camera_is_silent_the_laser_sets_the_pace(
    tmp_path: Path,
    seen_s: list[tuple[float, float]],
    scans: int,
    length: int | None,
    late_ms: int,
) -> None:
    source = make_source("mcap", record_gaps(tmp_path / "a.mcap", seen_s, late_ms))
    found = list(source)
    stamps_ns = np.array([one.stamp_ns for one in found])
    assert (np.diff(stamps_ns) > 0).all()
    images = sum(one.has(Sensor.IMAGE) for one in found)
    assert images == source.survey().stream(Sensor.IMAGE).count
    assert len({one.scan.stamp_ns for one in found if one.scan is not None}) == scans
    assert [source.span.start_ns, source.span.end_ns] == stamps_ns[[0, -1]].tolist()
    assert source.length == length and source.faults == []


def test_camera_info_of_another_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="80x60 pixels but the images have 40x30"):
        make_source("mcap", rgbd(tmp_path / "a.mcap", size_wh=(80, 60)))


def test_depth_goes_to_the_nearest_image_within_the_tolerance(tmp_path: Path) -> None:
    path = rgbd(tmp_path / "a.mcap", size_wh=(40, 30))
    assert all(one.has(Sensor.DEPTH) for one in make_source("mcap", path))
    strict = make_source("mcap", path, sync_tolerance_s=0.004)
    assert not any(one.has(Sensor.DEPTH) for one in strict)


@pytest.mark.parametrize(
    ("topic", "fx"),
    [
        ("/cam/image_raw", 50.0),
        ("/cam/direct_view", 50.0),
        ("/cam/image_rect", 45.0),
        ("/cam/image_rect_color", 45.0),
        ("/cam/image_rectified", 45.0),
        ("/cam/image_color_rect", 45.0),
        ("/cam/rect/image", 45.0),
    ],
)
def test_rectified_images_are_known_by_their_topic(tmp_path: Path, topic: str, fx: float) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add("/cam/camera_info", STAMP_NS, camera_info(p=[45.0, 0, 20, 0, 0, 45.0, 15, 0]))
        recorder.image(topic, STAMP_NS, COLOR, "bgr8")
    assert make_source("mcap", tmp_path / "a.mcap").rig.camera.fx == fx


@pytest.mark.parametrize(("frame", "fx"), [("right_optical", None), ("left_optical", 50.0)])
def test_camera_info_of_another_camera_is_not_taken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, frame: str, fx: float | None
) -> None:
    """Of another namespace, it is the image's if it has its frame, as that of aligned depth has."""
    info = camera_info(p=[0.0] * 8)
    info.header.frame_id = frame
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.image("/left/image_raw", STAMP_NS, COLOR, "bgr8", frame="left_optical")
        recorder.add("/right/camera_info", STAMP_NS, info)
    camera = make_source("mcap", tmp_path / "a.mcap").rig.camera
    assert (None if camera is None else camera.fx) == fx
    assert ("camera_info of /left/image_raw is missing" in caplog.text) == (fx is None)


def record_lenses(path: Path, focal_px: list[float], topic: str = "/cam/image_raw") -> Path:
    """Write images, and as many camera_infos of these focal lengths in K, P is twice K."""
    with Recorder(path) as recorder:
        for number, fx in enumerate(focal_px):
            stamp_ns = STAMP_NS + number * 10**8
            info = camera_info(p=[2 * fx, 0, 20, 0, 0, 2 * fx, 15, 0])
            info.k = np.array([fx, 0, 20, 0, fx, 15, 0, 0, 1.0])
            recorder.add("/cam/camera_info", stamp_ns, info)
            recorder.image(topic, stamp_ns, COLOR, "bgr8")
            recorder.image("/cam/depth", stamp_ns, DEPTH, "16UC1")
    return path


@pytest.mark.parametrize(
    ("zeros", "topic", "fx"),
    [(3, "/cam/image_raw", 50.0), (150, "/cam/image_raw", 50.0), (3, "/cam/image_rect", 100.0)],
)
def test_camera_infos_before_calibration_are_passed_over(
    tmp_path: Path, zeros: int, topic: str, fx: float
) -> None:
    path = record_lenses(tmp_path / "a.mcap", [0.0] * zeros + [50.0] * 150, topic)
    source = make_source("mcap", path)
    assert source.rig.camera.fx == fx and source.survey().odd == []


@pytest.mark.parametrize(
    ("focal_px", "given", "is_odd"),
    [
        ([300.0, 160.0, 160.0], {}, True),
        ([300.0, 160.0, 160.0], {"fx": 160.0, "fy": 160.0, "cx": 20.0, "cy": 15.0}, False),
        ([0.0, 300.0, 300.0], {}, False),
        ([300.0, 300.0, 0.0], {}, False),
    ],
)
def test_a_lens_that_changes_is_named(
    tmp_path: Path, focal_px: list[float], given: dict[str, float], is_odd: bool
) -> None:
    path = record_lenses(tmp_path / "a.mcap", focal_px)
    odd = make_source("mcap", path, camera=given).survey().odd
    first, last = "300, 300, 20, 15", "160, 160, 20, 15"
    said = f"/cam/camera_info changes: fx, fy, cx, cy are {first} at first and {last} at the end"
    assert [said in one for one in odd] == [True] * is_odd


def test_given_intrinsics_replace_those_of_a_lens_that_opencv_does_not_have(tmp_path: Path) -> None:
    info = camera_info(p=[0.0] * 8)
    info.distortion_model, info.d = "equidistant", np.full(4, 0.1)
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add("/cam/camera_info", STAMP_NS, info)
        recorder.image("/cam/image_raw", STAMP_NS, COLOR, "bgr8")
    given = {"fx": 40.0, "fy": 41.0, "cx": 20.0, "cy": 15.0}
    for camera in ({}, given):
        with pytest.raises(InputError, match=r"equidistant.*source\.camera\.fx.*distortion"):
            make_source("mcap", tmp_path / "a.mcap", camera=camera)
    lens = given | {"distortion": [0.0] * 5}
    found = make_source("mcap", tmp_path / "a.mcap", camera=lens).rig.camera
    assert found.fy == 41.0 and not any(found.distortion)


@pytest.mark.parametrize("what", ["lens", "encoding", "size"])
def test_camera_that_cannot_be_used_says_how_to_do_without(tmp_path: Path, what: str) -> None:
    info = camera_info(p=[0.0] * 8)
    if what == "lens":
        info.distortion_model, info.d = "equidistant", np.full(4, 0.1)
    if what == "size":
        info.width = 80
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add("/cam/camera_info", STAMP_NS, info)
        recorder.image("/cam/image_raw", STAMP_NS, COLOR, "nv21" if what == "encoding" else "bgr8")
        recorder.scan("/scan", STAMP_NS, [1.0] * 20)
    with pytest.raises(InputError) as caught:
        make_source("mcap", tmp_path / "a.mcap")
    assert "or do without /cam/image_raw: source.topics.image=none" in str(caught.value)
    (one,) = make_source("mcap", tmp_path / "a.mcap", topics={"image": "none"})
    assert one.has(Sensor.SCAN)
    with pytest.raises(InputError) as alone:
        make_source("mcap", tmp_path / "a.mcap", topics={"scan": "none"})
    assert "do without" not in str(alone.value)


def camera_info(p: list[float]) -> Any:
    """Return a CameraInfo with the first two rows of a projection."""
    camera = Camera(size_wh=(40, 30), fx=50.0, fy=51.0, cx=20.0, cy=15.0)
    store = get_typestore(Stores.ROS2_HUMBLE)
    data = Encoder().camera_info(STAMP_NS, camera)
    message = store.deserialize_cdr(data, "sensor_msgs/msg/CameraInfo")
    message.p = np.array([*p, 0.0, 0.0, 1.0, 0.0])
    return message


def test_image_that_changes_its_size_is_left_out_and_told_with_both_sizes(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        for index, rows in enumerate((30, 20, 30)):
            recorder.image("/rgb", STAMP_NS + index * 10**8, COLOR[:rows], "bgr8")
    source = make_source("mcap", tmp_path / "a.mcap")
    assert len(list(source)) == 2
    (fault,) = source.faults
    assert "a colour image was left out, it has 40x20 pixels, not 40x30: 1 time" in fault


def test_depth_of_another_size_than_the_image_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.camera_info("/camera_info", STAMP_NS, (40, 30))
        recorder.image("/rgb", STAMP_NS, COLOR, "bgr8")
        recorder.image("/depth", STAMP_NS, DEPTH[:20], "16UC1")
    with pytest.raises(InputError, match="depth at stamp"):
        list(make_source("mcap", tmp_path / "a.mcap"))


def test_a_damaged_picture_is_passed_over_and_told(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.image("/rgb", STAMP_NS, COLOR, "bgr8")
        recorder.image("/rgb", STAMP_NS + 10**8, COLOR, "bgr8")
        broken = recorder.new(
            "sensor_msgs/msg/Image",
            header=recorder.header(STAMP_NS + 2 * 10**8),
            height=30,
            width=40,
            encoding="bgr8",
            is_bigendian=0,
            step=120,
            data=np.zeros(10, np.uint8),
        )
        recorder.add("/rgb", STAMP_NS + 2 * 10**8, broken)
    source = make_source("mcap", tmp_path / "a.mcap")
    assert len(list(source)) == 2
    (fault,) = source.faults
    assert "colour image could not be decoded: 1 time" in fault


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        ("depth_scale", {"depth_scale": 0.0}),
        ("sync_tolerance_s", {"sync_tolerance_s": -1.0}),
        ("ground_truth_frame", {"ground_truth_frame": "laser"}),
        ("depth_range_m", {"depth_range_m": [3.0, 1.0]}),
        ("camera.cy", {"camera": {"fx": 1.0, "fy": 1.0, "cx": 1.0}}),
        ("camera.fx", {"camera": {"fx": -1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0}}),
        ("camera.focal", {"camera": {"focal": 1.0}}),
        ("camera.distortion", {"camera": {"distortion": [1.0]}}),
    ],
)
def test_wrong_values_are_named_by_their_key(
    tmp_path: Path, key: str, changes: dict[str, Any]
) -> None:
    path = record(tmp_path / "a.mcap", rgb__image=(COLOR, "bgr8"))
    with pytest.raises(ConfigError) as caught:
        make_source("mcap", path, **changes)
    assert caught.value.key == key


def test_a_scan_without_a_stamp_has_that_of_its_recording(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        add = recorder.add
        recorder.add = lambda topic, _, message: add(topic, STAMP_NS, message)  # type: ignore[method-assign]
        recorder.scan("/scan", 0, [1.0] * 20)
    (one,) = make_source("rosbag", tmp_path / "a.mcap")
    assert one.stamp_ns == one.scan.stamp_ns == STAMP_NS


@pytest.mark.parametrize("lacking", [range(3), range(7, 10)])
def test_messages_without_stamps_beside_stamped_ones_are_faults(
    tmp_path: Path, lacking: range
) -> None:
    """As of a simulator whose clock is not there yet; its time begins at 0."""
    with Recorder(tmp_path / "a.mcap") as recorder:
        for number in range(10):
            after_ns = (number + 1) * 10**8
            stamp_ns = 0 if number in lacking else after_ns
            pose = odometry_message(stamp_ns)
            recorder.add("/odom", STAMP_NS + after_ns, pose)
            recorder.add("/ground_truth/odom", STAMP_NS + after_ns, pose)
            recorder.image("/rgb", stamp_ns, COLOR, log_ns=STAMP_NS + after_ns)
    source = make_source("rosbag", tmp_path / "a.mcap")
    stamps_ns = [(number + 1) * 10**8 for number in range(10) if number not in lacking]
    found = list(source)
    assert [one.stamp_ns for one in found] == stamps_ns
    assert all(one.has(Sensor.ODOMETRY) for one in found)
    span = TimeSpan(start_ns=stamps_ns[0], end_ns=stamps_ns[-1])
    assert source.span == (None if 9 in lacking else span)
    assert source.survey().stream(Sensor.IMAGE).stamps_ns.tolist() == stamps_ns
    assert source.ground_truth().trajectory.stamps_ns.tolist() == stamps_ns
    for topic in ("/rgb", "/odom"):
        assert any(f"a message of {topic} has no stamp: 3 times" in one for one in source.faults)


def odometry_message(stamp_ns: int) -> Any:
    data = Encoder().odometry(stamp_ns, se3.identity(), "odom")
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, "nav_msgs/msg/Odometry")


@pytest.mark.parametrize("range_max", [0.0, float("nan")])
def test_a_laser_without_a_range_is_a_fault(tmp_path: Path, range_max: float) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.scan("/scan", STAMP_NS, [1.0, 2.0], range_max=range_max)
    source = make_source("mcap", tmp_path / "a.mcap")
    assert list(source) == []
    assert "no range_max above its range_min" in source.faults[0]


def test_messages_outside_of_the_chunks_of_a_file_are_read_in_their_order(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        chunk = recorder._writer._Writer__chunk_builder
        for index in range(6):
            is_inside = index in (0, 2, 3, 5)
            recorder._writer._Writer__chunk_builder = chunk if is_inside else None
            recorder.scan("/scan", STAMP_NS + index, [1.0] * 400)
        recorder._writer._Writer__chunk_builder = chunk
    source = make_source("rosbag", tmp_path / "a.mcap")
    assert [one.stamp_ns - STAMP_NS for one in source] == list(range(6))
    assert source.length == 6 and list(source.faults) == []


@pytest.mark.parametrize("is_absolute", [True, False])
def test_times_of_points_count_from_the_observation(tmp_path: Path, is_absolute: bool) -> None:
    """A cloud that was measured 40 ms before the image it is given with."""
    stamp_ns, after_s = STAMP_NS - 40_000_000, np.array([0.0, 0.05])
    times_s = after_s + stamp_ns * 1e-9 if is_absolute else after_s
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.image("/rgb", STAMP_NS, COLOR)
        recorder.add("/points", stamp_ns, cloud_message(stamp_ns, times_s))
    (one,) = make_source("rosbag", tmp_path / "a.mcap")
    np.testing.assert_allclose(one.point_times_s, [-0.04, 0.01], atol=1e-6)


@pytest.mark.parametrize(("unit", "ahead_s", "faults"), [(1.0, 37.0, 0), (1e3, 0.0, 1)])
def test_times_of_points_that_cannot_be_are_named(
    tmp_path: Path, unit: float, ahead_s: float, faults: int
) -> None:
    times = unit * (np.array([0.0, 0.05]) + ahead_s)
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add("/points", STAMP_NS, cloud_message(STAMP_NS, times))
    source = make_source("rosbag", tmp_path / "a.mcap")
    (one,) = source
    assert (one.point_times_s is None) == (faults == 1) == (len(source.faults) == 1)
    (sentence,) = preflight(source.survey(), source.rig).warnings
    assert sentence.startswith("/points: the times of points are")


def test_points_without_a_return_are_no_faults(tmp_path: Path) -> None:
    """A driver writes them as (0, 0, 0) at 0, and the others at absolute times."""
    sweep_s, points = np.linspace(0.0, 0.1, 50), np.full((50, 3), 2.0, np.float32)
    times_s = STAMP_NS * 1e-9 + sweep_s
    points[::3] = times_s[::3] = 0.0
    data = Encoder().points(STAMP_NS, points, times_s)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.add(
            "/points", STAMP_NS, store.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")
        )
    source = make_source("rosbag", tmp_path / "a.mcap")
    (one,) = source
    assert source.faults == [] and not preflight(source.survey(), source.rig).warnings
    assert np.ptp(one.point_times_s) == pytest.approx(0.1 - sweep_s[1], abs=1e-6)


@pytest.mark.parametrize("late_s", [0.04, 0.0])
def test_points_without_times_are_as_old_as_their_cloud(tmp_path: Path, late_s: float) -> None:
    stamp_ns = STAMP_NS - round(late_s * 1e9)
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.image("/rgb", STAMP_NS, COLOR)
        recorder.add("/points", stamp_ns, cloud_message(stamp_ns, None))
    (one,) = make_source("rosbag", tmp_path / "a.mcap")
    if late_s == 0.0:
        assert one.point_times_s is None
    else:
        np.testing.assert_allclose(one.point_times_s, [-late_s] * 2)


def cloud_message(stamp_ns: int, times_s: np.ndarray | None) -> Any:
    points = np.ones((2, 3), np.float32)
    data = Encoder().points(stamp_ns, points, times_s)
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")


def test_without_transforms_the_camera_looks_ahead(tmp_path: Path) -> None:
    source = make_source("mcap", rgbd(tmp_path / "a.mcap", size_wh=(40, 30)))
    np.testing.assert_array_equal(source.rig.camera.T_base_cam, optical_to_rep103())
