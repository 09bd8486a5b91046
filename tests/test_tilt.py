"""Roll and pitch of the dead reckoning: by the gyro, held by gravity or by the odometry."""

import numpy as np
import pytest

from sceneslam.bus.judging.dead_reckoning import DeadReckoning
from sceneslam.motion.model import MotionModel
from sceneslam.motion.tilt import Tilt, up_by, upright
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import GRAVITY, Rig, Sensor

RIG = Rig(sensors=frozenset({Sensor.ODOMETRY, Sensor.GYRO, Sensor.ACCELEROMETER}))
STEP_S, SPEED = 0.05, 0.5
SLOPE_RAD = np.radians(8.0)
BIAS = np.array([0.004, -0.006, 0.002])


def climb(*, has_gravity, rest_s=2.0):
    """Yield what a robot measures that rests, drives 2 m on the level, and 4 m up a ramp."""
    pitch = x_m = 0.0
    for index in range(int((rest_s + 12.0) / STEP_S)):
        time_s = index * STEP_S
        is_moving = time_s >= rest_s
        target = -SLOPE_RAD if time_s >= rest_s + 4.0 else 0.0
        rate = np.clip((target - pitch) / STEP_S, -0.5, 0.5)
        pitch += rate * STEP_S
        x_m += SPEED * STEP_S * is_moving
        times_s = np.linspace(-STEP_S + 0.01, 0.0, 5)
        gyro = np.column_stack([times_s, np.tile(BIAS + np.array([0.0, rate, 0.0]), (5, 1))])
        force = GRAVITY * np.array([-np.sin(pitch), 0.0, np.cos(pitch)])
        accelerometer = np.column_stack([times_s, np.tile(force, (5, 1))]) if has_gravity else None
        yield Observation(
            stamp_ns=round(time_s * 1e9),
            T_odom_base=se3.from_xy_yaw(x_m, 0.0, 0.0),
            gyro_base=gyro,
            accelerometer_base=accelerometer,
        )


def reckoned(**measured):
    reckoning = DeadReckoning(RIG, None)
    return [reckoning.correct(one, "").T_odom_base for one in climb(**measured)]


@pytest.mark.parametrize(("has_gravity", "least"), [(True, 0.95), (False, 0.6)])
def test_a_robot_that_rested_climbs_the_ramp_in_its_odometry_too(has_gravity, least):
    found = reckoned(has_gravity=has_gravity)
    true_m = 4.0 * np.sin(SLOPE_RAD)
    assert least * true_m < found[-1][2, 3] < 1.05 * true_m
    assert abs(found[int(6.0 / STEP_S) - 1][2, 3]) < 0.03  # level before the ramp


def test_a_gyro_that_never_rested_tilts_nothing():
    found = reckoned(has_gravity=False, rest_s=0.0)
    assert abs(found[-1][2, 3]) < 1e-9


def test_a_tilt_is_taken_out_and_the_heading_kept():
    T_world_base = se3.exp(np.array([1.0, 2.0, 3.0, 0.05, -0.1, 0.7]))
    found = upright(T_world_base, np.array([0.0, 0.0, 1.0]))
    assert found[2, 2] == pytest.approx(1.0, abs=1e-9)
    assert se3.yaw_rad(found) == pytest.approx(se3.yaw_rad(T_world_base), abs=0.01)
    np.testing.assert_array_equal(found[:3, 3], T_world_base[:3, 3])


@pytest.mark.parametrize("walked_radps", [0.0, 0.003])
def test_a_bias_that_walks_after_the_rest_is_found_on_level_floor(walked_radps):
    model = MotionModel(RIG)
    tilt = Tilt(model)
    for index in range(1600):
        walked = np.array([0.0, walked_radps * (index > 100), 0.0])
        times_s = np.linspace(-STEP_S + 0.01, 0.0, 5)
        moved_m = max(0.0, (index - 60) * STEP_S * SPEED)
        observation = Observation(
            stamp_ns=round(index * STEP_S * 1e9),
            T_odom_base=se3.from_xy_yaw(moved_m, 0.0, 0.0),
            gyro_base=np.column_stack([times_s, np.tile(BIAS + walked, (5, 1))]),
        )
        up = tilt.update(observation, model.predict(observation).T_prev_curr[:3, :3])
    assert np.arccos(up[2]) < 0.01  # if it were not found: 0.003 * 10 s


def test_an_accelerometer_that_is_mounted_on_its_side_says_nothing():
    assert up_by(np.array([[0.0, GRAVITY, 0.0, 0.0]])) is None
    assert up_by(np.array([[0.0, np.nan, 0.0, GRAVITY]])) is None


def test_while_the_base_accelerates_gravity_is_unknown():
    samples = np.array([[0.0, 3.0, 0.0, GRAVITY + 2.0]])
    assert up_by(samples) is None and up_by(None) is None
    np.testing.assert_allclose(up_by(np.array([[0.0, 0.0, 0.0, GRAVITY]])), [0.0, 0.0, 1.0])
