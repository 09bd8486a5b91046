"""Messages of all encodings become our arrays."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ros_recordings import STAMP_NS, Recorder

from sceneslam.ros import decode, pixels
from sceneslam.ros.clouds import PointTimes, cloud
from sceneslam.ros.encode import Encoder
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.types.errors import InputError
from sceneslam.types.rig import Camera

BGR = np.random.default_rng(2).integers(0, 256, (6, 8, 3), dtype=np.uint8)
UNITS = pixels.DepthUnits(1000.0, (0.3, 8.0))
DEPTH_MM = np.array([[0, 100, 400], [1234, 8000, 9000]], np.uint16)
DEPTH_M = np.array([[0, 0, 0.4], [1.234, 8.0, 0]], np.float32)
SWEEP_S = np.array([0.0, 0.05, 0.1])


def decoded(path: Path) -> Any:
    recording = open_recording(path)
    return recording.decode(next(recording.messages(set(recording.topics))))


def image(tmp_path: Path, stored: np.ndarray, encoding: str, **options: Any) -> Any:
    with Recorder(tmp_path / "one.mcap") as recorder:
        recorder.image("/image", STAMP_NS, stored, encoding, **options)
    return decoded(tmp_path / "one.mcap")


@pytest.mark.parametrize(
    ("encoding", "stored"),
    [
        ("bgr8", BGR),
        ("rgb8", BGR[..., ::-1].copy()),
        ("bgra8", np.dstack([BGR, np.full((6, 8), 255, np.uint8)])),
        ("rgba8", np.dstack([BGR[..., ::-1], np.full((6, 8), 255, np.uint8)])),
    ],
)
def test_colour_encodings_give_bgr(tmp_path: Path, encoding: str, stored: np.ndarray) -> None:
    found = decode.image_bgr(image(tmp_path, stored, encoding, padding=5))
    np.testing.assert_array_equal(found, BGR)
    assert not found.flags.writeable


@pytest.mark.parametrize("is_bigendian", [False, True])
def test_grey_encodings_give_three_equal_channels(tmp_path: Path, is_bigendian: bool) -> None:
    grey = BGR[..., 0]
    wide = grey.astype(np.uint16) << 8
    for stored, encoding in ((grey, "mono8"), (wide, "mono16")):
        message = image(tmp_path, stored, encoding, is_bigendian=is_bigendian)
        np.testing.assert_array_equal(decode.image_bgr(message), np.dstack([grey] * 3))


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_grey_in_yuv_stays_grey(tmp_path: Path, encoding: str) -> None:
    stored = np.full((6, 8, 2), 128, np.uint8)
    np.testing.assert_allclose(decode.image_bgr(image(tmp_path, stored, encoding)), 130, atol=1)


def test_an_unknown_encoding_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'hsv8'"):
        decode.image_bgr(image(tmp_path, BGR, "hsv8"))


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_an_odd_width_in_yuv_is_damaged(tmp_path: Path, encoding: str) -> None:
    assert decode.image_bgr(image(tmp_path, np.zeros((6, 7, 2), np.uint8), encoding)) is None


def test_an_image_shorter_than_it_says_is_damaged(tmp_path: Path) -> None:
    message = image(tmp_path, BGR, "bgr8")
    message.data = message.data[:-1]
    assert decode.image_bgr(message) is None


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
def test_integer_depth_is_metres_within_range(
    tmp_path: Path, encoding: str, is_bigendian: bool
) -> None:
    message = image(tmp_path, DEPTH_MM, encoding, is_bigendian=is_bigendian, padding=3)
    np.testing.assert_array_equal(decode.depth_m(message, UNITS), DEPTH_M)


def test_float_depth_that_is_not_finite_is_missing(tmp_path: Path) -> None:
    stored = np.array([[np.nan, np.inf, -np.inf], [0.1, 2.5, 9.0]], np.float32)
    found = decode.depth_m(image(tmp_path, stored, "32FC1"), UNITS)
    np.testing.assert_array_equal(found, np.array([[0, 0, 0], [0, 2.5, 0]], np.float32))


def test_colour_as_depth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="depth encoding: got 'bgr8'"):
        decode.depth_m(image(tmp_path, BGR, "bgr8"), UNITS)


def compressed(tmp_path: Path, data: bytes, encoding: str) -> Any:
    with Recorder(tmp_path / "one.mcap") as recorder:
        recorder.compressed("/image/compressed", STAMP_NS, data, encoding)
    return decoded(tmp_path / "one.mcap")


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_mosaic_gets_its_colours_raw_and_compressed(tmp_path: Path, pattern: str) -> None:
    """Compressed, it is a grey file, unless its driver stored the colours."""
    colour = np.full((6, 8, 3), (10, 100, 200), np.uint8)
    tile = np.array([dict(zip("bgr", colour[0, 0], strict=True))[letter] for letter in pattern])
    mosaic = np.tile(tile.reshape(2, 2), (3, 4))
    raw = image(tmp_path, mosaic, f"bayer_{pattern}8")
    np.testing.assert_array_equal(decode.image_bgr(raw), colour)
    for suffix, stored in ((".png", mosaic), (".jpg", mosaic), (".png", colour)):
        data = cv2.imencode(suffix, stored)[1].tobytes()
        message = compressed(tmp_path, data, f"bayer_{pattern}8; {suffix[1:]} compressed ")
        np.testing.assert_allclose(decode.image_bgr(message), colour, atol=8)


def test_compressed_depth_of_both_kinds_is_read(tmp_path: Path) -> None:
    png = cv2.imencode(".png", DEPTH_MM)[1].tobytes()
    header = np.zeros(3, "<f4").tobytes()
    for data, encoding in (
        (png, "16UC1; png compressed "),
        (header + png, "16UC1; compressedDepth"),
        (header + png, "16UC1; compressedDepth png"),
    ):
        message = compressed(tmp_path, data, encoding)
        assert decode.is_depth(message, "/image")
        np.testing.assert_array_equal(decode.depth_m(message, UNITS), DEPTH_M)


@pytest.mark.parametrize("encoding", ["mono16", "mono16; png compressed "])
def test_16_bit_grey_is_depth_only_where_its_topic_says_so(tmp_path: Path, encoding: str) -> None:
    """A thermal camera has the same encoding."""
    grey = np.full((2, 3), 90 << 8, np.uint16)
    png = cv2.imencode(".png", grey)[1].tobytes()
    is_raw = encoding == "mono16"
    message = image(tmp_path, grey, encoding) if is_raw else compressed(tmp_path, png, encoding)
    assert not decode.is_depth(message, "/thermal/image_raw")
    assert decode.is_depth(message, "/depth/image_raw")
    assert (decode.image_bgr(message) == 90).all()


def test_inverse_depth_is_turned_round(tmp_path: Path) -> None:
    scale, offset = 10000.0, -5.0
    metres = np.array([[1.0, 2.0, 4.0]])
    stored = np.rint(scale / metres + offset).astype(np.uint16)
    stored[0, 2] = 0
    header = np.zeros(1, "<i4").tobytes() + np.array([scale, offset], "<f4").tobytes()
    data = header + cv2.imencode(".png", stored)[1].tobytes()
    found = decode.depth_m(compressed(tmp_path, data, "32FC1; compressedDepth"), UNITS)
    np.testing.assert_allclose(found, [[1.0, 2.0, 0.0]], atol=1e-3)


def test_eight_bit_depth_is_refused(tmp_path: Path) -> None:
    data = cv2.imencode(".png", BGR[..., 0])[1].tobytes()
    with pytest.raises(InputError, match="16-bit"):
        decode.depth_m(compressed(tmp_path, data, "16UC1; png compressed "), UNITS)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_cut_off_picture_is_damaged(suffix: str) -> None:
    data = cv2.imencode(suffix, np.tile(BGR, (20, 20, 1)))[1].tobytes()
    assert pixels.decode_bgr(data) is not None
    for length in (0, 3, len(data) // 2, len(data) - 20):
        assert pixels.decode_bgr(data[:length]) is None


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_bytes_after_the_end_of_a_picture_are_passed_over(suffix: str) -> None:
    data = cv2.imencode(suffix, np.tile(BGR, (20, 20, 1)))[1].tobytes()
    for behind in (bytes(4096), b"a note" * 100):
        np.testing.assert_array_equal(pixels.decode_bgr(data + behind), pixels.decode_bgr(data))


@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]])
def test_a_thumbnail_does_not_end_a_cut_off_picture(options: list[int]) -> None:
    small, large = (
        cv2.imencode(".jpg", np.tile(BGR, (times, times, 1)), options)[1].tobytes()
        for times in (1, 20)
    )
    note = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small  # as in Exif
    data = large[:2] + note + large[2:]
    np.testing.assert_array_equal(pixels.decode_bgr(data), pixels.decode_bgr(large))
    for length in range(len(note), len(data) - 1, len(data) // 50):
        assert pixels.decode_bgr(data[:length]) is None


def scan(tmp_path: Path, ranges: list[float], **changes: float) -> Any:
    with Recorder(tmp_path / "one.mcap") as recorder:
        recorder.scan("/scan", STAMP_NS, ranges, **changes)
    return decode.scan(decoded(tmp_path / "one.mcap"), STAMP_NS)


def test_ranges_follow_our_conventions(tmp_path: Path) -> None:
    inf, nan = float("inf"), float("nan")
    found = scan(tmp_path, [1.0, 0.0, nan, inf, -inf, 0.05, 10.0, 12.0, 9.5])
    expected = np.array([1.0, nan, nan, inf, nan, nan, inf, inf, 9.5], np.float32)
    np.testing.assert_array_equal(found.ranges_m, expected)


def test_a_clockwise_laser_is_turned_round(tmp_path: Path) -> None:
    found = scan(tmp_path, [1.0, 2.0, 3.0], angle_min=0.5, angle_increment=-0.25)
    np.testing.assert_array_equal(found.ranges_m, np.array([3, 2, 1], np.float32))
    assert found.angle_step_rad == 0.25
    np.testing.assert_allclose(found.angles_rad, [0.0, 0.25, 0.5])


@pytest.mark.parametrize(
    ("beam_s", "later_ns"), [(0.01, 10_000_000), (-0.01, 10_000_000), (0.0, 0), (9.0, 0)]
)
def test_a_sweep_has_the_stamp_of_its_middle(tmp_path: Path, beam_s: float, later_ns: int) -> None:
    found = scan(tmp_path, [1.0, 2.0, 3.0], time_increment=beam_s)
    assert found.stamp_ns - STAMP_NS == pytest.approx(later_ns, abs=10)


def test_a_scan_without_angles_is_damaged(tmp_path: Path) -> None:
    assert scan(tmp_path, [1.0], angle_increment=0.0) is None
    assert scan(tmp_path, [1.0], angle_min=float("nan")) is None
    assert scan(tmp_path, []) is None


def cloud_message(times_s: np.ndarray | None = None) -> Any:
    from rosbags.typesys import Stores, get_typestore

    points = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, 6]], np.float32)
    data = Encoder().points(STAMP_NS, points, times_s)
    store = get_typestore(Stores.ROS2_HUMBLE)
    return store.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")


def test_points_that_are_no_numbers_are_dropped_with_their_times() -> None:
    found = cloud(cloud_message(np.array([0.0, 0.05, 0.1])), STAMP_NS)
    np.testing.assert_array_equal(found.points_lidar, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(found.point_times_s, [0.0, 0.1])


@pytest.mark.parametrize("unit", [1.0, 1e9])
@pytest.mark.parametrize(
    ("odd", "odd_m"), [(slice(7, 8), 1.0), (slice(7, 8), 0.0), (slice(5, 45), 0.0)]
)
@pytest.mark.parametrize("odd_time", [0.0, np.nan])
def test_odd_times_of_points_without_a_return_become_the_usual_one(
    unit: float, odd: slice, odd_m: float, odd_time: float
) -> None:
    from rosbags.typesys import Stores, get_typestore

    sweep_s, points = np.linspace(0.0, 0.1, 50), np.ones((50, 3), np.float32)
    times = unit * (STAMP_NS * 1e-9 + sweep_s)
    times[odd], points[odd] = odd_time, odd_m
    data = Encoder().points(STAMP_NS, points, times)
    message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")
    found = cloud(message, STAMP_NS)
    assert found.times is PointTimes.GOOD
    found_s = np.delete(found.point_times_s, odd)
    np.testing.assert_allclose(found_s, np.delete(sweep_s, odd), atol=1e-6)
    np.testing.assert_allclose(found.point_times_s[odd], 0.05, atol=2e-3)


def test_a_cloud_without_any_return_has_its_times() -> None:
    message = cloud_message(SWEEP_S)
    message.data = np.where(np.arange(message.data.size) % 20 < 12, 0, message.data)
    found = cloud(message, STAMP_NS)
    assert not found.points_lidar.any()
    np.testing.assert_allclose(found.point_times_s, SWEEP_S)


def test_absolute_point_times_become_offsets() -> None:
    found = cloud(cloud_message(STAMP_NS * 1e-9 + np.array([0.0, 0.05, 0.1])), STAMP_NS)
    np.testing.assert_allclose(found.point_times_s, [0.0, 0.1], atol=1e-6)


@pytest.mark.parametrize(
    ("times", "kind", "expected_s"),
    [
        (STAMP_NS * 1e-9 + 37 + SWEEP_S, PointTimes.OTHER_CLOCK, SWEEP_S),  # PTP has TAI
        (1000 + SWEEP_S, PointTimes.OTHER_CLOCK, SWEEP_S),  # since the sensor began
        (1e12 + 1e9 * SWEEP_S, PointTimes.OTHER_CLOCK, SWEEP_S),
        (STAMP_NS + 1e9 * SWEEP_S, PointTimes.GOOD, SWEEP_S),
        (1e9 * SWEEP_S, PointTimes.GOOD, SWEEP_S),
        (SWEEP_S - 0.1, PointTimes.GOOD, SWEEP_S - 0.1),
        (STAMP_NS * 1e-3 + 1e6 * SWEEP_S, PointTimes.INVALID, None),
        (1e6 * SWEEP_S, PointTimes.INVALID, None),
        (1e3 * SWEEP_S, PointTimes.INVALID, None),
        (np.nan * SWEEP_S, PointTimes.INVALID, None),
    ],
)
def test_times_of_points_that_no_sweep_has_are_not_believed(
    times: np.ndarray, kind: PointTimes, expected_s: np.ndarray | None
) -> None:
    found = cloud(cloud_message(times), STAMP_NS)
    assert found.times is kind
    if expected_s is None:
        assert found.point_times_s is None
    else:
        np.testing.assert_allclose(found.point_times_s, expected_s[[0, 2]], atol=1e-6)


def test_a_cloud_without_z_or_with_too_few_bytes_is_told() -> None:
    message = cloud_message()
    message.data = message.data[:-1]
    assert cloud(message, STAMP_NS) is None
    message.fields = message.fields[:2]
    with pytest.raises(InputError, match="expected x, y, z, got x, y"):
        cloud(message, STAMP_NS)


def camera_info(**changes: Any) -> Any:
    from rosbags.typesys import Stores, get_typestore

    data = Encoder().camera_info(STAMP_NS, Camera(size_wh=(4, 3), fx=5.0, fy=5.0, cx=2.0, cy=1.0))
    store = get_typestore(Stores.ROS2_HUMBLE)
    message = store.deserialize_cdr(data, "sensor_msgs/msg/CameraInfo")
    for name, value in changes.items():
        setattr(message, name, np.array(value))
    return message


@pytest.mark.parametrize(
    "changes", [{"k": np.zeros(9)}, {"k": [np.nan, 0, 2, 0, 5, 1, 0, 0, 1]}, {"d": [0.1, np.inf]}]
)
def test_a_calibration_that_is_no_number_is_missing(changes: dict[str, Any]) -> None:
    assert decode.camera(camera_info()).fx == 5.0
    assert decode.camera(camera_info(**changes)) is None


def test_rectified_images_have_the_lens_of_the_projection() -> None:
    p = np.array([4.0, 0, 1.5, -0.4, 0, 4.5, 1.2, 0, 0, 0, 1, 0])
    raw = camera_info(p=p, d=[0.1] * 4)
    raw.distortion_model = "equidistant"
    found = decode.camera(raw, is_rectified=True)
    assert (found.fx, found.fy, found.cx, found.cy) == (4.0, 4.5, 1.5, 1.2)
    assert not any(found.distortion)
    without = camera_info(p=np.zeros(12), d=[0.1] * 5)
    found = decode.camera(without, is_rectified=True)
    assert found.fx == 5.0 and found.distortion == (0.1,) * 5


def test_a_lens_that_opencv_does_not_have_is_named() -> None:
    assert decode.camera(camera_info(d=[0.1] * 4)).distortion == (0.1, 0.1, 0.1, 0.1, 0.0)
    with pytest.raises(InputError, match="got 6 coefficients, allowed: 0 to 5, 8, 12 or 14"):
        decode.camera(camera_info(d=[0.1] * 6))
