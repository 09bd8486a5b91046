"""Wheels and a gyro that are calibrated on the way: by trusted modules, and by rests."""

from types import SimpleNamespace

import numpy as np
import pytest
from driving import policy

from sceneslam.bus.events import EventLog
from sceneslam.bus.gyro_zero import GyroZero
from sceneslam.bus.reckoning import Reckoning
from sceneslam.bus.wheel_scale import WheelScale
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor

PERIOD_NS = 40_000_000
BIAS = np.array([0.01, -0.02, 0.005])
TIMES_S = np.array([-0.03, -0.02, -0.01, 0.0])


def seen(index, x_m, rates, *, has_odometry=True):
    gyro = np.column_stack([TIMES_S, np.tile(rates, (4, 1))])
    T_odom_base = se3.from_xy_yaw(x_m, 0.0, 0.0) if has_odometry else None
    return Observation(stamp_ns=index * PERIOD_NS, T_odom_base=T_odom_base, gyro_base=gyro)


def bias_after(observations):
    zero = GyroZero()
    for observation in observations:
        last = zero.correct(observation)
    return observations[-1].gyro_base[-1, 1:] - last.gyro_base[-1, 1:]


def test_gyro_at_rest_tells_its_bias():
    still = [seen(index, 1.0, BIAS) for index in range(25)]
    assert bias_after(still) == pytest.approx(BIAS)
    assert (bias_after(still[:15]) == 0).all()  # a stop shorter than this teaches nothing


def test_robot_that_drives_teaches_no_bias():
    assert (bias_after([seen(index, 0.01 * index, BIAS) for index in range(200)]) == 0).all()


def test_robot_that_sets_off_teaches_nothing_of_its_turn():
    """Wheels that are told late stand still while the gyro already turns."""
    rest = [seen(index, 1.0, BIAS) for index in range(50)]
    turning = [seen(50 + index, 1.0, BIAS + np.array([0.0, 0.0, 1.0])) for index in range(5)]
    assert bias_after(rest + turning) == pytest.approx(BIAS)


def test_robot_that_is_carried_teaches_no_bias():
    swings = [seen(i, 1.0, BIAS * (1 + 50 * np.sin(i))) for i in range(200)]
    spins = [seen(index, 1.0, [0.0, 0.0, 2.0]) for index in range(200)]
    assert (bias_after(swings) == 0).all() and (bias_after(spins) == 0).all()


def test_odometry_that_pauses_while_the_robot_drives_teaches_no_bias():
    driven = [seen(index, 0.0, BIAS, has_odometry=index == 0) for index in range(60)]
    assert (bias_after([*driven, seen(60, 2.0, BIAS)]) == 0).all()


def test_gyro_that_warms_up_is_followed():
    cold = [seen(index, 1.0, BIAS) for index in range(300)]
    warm = [seen(300 + index, 1.0, 2 * BIAS) for index in range(300)]
    assert bias_after(cold + warm) == pytest.approx(2 * BIAS)


def hold_at(x_m, *, is_trusted=True, deviation_m=0.003, is_revised=False):
    return SimpleNamespace(
        T_local_base=se3.from_xy_yaw(x_m, 0.0, 0.0),
        is_trusted=is_trusted,
        is_revised=is_revised,
        covariance=None if deviation_m is None else np.eye(6) * deviation_m**2,
    )


def drive(scale=1.03, *, metres=8, slip_at=None, **told):
    """Return a robot's wheels, as they were told and corrected, after a straight drive."""
    wheels, hold, slipped_m = WheelScale(), SimpleNamespace(), 0.0
    for index in range(metres * 20 + 1):
        slipped_m += 0.3 if index == slip_at else 0.0
        corrected = wheels.correct(seen(index, scale * 0.05 * index + slipped_m, BIAS))
        hold.__dict__.update(hold_at(0.05 * index, **told).__dict__)
        wheels.learn(hold)
    return wheels.scale, corrected


def test_wheels_that_tell_too_much_are_corrected():
    scale, _ = drive(1.03)
    assert scale == pytest.approx(1 / 1.03, abs=0.003)


def test_corrected_odometry_never_jumps():
    wheels, before, hold = WheelScale(), None, SimpleNamespace()
    for index in range(200):
        now = wheels.correct(seen(index, 1.04 * 0.05 * index, BIAS)).T_odom_base[0, 3]
        assert before is None or 0.045 < now - before < 0.055
        before = now
        hold.__dict__.update(hold_at(0.05 * index).__dict__)
        wheels.learn(hold)


def test_odometry_that_is_back_after_a_gap_has_moved_on_to_scale():
    wheels, hold = WheelScale(), SimpleNamespace()
    for index in range(161):
        before = wheels.correct(seen(index, 1.04 * 0.05 * index, BIAS))
        hold.__dict__.update(hold_at(0.05 * index).__dict__)
        wheels.learn(hold)
    assert wheels.correct(seen(161, 0.0, BIAS, has_odometry=False)).T_odom_base is None
    after = wheels.correct(seen(162, 1.04 * 9.0, BIAS))
    moved_m = after.T_odom_base[0, 3] - before.T_odom_base[0, 3]
    assert moved_m == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize(
    "told", [{"is_trusted": False}, {"deviation_m": None}, {"deviation_m": 0.5}, {"metres": 0}]
)
def test_what_does_not_measure_the_way_teaches_nothing(told):
    scale, _ = drive(1.03, **told)
    assert scale == pytest.approx(1.0, abs=1e-3)


def test_wheel_that_spins_teaches_no_scale():
    scale, _ = drive(1.0, slip_at=65)
    assert scale == pytest.approx(1.0, abs=0.003)


def test_other_activation_begins_anew():
    """Two modules' local frames have nothing in common."""
    wheels = WheelScale()
    for index in range(40):
        wheels.correct(seen(index, 0.05 * index, BIAS))
        wheels.learn(hold_at(0.05 * index if index % 2 else 7.0))  # a new hold each time
    assert wheels.scale == 1.0


def test_what_was_learnt_is_in_the_log():
    reckoning = Reckoning(policy(), Rig(sensors=frozenset({Sensor.ODOMETRY, Sensor.GYRO})))
    log = EventLog()
    reckoning.tell(0, log)
    assert not log.events
    for index in range(60):
        reckoning.correct(seen(index, 1.0, BIAS))
    reckoning.tell(1, log)
    assert log.events[0]["gyro_bias_radps"] == pytest.approx(BIAS)
    assert "wheel_scale" not in log.events[0]
