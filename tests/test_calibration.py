"""Wheels and a gyro that are calibrated on the way: by trusted modules, and by rests."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from driving import GATE, events
from driving import drive as drive_bus
from fakes import ExactModule, observation

from sceneslam.bus.judging.dead_reckoning import DeadReckoning
from sceneslam.bus.judging.wheel_scale import WheelScale
from sceneslam.storage.events import EventLog
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig, Sensor

PERIOD_NS = 40_000_000
BIAS = np.array([0.01, -0.02, 0.005])
BRIGHT = {"Bright": ("bright",), "Dark": ("bright",)}
RIG = Rig(sensors=frozenset({Sensor.ODOMETRY, Sensor.GYRO}))
TIMES_S = np.array([-0.03, -0.02, -0.01, 0.0])


def seen(index, x_m, rates, *, has_odometry=True):
    gyro = np.column_stack([TIMES_S, np.tile(rates, (4, 1))])
    T_odom_base = se3.from_xy_yaw(x_m, 0.0, 0.0) if has_odometry else None
    return Observation(stamp_ns=index * PERIOD_NS, T_odom_base=T_odom_base, gyro_base=gyro)


@pytest.mark.parametrize("bias", [0.005, 0.02, 0.04])
def test_bias_that_is_learnt_late_is_taken_off_once(bias):
    reckoning = DeadReckoning(RIG, None)
    x_m, headings = 0.0, []
    for index in range(3000):
        rests = 1500 <= index < 1530
        x_m += 0.0 if rests else 0.01
        corrected = reckoning.correct(seen(index, x_m, [0.0, 0.0, bias]), "")
        headings.append(se3.yaw_rad(corrected.T_odom_base))
    assert abs(headings[-1] - headings[1500]) < 0.35 * bias


@pytest.mark.parametrize(
    ("wheels_rad", "missed_rad"), [(0.001, 0.0), (0.003, 0.398), (-0.001, -0.398)]
)
def test_wheels_miss_what_they_turn_otherwise_than_the_gyro(wheels_rad, missed_rad):
    reckoning, T_step = DeadReckoning(RIG, None), se3.from_xy_yaw(0.02, 0.0, wheels_rad)
    assert reckoning.witness.missed_rad == 0.0

    def see(index, **changes):
        one = seen(index, 0.0, [0.0, 0.0, 0.001 / (PERIOD_NS / 1e9)])
        T_odom_base = np.linalg.matrix_power(T_step, index)
        reckoning.correct(replace(one, **{"T_odom_base": T_odom_base} | changes), "")

    for index in range(201):
        see(index)
    assert reckoning.witness.missed_rad == pytest.approx(missed_rad, abs=0.15)  # or a bias
    assert not reckoning.witness.is_vouched
    see(201, gyro_base=None)  # the wheels cannot confirm themselves
    see(202)
    without_gyro = reckoning.witness.missed_rad
    see(203, T_odom_base=None)
    see(204)
    assert abs(without_gyro) > 100.0 and abs(reckoning.witness.missed_rad - without_gyro) > 100.0
    without = DeadReckoning(replace(RIG, sensors=RIG.sensors - {Sensor.GYRO}), None)
    assert without.witness.missed_rad is None


def tracked(T_local_base, *, deviation_m=0.003, inliers=100, revision=0):
    return Tracking(
        stamp_ns=0,
        T_local_base=T_local_base,
        status=TrackingStatus.TRACKING,
        covariance=None if deviation_m is None else np.eye(6) * deviation_m**2,
        inliers=inliers,
        revision=revision,
    )


def hold_at(x_m, *, is_trusted=True, held_since_ns=0, **known):
    tracking = tracked(se3.from_xy_yaw(x_m, 0.0, 0.0), **known)
    return SimpleNamespace(tracking=tracking, is_trusted=is_trusted, held_since_ns=held_since_ns)


def scale():
    return WheelScale(deviation=0.02, limit=0.03)


def drive(wheels=1.02, *, metres=8, slip_at=None, learner=None, module=1.0, **told):
    """Return what a straight drive teaches of wheels that tell `wheels` times the way."""
    learner, hold, slipped_m = (
        learner or scale(),
        SimpleNamespace(),
        0.0,
    )
    for index in range(metres * 20 + 1):
        slipped_m += 0.3 if index == slip_at else 0.0
        T_odom_base = se3.from_xy_yaw(wheels * 0.05 * index + slipped_m, 0.0, 0.0)
        hold.__dict__.update(hold_at(module * 0.05 * index, **told).__dict__)
        learner.learn(hold, T_odom_base, 0.0)
    return learner.scale


def test_wheels_that_tell_too_much_are_corrected():
    assert drive(1.02) == pytest.approx(1 / 1.02, abs=0.003)


def test_module_that_is_wrong_takes_the_wheels_three_per_cent_along_and_no_longer_than_itself():
    learner = scale()
    assert drive(1.0, metres=40, learner=learner, module=0.94) == pytest.approx(0.97)
    assert drive(1.0, metres=40, learner=learner) == pytest.approx(1.0, abs=0.004)


def test_wheels_that_change_are_followed():
    learner = scale()
    drive(1.0, metres=100, learner=learner)
    assert drive(1.025, metres=100, learner=learner) == pytest.approx(1 / 1.025, abs=0.005)


def taught(odometry, *, by="bright", to="dark", steps=160):
    """Return a reckoning that a module has taught, and what the odometry of the other module is."""
    reckoning, hold, corrected = DeadReckoning(RIG, GATE), hold_at(0.0), []
    for index in range(steps):
        reckoning.correct(seen(index, odometry(index), BIAS), by)
        hold.__dict__.update(hold_at(0.05 * index).__dict__)
        reckoning.learn(hold, by)
    for index in range(steps, 2 * steps):
        found = reckoning.correct(seen(index, odometry(index), BIAS), to)
        corrected.append(found.T_odom_base[:2, 3])
    return reckoning, np.linalg.norm(np.diff(corrected, axis=0), axis=1)


def test_what_one_module_taught_corrects_the_odometry_of_another_without_a_jump():
    _, steps_m = taught(lambda index: 1.02 * 0.05 * index)
    assert steps_m == pytest.approx(0.05, abs=3e-4)


def test_module_is_not_judged_by_odometry_that_it_taught():
    _, steps_m = taught(lambda index: 1.02 * 0.05 * index, to="bright")
    assert steps_m == pytest.approx(1.02 * 0.05, rel=1e-4)


def test_odometry_that_is_back_after_a_gap_has_moved_on_to_scale():
    reckoning, _ = taught(lambda index: 1.02 * 0.05 * index)
    before = reckoning.correct(seen(320, 1.02 * 16.0, BIAS), "dark")
    assert reckoning.correct(seen(321, 0, BIAS, has_odometry=False), "dark").T_odom_base is None
    after = reckoning.correct(seen(322, 1.02 * 17.0, BIAS), "dark")
    moved_m = after.T_odom_base[0, 3] - before.T_odom_base[0, 3]
    assert moved_m == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(
    "told",
    [
        {"is_trusted": False},
        {"inliers": 0},
        {"deviation_m": None},
        {"deviation_m": 0.5},
        {"metres": 0},
    ],
)
def test_what_does_not_measure_the_way_teaches_nothing(told):
    assert drive(1.02, **told) == pytest.approx(1.0, abs=1e-3)


def test_wheel_that_spins_teaches_no_scale():
    assert drive(1.0, slip_at=65) == pytest.approx(1.0, abs=0.003)


def test_other_activation_begins_anew():
    """Two modules' local frames have nothing in common, though the second begins nearby."""
    wheels = scale()
    holds = [hold_at(0.0), hold_at(0.0)]
    for index in range(41):
        hold = holds[index >= 5]
        x_m = 0.05 * index - (0.03 if index >= 5 else 0.0)
        hold.tracking = tracked(se3.from_xy_yaw(x_m, 0.0, 0.0))
        wheels.learn(hold, se3.from_xy_yaw(0.05 * index, 0.0, 0.0), 0.0)
    assert wheels.scale == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("told", ["revision", "held_since_ns"])
def test_poses_before_and_after_a_correction_or_a_break_are_not_compared(told):
    wheels, hold = scale(), SimpleNamespace()
    for index in range(41):
        x_m, later = 0.05 * index, int(index >= 5)
        hold.__dict__.update(hold_at(x_m - 0.03 * later, **{told: later}).__dict__)
        wheels.learn(hold, se3.from_xy_yaw(x_m, 0.0, 0.0), 0.0)
    assert wheels.scale == pytest.approx(1.0, abs=1e-12)


def test_module_that_corrects_its_past_all_the_time_teaches_nothing():
    wheels, hold = scale(), SimpleNamespace()
    for index in range(161):
        hold.__dict__.update(hold_at(0.05 * index, revision=index).__dict__)
        wheels.learn(hold, se3.from_xy_yaw(1.02 * 0.05 * index, 0.0, 0.0), 0.0)
    assert wheels.scale == 1.0


def test_a_span_goes_on_over_poses_that_are_not_trusted():
    wheels, hold = scale(), SimpleNamespace()
    for index in range(161):
        told = hold_at(0.05 * index, is_trusted=index % 3 == 0)
        hold.__dict__.update(told.__dict__)
        wheels.learn(hold, se3.from_xy_yaw(1.02 * 0.05 * index, 0.0, 0.0), 0.0)
    assert wheels.scale == pytest.approx(1 / 1.02, abs=0.003)


def test_arcs_teach_nothing():
    """Wheels that turn too much cut every chord."""
    wheels, hold = scale(), hold_at(0.0)
    T_odom, T_true = se3.identity(), se3.identity()
    for _ in range(400):
        hold.tracking = tracked(T_true)
        wheels.learn(hold, T_odom, 0.06)
        T_odom = T_odom @ se3.from_xy_yaw(0.02, 0.0, 0.06)
        T_true = T_true @ se3.from_xy_yaw(0.02, 0.0, 0.03)
    assert wheels.scale == 1.0


def test_what_was_learnt_is_in_the_log_once():
    reckoning, log, hold = DeadReckoning(RIG, GATE), EventLog(), hold_at(0.0)
    for index in range(300):
        x_m = 0.05 * max(index - 60, 0)
        reckoning.correct(seen(index, 1.02 * x_m, BIAS), "one")
        hold.tracking = tracked(se3.from_xy_yaw(x_m, 0.0, 0.0))
        reckoning.learn(hold, "one")
    reckoning.close(1, log)
    reckoning.close(2, log)
    (event,) = log.events
    assert event["gyro_bias_radps"] == pytest.approx(BIAS, abs=0.002)
    assert event["wheel_scale"] == pytest.approx(1 / 1.02, abs=0.003)


def test_unwatched_module_teaches_no_scale():
    reckoning, hold = DeadReckoning(RIG, None), hold_at(0.0)
    for index in range(100):
        last = reckoning.correct(seen(index, 1.02 * 0.05 * index, np.zeros(3)), "")
        hold.tracking = tracked(se3.from_xy_yaw(0.05 * index, 0.0, 0.0))
        reckoning.learn(hold, "one")
    assert last.T_odom_base[0, 3] == pytest.approx(1.02 * 0.05 * 99)


class Straight(ExactModule):
    """Sees the robot drive straight on at 0.5 m/s, and the odometry that it is given."""

    def track(self, observation):
        told = super().track(observation)
        self.odometry = observation.T_odom_base
        T_local_base = se3.from_xy_yaw(0.5e-9 * observation.stamp_ns, 0.0, 0.0)
        known = {"covariance": np.eye(6) * 1e-6, "inliers": 100}
        return replace(told, T_local_base=T_local_base, **known)


def test_bus_lets_the_active_module_teach_and_gives_it_the_odometry_as_it_came():
    def feed(index):
        T_odom_base = se3.from_xy_yaw(1.02 * 0.05 * index, 0.0, 0.0)
        return replace(observation(index), T_odom_base=T_odom_base)

    module = Straight()
    _, _, log, _ = drive_bus({"bright": module}, steps=600, feed=feed, gate=GATE, table=BRIGHT)
    (event,) = events(log, "calibration")
    assert event["wheel_scale"] == pytest.approx(1 / 1.02, abs=0.005)
    assert module.odometry[0, 3] == pytest.approx(1.02 * 0.05 * 599)
