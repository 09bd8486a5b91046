"""Where the base is expected to be, after measured poses, guesses, losses and corrections."""

import numpy as np
import pytest

from sceneslam.motion.predictor import Predictor
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor

HELD = Rig(sensors=frozenset({Sensor.IMAGE}))
WHEELED = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.ODOMETRY, Sensor.GYRO}))
SEEN = np.diag([0.002] * 3 + [0.001] * 3) ** 2


def at(second, **fields):
    return Observation(stamp_ns=round(second * 1e9), **fields)


def measure(predictor, observation, T_local_base):
    predictor.predict(observation)
    predictor.measure(observation, T_local_base, SEEN, np.linalg.inv(SEEN))


def walking(until_s=0.2):
    """Return a predictor of a camera that is carried forward by 1 m/s."""
    predictor = Predictor(HELD)
    for index in range(round(10 * until_s) + 1):
        measure(predictor, at(0.1 * index), se3.from_xy_yaw(0.1 * index, 0, 0))
    return predictor


def test_base_goes_on_at_constant_velocity_and_no_longer_than_that_is_known():
    assert walking().predict(at(0.3)).T_local_base[0, 3] == pytest.approx(0.3, abs=0.01)
    assert walking().predict(at(5.0)).T_local_base[0, 3] == pytest.approx(0.7, abs=0.01)
    assert walking(4.0).predict(at(5.0)).T_local_base[0, 3] == pytest.approx(4.9, abs=0.05)


def test_base_that_is_lost_without_wheels_is_expected_where_it_was():
    predictor = walking()
    predictor.lose(predictor.predict(at(0.3)))
    prediction = predictor.predict(at(1.3))
    assert prediction.T_local_base[0, 3] == pytest.approx(0.2, abs=0.01)
    assert not prediction.is_measured
    assert np.sqrt(prediction.covariance[0, 0]) > 0.3  # at 1 m/s it may be a metre away


def test_return_of_a_lost_camera_is_no_velocity():
    predictor = walking()
    predictor.lose(predictor.predict(at(0.3)))
    measure(predictor, at(0.4), se3.from_xy_yaw(5.0, 0, 0))
    assert predictor.predict(at(0.5)).T_local_base[0, 3] == pytest.approx(5.0)
    predictor.measure(at(0.5), se3.from_xy_yaw(5.1, 0, 0), SEEN, np.linalg.inv(SEEN))
    assert predictor.predict(at(0.6)).T_local_base[0, 3] == pytest.approx(5.2, abs=0.01)


def test_distance_is_the_wheels_and_the_turn_the_gyro_s():
    predictor = Predictor(WHEELED)
    measure(predictor, at(0.0, T_odom_base=se3.from_xy_yaw(7, 0, 0)), se3.identity())
    turning = np.array([[-0.1, 0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 0.5]])
    slipped = se3.from_xy_yaw(7.04, 0.0, 0.2)
    prediction = predictor.predict(at(0.1, T_odom_base=slipped, gyro_base=turning))
    expected = se3.from_xy_yaw(0.04, 0.0, 0.05)
    np.testing.assert_allclose(prediction.T_local_base, expected, atol=1e-12)
    assert prediction.is_measured


def test_wheels_that_agree_with_a_camera_are_believed_when_it_is_lost():
    predictor = Predictor(WHEELED)
    for index in range(60):  # inertia predicts this drive better than any wheel
        T_local_base = se3.from_xy_yaw(0.02 * index, 0, 0)
        measure(predictor, at(index / 30, T_odom_base=T_local_base), T_local_base)
    for index in range(60, 90):
        T_odom_base = se3.from_xy_yaw(0.02 * index, 0, 0)
        prediction = predictor.predict(at(index / 30, T_odom_base=T_odom_base))
        predictor.lose(prediction)
    assert prediction.is_measured
    assert prediction.T_local_base[0, 3] == pytest.approx(0.02 * 89)


def test_predicted_pose_stays_a_rotation_over_many_corrections():
    predictor, rng = Predictor(HELD), np.random.default_rng(0)
    for index in range(60):  # a keyframe at the prediction is adjusted, the prediction follows it
        T_keyframe = predictor.predict(at(0.1 * index)).T_local_base
        T_adjusted = T_keyframe @ se3.exp(0.01 * rng.standard_normal(6))
        predictor.correct(T_adjusted @ se3.inverse(T_keyframe))
    rotation = predictor.predict(at(6.0)).T_local_base[:3, :3]
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_no_variance_is_negative_where_a_sensor_measures_next_to_nothing(seed):
    """As of a bare wall; rounding leaves an information a little below 0 there."""
    rng = np.random.default_rng(seed)
    own, T_local_base = Predictor(WHEELED), se3.identity()
    for index in range(100):
        T_local_base = T_local_base @ se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.01]))
        observation = at(index / 30, T_odom_base=T_local_base)
        expected = own.predict(observation).covariance
        assert np.linalg.eigvalsh(expected)[0] > 0.0
        axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
        measured = 10.0 ** rng.uniform(5, 9, 6)
        measured[: rng.integers(0, 3)] = -3e-6
        information = (axes * measured) @ axes.T
        known = np.linalg.inv(np.linalg.inv(expected) + information)
        own.measure(observation, T_local_base, known, information)
