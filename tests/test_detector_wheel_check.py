"""The check of wheel odometry: true motion, by two scans, over that of the wheels."""

import numpy as np
import pytest

from sceneslam.modules.detectors.wheel_check import WheelCheck
from sceneslam.testing.floor_plans import Scanner, World, box
from sceneslam.types import planar, se3
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Rig, Sensor

S = 10**9
ROOM = World(box(-2.0, -1.5, 3.0, 2.5), np.random.default_rng(0), Scanner(noise_m=0.005))


def wheel_ratio(step, told, count=12):
    """Return the ratio after a drive of steps (3,), of which the wheels report others."""
    check = WheelCheck(Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()))
    pose = wheels = np.zeros(3)
    for index in range(count):
        stamp_ns = round(0.1 * index * S)
        ratio = check(
            Observation(
                stamp_ns=stamp_ns,
                scan=ROOM.scan(pose, stamp_ns),
                T_odom_base=planar.to_transform(wheels),
            )
        )
        pose, wheels = planar.compose(pose, np.array(step)), planar.compose(wheels, np.array(told))
    return ratio


@pytest.mark.parametrize(
    ("step", "told", "ratio"),
    [
        ((0.05, 0, 0.03), (0.05, 0, 0.03), 1.0),
        ((0.0, 0, 0.0), (0.0, 0, 0.0), 1.0),
        ((0.0, 0, 0.0), (0.08, 0, 0.0), 0.0),
        ((0.04, 0, 0.0), (0.08, 0, 0.0), 0.5),
        ((-0.05, 0, 0.0), (0.05, 0, 0.0), -1.0),
        ((0.06, 0, 0.0), (0.0, 0, 0.0), 10.0),
        ((0.05, 0, 0.06), (0.1, 0, 0.06), 0.5),
    ],
)
def test_the_ratio_of_true_motion_to_the_wheels_is_measured_by_scans(step, told, ratio):
    assert wheel_ratio(step, told) == pytest.approx(ratio, abs=0.15)


def wall_ahead(distance_m, count=61, mount_rad=0.0):
    """Return a scan of a wall ahead of `base`, by a laser that is mounted with a yaw."""
    angles_rad = np.linspace(-0.3, 0.3, count)
    return LaserScan(
        stamp_ns=0,
        ranges_m=(distance_m / np.cos(angles_rad + mount_rad)).astype(np.float32),
        angle_min_rad=-0.3,
        angle_step_rad=0.6 / (count - 1),
        range_min_m=0.1,
        range_max_m=9.0,
    )


class Approach:
    """A robot in front of a wall, whose wheels report a motion of their own."""

    def __init__(self, mount_rad=0.0, camera=None):
        laser = Laser(T_base_laser=se3.from_xy_yaw(0.0, 0.0, mount_rad))
        sensors = frozenset({Sensor.SCAN, Sensor.ODOMETRY})
        self.check = WheelCheck(
            Rig(sensors=sensors, laser=None if camera else laser, camera=camera)
        )
        self._mount_rad = mount_rad

    def see(self, at_s, forward_m, wheels_m, wheels_rad=0.0, *, count=61, **other):
        """Return the ratio after a scan where the robot is, and where its wheels say."""
        given = {
            "scan": wall_ahead(3.0 - forward_m, count, self._mount_rad),
            "T_odom_base": se3.from_xy_yaw(1.0 + wheels_m, 0.0, wheels_rad),
            **other,
        }
        return self.check(Observation(stamp_ns=S + round(at_s * S), **given))

    def drive(self, forward_m, wheels_m, wheels_rad=0.0, *, during_s=0.5, **other):
        """Return the ratio after a motion between two scans."""
        self.see(0.0, 0.0, 0.0, **other)
        return self.see(during_s, forward_m, wheels_m, wheels_rad, **other)


@pytest.mark.parametrize(
    ("wheels_m", "ratio"), [(0.045, 1.0), (0.055, 0.0), (-0.045, 1.0), (-0.055, 0.0)]
)
def test_wheels_are_correct_within_5_cm(wheels_m, ratio):
    # Their motion may be 2 cm off, and the scans then misfit by 3 cm: the wall's distance.
    assert Approach().drive(0.0, wheels_m) == pytest.approx(ratio)
    assert Approach().drive(0.4, 0.4 + wheels_m) == pytest.approx(
        1.0 if ratio else 0.4 / (0.4 + wheels_m)
    )


@pytest.mark.parametrize(
    ("wheels_m", "wheels_rad", "ratio"),
    [
        (0.0, 0.0, 10.0),
        (-0.009, 0.0, 10.0),
        (-0.011, 0.0, -10.0),
        (0.011, 0.0, 10.0),
        (0.0, 0.009, 10.0),
        (0.0, 0.011, 1.0),
        (0.0, -0.011, 1.0),
        (0.1, 0.0, 4.0),
    ],
)
def test_wheels_stand_below_1_cm_and_0_01_rad(wheels_m, wheels_rad, ratio):
    assert Approach().drive(0.4, wheels_m, wheels_rad) == pytest.approx(ratio)


@pytest.mark.parametrize(
    ("during_s", "ratio"), [(0.399, 1.0), (0.4, 0.5), (0.8, 0.5), (0.800000001, 1.0)]
)
def test_scans_are_compared_over_0_4_to_0_8_s(during_s, ratio):
    assert Approach().drive(0.24, 0.48, during_s=during_s) == pytest.approx(ratio)


def test_a_scan_is_compared_with_the_latest_one_0_4_s_ago():
    robot = Approach()
    ratios = [robot.see(0.0, 0.0, 0.0), robot.see(0.3, 0.4, 0.4), robot.see(0.7, 0.4, 0.8)]
    assert ratios == pytest.approx([1.0, 1.0, 0.0])


def test_a_ratio_is_valid_for_0_8_s():
    robot = Approach()
    assert robot.drive(0.24, 0.48) == pytest.approx(0.5)
    assert robot.check(Observation(stamp_ns=S + round(1.3 * S))) == pytest.approx(0.5)
    assert robot.check(Observation(stamp_ns=S + round(1.3 * S) + 1)) == 1.0


def test_a_scan_needs_30_returns_and_odometry():
    assert Approach().drive(0.24, 0.48, count=30) == pytest.approx(0.5)
    assert Approach().drive(0.24, 0.48, count=29) == 1.0
    assert Approach().drive(0.24, 0.48, T_odom_base=None) == 1.0
    assert Approach().drive(0.24, 0.48, T_odom_base=np.full((4, 4), np.nan)) == 1.0


def test_beams_without_a_return_are_ignored_and_the_lasers_mounting_counts():
    robot = Approach(mount_rad=0.5)
    for at_s, forward_m, wheels_m in ((0.0, 0.0, 0.0), (0.5, 0.24, 0.48)):
        scan = wall_ahead(3.0 - forward_m, mount_rad=0.5)
        scan.ranges_m[::5], scan.ranges_m[3::10], scan.ranges_m[6::10] = np.inf, 0.1, np.nan
        ratio = robot.see(at_s, forward_m, wheels_m, scan=scan)
    assert ratio == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("height_px", [0.0, 50.4, 99.0])
@pytest.mark.parametrize("rows", [slice(-2, 1), slice(0, 3)])
def test_of_a_depth_image_the_rows_at_the_cameras_height_count(height_px, rows):
    camera = Camera(size_wh=(160, 100), fx=150.0, fy=150.0, cx=80.0, cy=height_px)
    row = {0.0: 2, 50.4: 50, 99.0: 97}[height_px]
    robot = Approach(camera=camera)
    for at_s, forward_m, wheels_m in ((0.0, 0.0, 0.0), (0.5, 0.24, 0.48)):
        depth_m = np.full((100, 160), 1.0, np.float32)
        depth_m[row + rows.start : row + rows.stop] = 3.0 - forward_m
        depth_m[:, :30] = 0.0
        ratio = robot.see(at_s, forward_m, wheels_m, depth_m=depth_m)
    assert ratio == pytest.approx(0.5)
