"""Wheels that turn by the gyro: slips, biases, and gyros that are silent."""

import numpy as np
import pytest

from sceneslam.bus.gyrodometry import Gyrodometry
from sceneslam.types import se3
from sceneslam.types.observation import Observation

PERIOD_NS = 40_000_000


def drive(seconds, *, speed=0.4, rate=0.3, bias=0.0, slip_rad=lambda index: 0.0, gyro_hz=100):
    """Return a robot's observations on an arc, whose wheels and gyro err, and its true heading."""
    found, T_odom_base = [], se3.identity()
    count = int(seconds * 1e9 / PERIOD_NS)
    times_s = -np.arange(0.0, PERIOD_NS / 1e9 - 1e-9, 1.0 / gyro_hz)[::-1] if gyro_hz else None
    for index in range(count):
        step_s = PERIOD_NS / 1e9
        if index:
            turn_rad = rate * step_s + slip_rad(index)
            T_odom_base = T_odom_base @ se3.from_xy_yaw(speed * step_s, 0.0, turn_rad)
        gyro = None
        if times_s is not None:
            gyro = np.column_stack([times_s, np.zeros((len(times_s), 2))])
            gyro = np.column_stack([gyro, np.full(len(times_s), rate + bias)])
        stamp_ns = index * PERIOD_NS
        found.append(Observation(stamp_ns=stamp_ns, T_odom_base=T_odom_base, gyro_base=gyro))
    return found, rate * (count - 1) * PERIOD_NS / 1e9


def headings_off(observations, true_rad):
    """Return how far off [rad] the last heading is, by the wheels and as corrected."""
    corrector = Gyrodometry()
    last = [corrector.correct(observation) for observation in observations][-1]
    wheels, corrected = observations[-1].T_odom_base, last.T_odom_base
    T_true = se3.from_xy_yaw(0.0, 0.0, true_rad)
    return [abs(se3.yaw_rad(se3.inverse(T_true) @ T)) for T in (wheels, corrected)]


def test_a_slipping_wheel_does_not_turn_the_robot():
    observations, true_rad = drive(10, slip_rad=lambda index: 0.005 * (100 <= index < 110))
    by_wheels, corrected = headings_off(observations, true_rad)
    assert by_wheels == pytest.approx(0.05, rel=0.01)
    assert corrected < 0.05 * by_wheels


def test_the_bias_of_a_gyro_is_learnt_at_rest():
    still, _ = drive(20, speed=0.0, rate=0.0, bias=0.03)
    corrector = Gyrodometry()
    headings = [se3.yaw_rad(corrector.correct(each).T_odom_base) for each in still]
    drifts = np.diff(headings[:: len(headings) // 4])
    assert 0 < drifts[-1] < 0.2 * drifts[0]
    assert headings[-1] < 0.06  # 0.6 by the gyro alone


def test_wheels_that_pull_to_one_side_do_no_more_harm_than_alone():
    pull, true_rad = drive(30, slip_rad=lambda index: 0.0005)
    by_wheels, corrected = headings_off(pull, true_rad)
    assert corrected < by_wheels


def test_without_a_gyro_odometry_stays_as_it_came():
    observations, true_rad = drive(2, gyro_hz=0, slip_rad=lambda index: 0.001)
    by_wheels, corrected = headings_off(observations, true_rad)
    assert corrected == pytest.approx(by_wheels, abs=1e-12)


def test_a_gyro_that_was_silent_over_a_gap_does_not_speak_for_it():
    observations, _ = drive(2)
    gap = observations[:20] + observations[40:]
    assert gap[20].turn_by_gyro(21 * PERIOD_NS / 1e9) is None
    assert gap[20].turn_by_gyro(PERIOD_NS / 1e9)[2] == pytest.approx(0.3 * PERIOD_NS / 1e9)
    by_wheels, corrected = headings_off(gap, 0.3 * 49 * PERIOD_NS / 1e9)
    assert corrected == pytest.approx(by_wheels, abs=1e-3)


def test_an_observation_without_odometry_has_none_afterwards():
    observations, _ = drive(1)
    corrector = Gyrodometry()
    blind = Observation(stamp_ns=1, gyro_base=observations[0].gyro_base)
    assert corrector.correct(blind) is blind
