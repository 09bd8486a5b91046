"""Odometry that was reset, or misread once, and what is made of it."""

from dataclasses import replace

import numpy as np
import pytest
from test_source_ordered import Listed

from sceneslam.sources.contract.clean import cleaned
from sceneslam.sources.contract.ordered import Ordered
from sceneslam.sources.faults import FaultLog
from sceneslam.types import se3
from sceneslam.types.observation import Observation

PERIOD_NS = 100_000_000
TWIST = np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.3])  # per second
FAR = se3.from_xy_yaw(30.0, -4.0, 2.0)


def true_pose(index):
    return se3.exp(index * PERIOD_NS / 1e9 * TWIST)


def drive(struck):
    """Return the odometry (N, 4, 4) of a drive, through `Ordered`, and its faults."""
    listed = [
        Observation(stamp_ns=i * PERIOD_NS, T_odom_base=struck(i, true_pose(i))) for i in range(30)
    ]
    ordered = Ordered(Listed(listed))
    return np.stack([observation.T_odom_base for observation in ordered]), ordered.faults


def assert_true(T_odom_base):
    true = np.stack([true_pose(index) for index in range(len(T_odom_base))])
    np.testing.assert_allclose(T_odom_base, true, atol=1e-9)


@pytest.mark.parametrize("T_new_old", [FAR, se3.from_xy_yaw(2.0, 0.0, 0.0), se3.inverse(FAR)])
def test_odometry_that_was_reset_goes_on_from_where_it_was(T_new_old):
    told, faults = drive(lambda i, T: T_new_old @ T if i >= 10 else T)
    assert_true(told)
    assert faults == ["odometry that jumps: 1 time at stamp 1.000000 s"]


@pytest.mark.parametrize("index", [10, 17, 25])
def test_odometry_that_begins_anew_at_the_origin_goes_on_after_a_third_of_a_metre_already(index):
    T_new_old = se3.inverse(true_pose(index))
    told, faults = drive(lambda i, T: T_new_old @ T if i >= index else T)
    assert_true(told)
    assert len(faults) == 1


def test_turn_alone_is_a_jump_too():
    told, _ = drive(lambda i, T: se3.from_xy_yaw(0.0, 0.0, 1.5) @ T if i >= 10 else T)
    assert_true(told)


def test_one_wrong_reading_is_two_jumps():
    told, faults = drive(lambda i, T: FAR @ T if i == 10 else T)
    assert_true(told)
    assert faults[0].startswith("odometry that jumps: 2 times")


def test_hard_braking_slips_and_gaps_are_no_jumps():
    stops = [0.0] * 10 + [0.3] * 5 + [0.0] * 5 + [1.0] + [0.0] * 9  # m; the last after 2 s
    way_m, stamp_ns, listed = 0.0, 0, []
    for step_m in stops:
        way_m, stamp_ns = way_m + step_m, stamp_ns + (20 if step_m == 1.0 else 1) * PERIOD_NS
        T_odom_base = se3.from_xy_yaw(way_m, 0.0, 0.0)
        listed.append(Observation(stamp_ns=stamp_ns, T_odom_base=T_odom_base))
    ordered = Ordered(Listed(listed))
    assert list(ordered) == listed and ordered.faults == []


def drive_fast(struck):
    """Return the positions (30,) [m] of a car at 12 m/s, 10 Hz, through `Ordered`, and faults."""
    poses = [se3.from_xy_yaw(struck(index), 0.0, 0.0) for index in range(30)]
    listed = [Observation(stamp_ns=i * PERIOD_NS, T_odom_base=T) for i, T in enumerate(poses)]
    ordered = Ordered(Listed(listed))
    return np.array([found.T_odom_base[0, 3] for found in ordered]), ordered.faults


def test_car_that_drives_from_the_first_step_on_has_no_jumps():
    told, faults = drive_fast(lambda i: 1.2 * i)
    np.testing.assert_allclose(told, 1.2 * np.arange(30), atol=1e-9)
    assert faults == []


@pytest.mark.parametrize("frozen", [1, 15])
def test_odometry_of_a_car_goes_on_after_it_was_frozen(frozen):
    """What it made good at once is a jump; the next step is believed when it repeats."""
    told, faults = drive_fast(lambda i: 1.2 * (10 if 10 < i < 11 + frozen else i))
    np.testing.assert_allclose(np.diff(told)[:10], 1.2, atol=1e-9)
    np.testing.assert_allclose(np.diff(told)[13 + frozen :], 1.2, atol=1e-9)
    assert len(faults) == 1


def test_one_wrong_reading_of_a_car_is_two_jumps():
    told, faults = drive_fast(lambda i: 1.2 * i + (9.0 if i == 10 else 0.0))
    np.testing.assert_allclose(told, 1.2 * np.arange(30), atol=1e-9)
    assert faults[0].startswith("odometry that jumps: 2 times")


def test_what_was_reset_in_a_silence_goes_on_at_the_speed_before():
    def struck(index, T_odom_base):
        return None if 10 <= index < 13 else (FAR if index > 10 else np.eye(4)) @ T_odom_base

    listed = [
        Observation(stamp_ns=i * PERIOD_NS, T_odom_base=struck(i, true_pose(i))) for i in range(30)
    ]
    told = [found.T_odom_base for found in Ordered(Listed(listed))]
    assert told[10:13] == [None] * 3
    for index in (9, 13, 29):
        np.testing.assert_allclose(told[index], true_pose(index), atol=1e-9)


def test_odometry_that_is_no_pose_is_left_out():
    good = Observation(stamp_ns=0, T_odom_base=np.eye(4))
    for T_odom_base in (np.zeros((4, 4)), np.eye(4)[:3], np.diag([1.0, 1.0, -1.0, 1.0])):
        ordered = Ordered(Listed([replace(good, T_odom_base=T_odom_base)]))
        assert [found.T_odom_base for found in ordered] == [None]
        assert ordered.faults[0].startswith("odometry is not a valid pose")


def test_rotation_that_was_rounded_on_its_way_is_one_again():
    """Its error would add up where motions are chained."""
    T_odom_base = se3.from_xy_yaw(1.0, 2.0, 0.7).round(4)
    seen = Observation(stamp_ns=0, T_odom_base=T_odom_base)
    T_cleaned = cleaned(seen, FaultLog()).T_odom_base
    np.testing.assert_allclose(T_cleaned[:3, :3].T @ T_cleaned[:3, :3], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(T_cleaned, T_odom_base, atol=1e-4)
