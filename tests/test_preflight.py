"""What is said of a recording before it is run, and of a run that found no pose."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from configured import config
from ros_recordings import STAMP_NS, Recorder

from sceneslam.app import run
from sceneslam.sources.bag.observation import Mounts
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.sources.carmen import Carmen
from sceneslam.sources.kitti import Kitti
from sceneslam.sources.rosbag import RosBag
from sceneslam.sources.survey.bag_sample import survey_recording
from sceneslam.sources.survey.preflight import preflight
from sceneslam.sources.survey.survey import Stream, Survey
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Camera, Lidar, Rig, Sensor
from sceneslam.types.se3 import from_xy_yaw

CAMERA = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "distortion": None}
TOPICS = dict.fromkeys(
    ("image", "depth", "camera_info", "scan", "points", "odometry", "imu", "ground_truth", "scene")
)


def write_folder(folder, *, units_per_m=5000, apart_s=0.005, count=20):
    """Write a TUM folder of a wall that is 1 to 3 m away, its depth `apart_s` late."""
    random = np.random.default_rng(1)
    lists = {"rgb": [], "depth": []}
    for index in range(count):
        image = random.integers(0, 255, (48, 64, 3), np.uint8)
        depth_m = np.tile(np.linspace(1.0, 3.0, 64), (48, 1))
        cv2.imwrite(str(folder / f"rgb{index}.png"), image)
        stored = np.round(depth_m * units_per_m).astype(np.uint16)
        cv2.imwrite(str(folder / f"depth{index}.png"), stored)
        stamp_s = 100.0 + index / 10
        lists["rgb"].append(f"{stamp_s:.4f} rgb{index}.png\n")
        lists["depth"].append(f"{stamp_s + apart_s:.4f} depth{index}.png\n")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("".join(lines))
    return folder


def tum(folder, depth_scale=5000.0, camera=CAMERA):
    return TumRgbd(str(folder), camera, depth_scale, [0.3, 8.0], 0.02)


def bag(path):
    return RosBag(str(path), TOPICS, {}, 1000.0, None, None, 0.02, 1.0, None, None, None)


def told(source):
    return preflight(source.survey(), source.rig)


def test_every_sensor_has_a_line(tmp_path):
    found = told(tum(write_folder(tmp_path)))
    assert found.warnings == ()
    image, depth = found.lines
    assert "rgb.txt: 20 messages, 10 Hz" in image and "100% with depth" in image
    assert "100.000 to 101.900 s" in image and "median depth 1.95 m" in depth


@pytest.mark.parametrize(("stored", "read"), [(1000, 5000.0), (5000, 1000.0)])
def test_depth_in_another_unit_is_noticed_and_the_right_one_proposed(tmp_path, stored, read):
    (warning,) = told(tum(write_folder(tmp_path, units_per_m=stored), read)).warnings
    assert f"is source.depth_scale {read:g} right? With {stored} it would be 100%" in warning


def test_images_that_never_meet_their_depth_are_noticed(tmp_path):
    (warning,) = told(tum(write_folder(tmp_path, apart_s=0.04))).warnings
    assert "only 0% of the images have depth within source.sync_tolerance_s 0.02" in warning
    assert "the nearest depth image is 0.04 s away" in warning


def test_depth_at_half_the_rate_of_the_images_is_no_cause_for_a_warning(tmp_path):
    write_folder(tmp_path)
    lines = (tmp_path / "depth.txt").read_text().splitlines(keepends=True)
    (tmp_path / "depth.txt").write_text("".join(lines[::2]))
    assert told(tum(tmp_path)).warnings == ()


def test_intrinsics_of_another_resolution_are_noticed(tmp_path):
    camera = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "distortion": None}
    warnings = told(tum(write_folder(tmp_path), camera=camera)).warnings
    assert len(warnings) == 2 and all("of another resolution" in one for one in warnings)


STAMPS_NS = np.arange(50, dtype=np.int64) * 100_000_000


def stream(sensor, stamps_ns=STAMPS_NS):
    return Stream(sensor=sensor, place="/topic", count=len(stamps_ns), stamps_ns=stamps_ns)


def scan(ranges_m):
    return LaserScan(
        stamp_ns=0,
        ranges_m=np.array(ranges_m, np.float32),
        angle_min_rad=0.0,
        angle_step_rad=0.01,
        range_min_m=0.1,
        range_max_m=30.0,
    )


def poses(speed_mps):
    return [from_xy_yaw(speed_mps * stamp_ns * 1e-9, 0.0, 0.0) for stamp_ns in STAMPS_NS.tolist()]


def cloud(scale):
    return np.random.default_rng(2).uniform(-20, 20, (500, 3)).astype(np.float32) * scale


SURVEYS = {  # sensor -> what is plausible, what is not, what is said of it
    Sensor.SCAN: ({"scans": [scan([2, 3, 4])]}, {"scans": [scan([np.inf] * 3)]}, "beams return"),
    Sensor.POINTS: ({"clouds": [cloud(1)]}, {"clouds": [cloud(1000)]}, "0% of the points"),
    Sensor.ODOMETRY: (
        {"T_odom_base": poses(20.0), "odometry_ns": STAMPS_NS},
        {"T_odom_base": poses(1000.0), "odometry_ns": STAMPS_NS},
        "1e+03 m/s are implausible",
    ),
    Sensor.GYRO: (
        {"gyro_radps": [np.array([0.0, 0.0, 3.0])]},
        {"gyro_radps": [np.array([0.0, 0.0, 172.0])]},
        "172 rad/s are implausible; is its unit degrees?",
    ),
    Sensor.ACCELEROMETER: (
        {"forces_mps2": [np.array([0.5, 0.0, 9.6]), np.array([0.0, 0.0, 30.0]), np.ones(3) * 5]},
        {"forces_mps2": [np.array([0.0, 0.0, 1.0])]},
        "an acceleration of 1 m/s^2 in the median is implausible, as gravity is 9.81; is its unit",
    ),
}


@pytest.mark.parametrize("sensor", SURVEYS)
def test_sensor_in_another_unit_is_noticed(sensor):
    right, wrong, said = SURVEYS[sensor]
    rig = Rig(sensors=frozenset({sensor}), lidar=Lidar())
    assert preflight(Survey(streams=[stream(sensor)], **right), rig).warnings == ()
    (warning,) = preflight(Survey(streams=[stream(sensor)], **wrong), rig).warnings
    assert said in warning


@pytest.mark.parametrize("factor", [1000, 10**6])
def test_stamps_in_another_unit_are_noticed(factor):
    rig = Rig(
        sensors=frozenset({Sensor.IMAGE}),
        camera=Camera(size_wh=(64, 48), fx=60.0, fy=60.0, cx=32.0, cy=24.0),
    )
    (warning,) = preflight(Survey(streams=[stream(Sensor.IMAGE, STAMPS_NS * factor)]), rig).warnings
    assert "are the stamps in seconds?" in warning


def test_sensors_without_a_common_time_are_noticed():
    streams = [stream(Sensor.IMAGE), stream(Sensor.DEPTH, STAMPS_NS + 10**15)]
    rig = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH}))
    assert "have no time in common" in preflight(Survey(streams=streams), rig).warnings[0]


@pytest.mark.parametrize(
    ("period_s", "silent_after_s", "said"),
    [
        (0.8, 1.0, "about 88% of its messages lie between those of /image"),
        (0.8, None, ""),  # each sensor has observations of its own
        (0.15, 1.0, ""),
        (1.9, 1.0, ""),  # the lidar sets the pace half of the time
        (1.6, 1.0, "about 56%"),
    ],
)
def test_clouds_between_images_of_a_slow_camera_are_noticed(period_s, silent_after_s, said):
    times_ns = np.arange(10, dtype=np.int64)
    image = replace(stream(Sensor.IMAGE, times_ns * round(period_s * 1e9)), place="/image")
    survey = Survey(
        streams=[image, stream(Sensor.POINTS, times_ns * 10**8)], silent_after_s=silent_after_s
    )
    found = preflight(survey, Rig(sensors=frozenset({Sensor.IMAGE, Sensor.POINTS}))).warnings
    assert len(found) == bool(said)
    assert all(said in one and "source.topics.image=none uses them" in one for one in found)


@pytest.mark.parametrize(
    ("delay_s", "said"),
    [(0.4, ""), (None, ""), (-36.95, "37.0 s ahead of"), (37.05, "37.0 s behind")],
)
def test_a_sensor_with_another_clock_is_noticed(delay_s, said):
    streams = [
        replace(stream(Sensor.IMAGE), delay_s=0.05),
        replace(stream(Sensor.SCAN), delay_s=delay_s),
    ]
    found = preflight(Survey(streams=streams), Rig(sensors=frozenset({Sensor.IMAGE}))).warnings
    assert len(found) == bool(said)
    assert said in "".join(found)


MOUNTS = Mounts(T_base_imu=np.eye(4), T_child_base=np.eye(4))
STREAMS = {Sensor.IMAGE: "/image", Sensor.DEPTH: "/depth", Sensor.SCAN: "/scan"}
CAMERA_RIG = Rig(
    sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH}),
    camera=Camera(size_wh=(4, 3), fx=4.0, fy=4.0, cx=1.5, cy=1.0),
)


def sampled(path, times_s, *, is_slow, tolerance_s=0.02):
    """Return the survey of a recording with messages at `times_s` of some topics."""
    messages = [(STAMP_NS + round(at * 1e9), topic) for topic in times_s for at in times_s[topic]]
    with Recorder(path) as recorder:
        for at_ns, topic in sorted(messages):
            if topic == "/image":
                recorder.image(topic, at_ns, np.zeros((3, 4, 3), np.uint8))
            elif topic == "/depth":
                recorder.image(topic, at_ns, np.full((3, 4, 1), 2000, np.uint16), "16UC1")
            else:
                recorder.scan(topic, at_ns, [1.0] * 21)
    recording = open_recording(path)
    recording.is_slow = is_slow  # as a bag that bzip2 packed
    topics = {sensor: topic for sensor, topic in STREAMS.items() if topic in times_s}
    return survey_recording(
        recording,
        topics,
        depth_scale=1000.0,
        sync_tolerance_s=tolerance_s,
        silent_after_s=1.0,
        mounts=MOUNTS,
    )


def every(period_s, since_s, until_s):
    return np.arange(since_s, until_s, period_s).tolist()


@pytest.mark.parametrize("is_slow", [False, True])
def test_first_and_last_stamp_are_the_recordings_however_little_is_sampled(tmp_path, is_slow):
    first_s, first_ns = 150e-9, STAMP_NS + 150  # a float64 of nanoseconds is 85 ns later
    times_s = {"/scan": every(0.1, first_s, 20), "/of_another_robot": every(0.1, 1, 60)}
    survey = sampled(tmp_path / "scans.mcap", times_s, is_slow=is_slow)
    (scans,) = survey.streams
    assert scans.stamps_ns[[0, -1]].tolist() == [first_ns, first_ns + 19_900_000_000]
    assert scans.sampled_ns[1][0] == first_ns
    assert len(scans.stamps_ns) < scans.count == 200
    assert scans.delay_s == 0.0
    assert all(len(span_ns) for span_ns in scans.sampled_ns)
    (line,) = preflight(survey, Rig(sensors=frozenset({Sensor.SCAN}))).lines
    assert "; sampled: 10 Hz, 100% of beams return" in line


PLAUSIBLE = {  # times [s] of images and depth images
    "depth that begins late": (every(0.1, 0, 3), every(0.1, 0.5, 3)),
    "an image in three": (every(0.3, 0, 3), every(0.1, 0.1, 3)),
    "an image in two seconds": (every(1.9, 0, 60), every(0.1, 0.25, 60)),
    "a depth image in two seconds": (every(0.1, 0, 60), every(1.9, 0.25, 60)),
}


@pytest.mark.parametrize("is_slow", [False, True])
@pytest.mark.parametrize(("images_s", "depths_s"), PLAUSIBLE.values(), ids=PLAUSIBLE)
def test_what_a_sample_does_not_hold_is_not_missing(tmp_path, images_s, depths_s, is_slow):
    times_s = {"/image": images_s, "/depth": depths_s}
    survey = sampled(tmp_path / "views.mcap", times_s, is_slow=is_slow)
    found = preflight(survey, CAMERA_RIG)
    assert found.warnings == ()
    assert "; sampled: " in found.lines[1] and "median depth 2.00 m" in found.lines[1]


@pytest.mark.parametrize("is_slow", [False, True])
def test_images_without_their_depth_are_noticed_in_a_sample(tmp_path, is_slow):
    times_s = {"/image": every(0.03, 0, 20), "/depth": every(0.03, 0.015, 20)}
    survey = sampled(tmp_path / "views.mcap", times_s, is_slow=is_slow, tolerance_s=0.01)
    (warning,) = preflight(survey, CAMERA_RIG).warnings
    assert "only 0% of the images have depth within source.sync_tolerance_s 0.01" in warning


def test_a_short_recording_is_read_as_a_whole(tmp_path):
    times_s = {"/image": every(0.1, 0, 4.5), "/depth": every(0.1, 0.5, 4.5)}
    survey = sampled(tmp_path / "views.mcap", times_s, is_slow=False)
    image, depth = preflight(survey, CAMERA_RIG).lines
    assert "sampled" not in image and "89% with depth" in image
    assert "40 messages, 10 Hz" in depth


def test_real_recordings_with_their_own_settings_give_no_warning(shared_data):
    kinect = {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0, "distortion": None}
    names = ("fx", "fy", "cx", "cy", "distortion")
    sources = [
        tum(shared_data / "tum_fr1_rpy", camera=dict.fromkeys(names)),
        tum(shared_data / "7scenes_redkitchen", 1000.0, kinect),
        Kitti(str(shared_data / "kitti_raw_2011_09_26_drive_0001"), [1.0, 100.0], 0.205),
        *(Carmen(str(path), 80.0, None) for path in sorted(shared_data.glob("carmen_*/*.clf"))),
        *(bag(shared_data / "bags" / name) for name in ("hokuyo_scan.bag", "hokuyo_scan_db3")),
        *(bag(shared_data / "bags" / name) for name in ("rgbd_3s.bag", "rgbd_3s_ros2.mcap")),
    ]
    found = [told(source) for source in sources]
    assert len(found) == 10 and all(one.lines for one in found)
    assert [one.warnings for one in found] == [()] * len(found)
    (warning,) = told(tum(shared_data / "7scenes_redkitchen", 5000.0, kinect)).warnings
    assert "With 1000 it would be 100%" in warning


def test_run_without_a_pose_names_module_and_cause(tmp_path):
    write_folder(tmp_path, apart_s=0.04)
    source = {
        "_target_": "sceneslam.sources.tum_rgbd.TumRgbd",
        "path": str(tmp_path),
        "camera": CAMERA,
        "depth_scale": 5000.0,
        "depth_range_m": [0.3, 8.0],
        "sync_tolerance_s": 0.02,
    }
    said = []
    lost = {"_target_": "fakes.DepthModule"}
    made = config(source=source, slam={"bright": lost, "dark": lost}, run__report=False)
    finished = run(made, tmp_path / "out", say=said.append)
    (fault,) = finished.faults
    assert fault.startswith("no pose: module bright and dark was lost") or "bright" in fault
    assert "of 20 observations, 20 with an image, 0 with depth. Most likely: only 0%" in fault
    assert "warning: only 0% of the images have depth" in said[0]
    assert finished.metrics["warnings"] == [fault.partition("Most likely: ")[2]]
