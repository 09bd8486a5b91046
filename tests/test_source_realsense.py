"""A RealSense camera as a source, on the library's software device: no hardware was tried."""

from __future__ import annotations

import threading
from time import monotonic_ns

import cv2
import numpy as np
import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor

rs = pytest.importorskip("pyrealsense2", reason="the extra realsense is not installed")

from sceneslam.sources.realsense import device as under_test  # noqa: E402
from sceneslam.sources.realsense import source as source_module  # noqa: E402
from sceneslam.sources.realsense.distortion import to_opencv  # noqa: E402
from sceneslam.sources.realsense.source import RealSense  # noqa: E402

W, H = 64, 48
MS = 1_000_000


def intrinsics(model=rs.distortion.brown_conrady, coefficients=(0.0,) * 5):
    made = rs.intrinsics()
    made.width, made.height = W, H
    made.fx, made.fy, made.ppx, made.ppy = 60.0, 61.0, 31.5, 23.5
    made.model, made.coeffs = model, list(coefficients)
    return made


class SoftwareCamera:
    """A D435i of software: depth, colour 15 mm beside it, gyro and accelerometer."""

    def __init__(self, rate_hz=30):
        self.device = rs.software_device()
        self._parts = {name: self.device.add_sensor(name) for name in ("depth", "color", "motion")}
        self._depth = self._video("depth", rs.stream.depth, rs.format.z16, 2, rate_hz)
        self._color = self._video("color", rs.stream.color, rs.format.bgr8, 3, rate_hz)
        self._motion = {
            stream: self._inertial(stream, uid, rate)
            for stream, uid, rate in ((rs.stream.gyro, 3, 200), (rs.stream.accel, 4, 63))
        }
        beside = rs.extrinsics()
        beside.rotation, beside.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0.015, 0.0, 0.0]
        for profile in (self._depth, *self._motion.values()):
            profile.register_extrinsics_to(self._color, beside)
        self._parts["depth"].add_read_only_option(rs.option.depth_units, 0.001)
        switch = rs.option_range()
        switch.min, switch.max, switch.step, switch.default = 0.0, 1.0, 1.0, 0.0
        self._parts["depth"].add_option(rs.option.emitter_enabled, switch, True)
        self._count = 0

    @property
    def is_emitting(self):
        return self._parts["depth"].get_option(rs.option.emitter_enabled) == 1.0

    def measure(self, stamp_ns, *, has_depth=True, has_image=True):
        """Send what it sees and feels at one instant: level, turning left at 0.5 rad/s."""
        for stream, vector in (
            (rs.stream.gyro, (0.0, -0.5, 0.0)),
            (rs.stream.accel, (0.0, -9.8, 0.0)),
        ):
            frame, felt = rs.software_motion_frame(), rs.vector()
            felt.x, felt.y, felt.z = vector
            frame.data, frame.profile = felt, self._motion[stream].as_motion_stream_profile()
            self._stamp(frame, stamp_ns)
            self._parts["motion"].on_motion_frame(frame)
        if has_depth:
            depth = np.full((H, W), 2000, np.uint16)
            depth[:, : W // 2] = 9000  # beyond the range
            self._send("depth", self._depth, depth, 2, stamp_ns)
        if has_image:
            self._send("color", self._color, np.full((H, W, 3), 7, np.uint8), 3, stamp_ns)

    def _video(self, part, kind, form, size, rate_hz):
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid = kind, 0, size
        stream.width, stream.height, stream.fps = W, H, rate_hz
        stream.bpp, stream.fmt, stream.intrinsics = size, form, intrinsics()
        return self._parts[part].add_video_stream(stream)

    def _inertial(self, kind, uid, rate_hz):
        stream = rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid + 10, rate_hz
        stream.fmt, stream.intrinsics = rs.format.motion_xyz32f, rs.motion_device_intrinsic()
        return self._parts["motion"].add_motion_stream(stream)

    def _send(self, part, profile, pixels, size, stamp_ns):
        frame = rs.software_video_frame()
        frame.pixels, frame.bpp, frame.stride = pixels, size, W * size
        frame.profile = profile.as_video_stream_profile()
        if part == "depth":
            frame.depth_units = 0.001
        self._stamp(frame, stamp_ns)
        self._parts[part].on_video_frame(frame)

    def _stamp(self, frame, stamp_ns):
        self._count += 1
        frame.timestamp, frame.frame_number = stamp_ns / 1e6, self._count
        frame.domain = rs.timestamp_domain.hardware_clock


@pytest.fixture
def make(monkeypatch):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        config = OmegaConf.to_container(compose("source/realsense").source)
    config.pop("_target_")

    def made(camera, **words):
        monkeypatch.setattr(under_test, "find_device", lambda serial: camera.device)
        return RealSense(**(config | {"size_wh": [W, H], "silent_after_s": 5.0} | words))

    return made


def measured(source, camera, count=4, **words):
    """Return the first observations while the camera measures 30 times a second of its clock."""
    is_over, found = threading.Event(), []

    def talk():
        index = 0
        while not is_over.wait(0.005):
            camera.measure(10**12 + index * 33 * MS, **words)
            index += 1

    thread = threading.Thread(target=talk)
    observations = iter(source)
    thread.start()
    try:
        found = [next(observations) for _ in range(count)]
    finally:
        is_over.set()
        thread.join()
        source.close()
    return found


def test_rig_is_the_factorys_calibration(make):
    camera = SoftwareCamera()
    rig = make(camera, mount={"xyz_m": [0.1, 0.0, 0.3], "rpy_rad": [0.0, 0.0, 0.0]}).rig
    assert rig.sensors == {Sensor.IMAGE, Sensor.DEPTH, Sensor.GYRO, Sensor.ACCELEROMETER}
    assert rig.camera.size_wh == (W, H)
    assert (rig.camera.fx, rig.camera.fy, rig.camera.cx, rig.camera.cy) == (60.0, 61.0, 31.5, 23.5)
    np.testing.assert_allclose(rig.camera.T_base_cam[:3, 3], [0.1, 0.0, 0.3])
    np.testing.assert_allclose(rig.camera.T_base_cam[:3, 2], [1.0, 0.0, 0.0])  # looks along x


@pytest.mark.parametrize("emitter", [True, False])
def test_emitter_is_as_asked_for(make, emitter):
    camera = SoftwareCamera()
    _ = make(camera, emitter=emitter).rig
    assert camera.is_emitting is emitter


def test_observation_holds_image_aligned_depth_and_motion_in_base(make):
    camera = SoftwareCamera()
    found = measured(make(camera), camera)[-1]
    assert found.image_bgr.shape == (H, W, 3) and found.image_bgr.max() == 7
    assert found.depth_m.shape == (H, W) and found.depth_m.dtype == np.float32
    near = found.depth_m[:, -20:-2]
    np.testing.assert_allclose(near, 2.0, atol=1e-3)
    assert not found.depth_m[:, : W // 2 - 2].any()  # 9 m: not measured
    np.testing.assert_allclose(found.gyro_base[-1, 1:], [0.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(found.accelerometer_base[-1, 1:], [0.0, 0.0, 9.8], atol=1e-5)
    assert (found.gyro_base[:, 0] <= 0).all()


def test_image_whose_depth_does_not_come_is_given_without(make):
    camera = SoftwareCamera()
    found = measured(make(camera), camera, has_depth=False)
    assert all(one.image_bgr is not None and one.depth_m is None for one in found)


def test_stamps_rise_and_latency_is_known(make):
    camera = SoftwareCamera()
    source = make(camera)
    found = measured(source, camera, count=6)
    assert (np.diff([one.stamp_ns for one in found]) > 0).all()
    assert 0 <= monotonic_ns() - source.measured_ns(found[-1]) < 60e9


def test_camera_that_falls_silent_is_named_and_opened_again(make):
    camera = SoftwareCamera()
    source = make(camera, silent_after_s=0.2)
    opened = []
    source_open = source._opener
    source._opener = lambda serial, wanted: opened.append(serial) or source_open(serial, wanted)
    observations = iter(source)
    feeder = threading.Timer(1.5, source.close)
    feeder.start()
    assert next(observations, None) is None  # it gave nothing, and was closed
    feeder.join()
    events = [(one["event"], one["topic"]) for one in source.notices()]
    assert ("stream_silent", "image") in events
    assert len(opened) > 1


def test_camera_whose_images_stall_while_its_imu_goes_on_is_opened_again(make):
    camera, is_reopened = SoftwareCamera(), threading.Event()
    source = make(camera, silent_after_s=0.2)
    _ = source.rig
    source_open = source._opener

    def reopen(serial, wanted):
        is_reopened.set()
        return source_open(serial, wanted)

    def talk():
        for index in range(300):
            camera.measure(10**12 + index * 10 * MS, has_depth=False, has_image=False)
            if is_reopened.wait(0.01):
                break
        source.close()

    source._opener = reopen
    thread = threading.Thread(target=talk)
    observations = iter(source)
    thread.start()
    assert next(observations, None) is None
    thread.join()
    assert is_reopened.is_set()


def test_camera_that_opens_slowly_has_time_to_give_an_image(make, monkeypatch):
    now_ns, opened_ns = [10**12], []
    source = make(SoftwareCamera(), silent_after_s=1.0)
    source_open = source._opener

    def open_slowly(serial, wanted):
        now_ns[0] += 3000 * MS
        opened_ns.append(now_ns[0])
        return source_open(serial, wanted)

    def wait(timeout_s):
        now_ns[0] += round(timeout_s * 1e9)
        if len(opened_ns) == 3:
            source.close()

    monkeypatch.setattr(source_module, "monotonic_ns", lambda: now_ns[0])
    source._opener, source._waiting.take = open_slowly, wait
    assert not list(source)
    assert np.diff(opened_ns).min() > 4000 * MS


def test_size_that_the_camera_lacks_is_named_with_what_it_has(make):
    with pytest.raises(InputError, match=r"640x480 at 30 Hz; the camera has 64x48 at 30 Hz"):
        _ = make(SoftwareCamera(), size_wh=[640, 480]).rig


def test_no_camera_is_said_in_a_sentence():
    with pytest.raises(InputError, match="no RealSense camera"):
        under_test.find_device(None)


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ({"size_wh": [64]}, "size_wh"),
        ({"rate_hz": 0}, "rate_hz"),
        ({"mount": {"xyz": [0, 0, 0]}}, "mount.xyz"),
        ({"mount": {"xyz_m": [0, 0]}}, "mount.xyz_m"),
        ({"depth_range_m": [3, 1]}, "depth_range_m"),
    ],
)
def test_impossible_settings_are_refused(make, words, key):
    with pytest.raises(ConfigError, match=key):
        make(SoftwareCamera(), **words)


@pytest.mark.parametrize("model", ["brown_conrady", "inverse_brown_conrady"])
def test_distortion_is_turned_into_opencvs(model):
    coefficients = (-0.05, 0.02, 0.001, -0.0007, 0.001)
    found = intrinsics(getattr(rs.distortion, model), coefficients)
    K = np.array([[found.fx, 0, found.ppx], [0, found.fy, found.ppy], [0, 0, 1.0]])
    pixels = np.array([[5.0, 6.0], [60.0, 40.0], [31.0, 2.0]])
    rays = np.array([rs.rs2_deproject_pixel_to_point(found, list(one), 1.0) for one in pixels])
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(to_opencv(found)))
    np.testing.assert_allclose(seen[:, 0], pixels, atol=0.02)


def test_lens_that_the_model_does_not_describe_is_refused():
    with pytest.raises(InputError, match="off by"):
        to_opencv(intrinsics(rs.distortion.ftheta, (0.9, 0.0, 0.0, 0.0, 0.0)))
