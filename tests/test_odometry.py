"""Dead reckoning of motions that are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from sceneslam.interfaces import SlamModule
from sceneslam.modules.slam.odometry import Odometry
from sceneslam.types import se3
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Rig, Sensor

SETTINGS = yaml.safe_load(
    (Path(__file__).resolve().parent.parent / "conf/slam/odometry.yaml").read_text()
)
SETTINGS.pop("_target_")


def active(**settings):
    module = Odometry(**{**SETTINGS, **settings})
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    return module


def arc(count, *, yaw_step_rad=0.02, period_ns=100_000_000, gyro=False):
    """Return observations along an arc that starts far from the origin of `odom`."""
    T_step = se3.from_xy_yaw(0.05, 0.0, yaw_step_rad)
    T_odom_base = se3.from_xy_yaw(5.0, -3.0, 2.0)
    observations = []
    for index in range(count):
        times = -np.arange(9, -1, -1) * 0.01
        rates = np.column_stack([times, 0 * times, 0 * times, 0 * times + yaw_step_rad / 0.1])
        observations.append(
            Observation(
                stamp_ns=index * period_ns,
                T_odom_base=T_odom_base,
                gyro_base=rates if gyro else None,
            )
        )
        T_odom_base = T_odom_base @ T_step
    return observations


def test_module_fulfils_the_interface():
    assert isinstance(active(), SlamModule)


def test_pose_is_odometry_since_the_first_observation():
    module = active()
    observations = arc(30)
    T_odom_local = observations[0].T_odom_base
    for observation in observations:
        tracking = module.track(observation)
        expected = se3.inverse(T_odom_local) @ observation.T_odom_base
        np.testing.assert_allclose(tracking.T_local_base, expected, atol=1e-12)
        assert tracking.status is TrackingStatus.TRACKING


def test_gyro_gives_the_turn_where_wheels_slip():
    slipping = arc(50, yaw_step_rad=0.03)
    turning = arc(50, yaw_step_rad=0.02, gyro=True)
    module, blind = active(), active(use_gyro=False)
    for wheels, gyro in zip(slipping, turning, strict=True):
        observation = Observation(
            stamp_ns=wheels.stamp_ns, T_odom_base=wheels.T_odom_base, gyro_base=gyro.gyro_base
        )
        with_gyro, without = module.track(observation), blind.track(observation)
    assert se3.yaw_rad(with_gyro.T_local_base) == pytest.approx(0.98, abs=0.15)  # a bias?
    assert se3.yaw_rad(without.T_local_base) == pytest.approx(1.47, abs=1e-6)


def test_doubt_grows_with_the_way():
    module = active()
    traces = [np.trace(module.track(observation).covariance) for observation in arc(100)]
    assert np.all(np.diff(traces) > 0)
    covariance = module.track(arc(101)[-1]).covariance
    assert 0.05 < np.sqrt(covariance[0, 0]) < 1.0
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_standing_still_adds_no_doubt():
    module = active()
    observations = [Observation(stamp_ns=i * 10**8, T_odom_base=np.eye(4)) for i in range(50)]
    covariances = [module.track(observation).covariance for observation in observations]
    np.testing.assert_allclose(covariances[0], covariances[-1], atol=1e-12)


@pytest.mark.parametrize("broken", [None, np.full((4, 4), np.nan)])
def test_missing_odometry_is_lost_and_its_way_is_made_up_for(broken):
    module = active()
    observations = arc(20)
    held = [module.track(observation) for observation in observations[:10]][-1]
    for observation in observations[10:15]:
        lost = module.track(Observation(stamp_ns=observation.stamp_ns, T_odom_base=broken))
        assert lost.status is TrackingStatus.LOST
        np.testing.assert_array_equal(lost.T_local_base, held.T_local_base)
    back = module.track(observations[15])
    expected = se3.inverse(observations[0].T_odom_base) @ observations[15].T_odom_base
    assert back.status is TrackingStatus.TRACKING
    np.testing.assert_allclose(back.T_local_base, expected, atol=1e-12)


def test_activation_starts_anew_and_shutdown_may_come_twice():
    module = active()
    first = [module.track(observation).T_local_base for observation in arc(20, gyro=True)]
    module.shutdown()
    module.shutdown()
    assert module.get_map().points is None
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    again = [module.track(observation).T_local_base for observation in arc(20, gyro=True)]
    np.testing.assert_array_equal(first[0], np.eye(4))
    np.testing.assert_array_equal(first, again)


def test_gyro_that_is_biased_about_the_level_axes_lifts_no_robot_off_the_floor():
    module = active()
    for observation in arc(200, yaw_step_rad=0.0, gyro=True):
        tilted = observation.gyro_base + np.array([0.0, 0.02, 0.02, 0.0])
        tracking = module.track(replace(observation, gyro_base=tilted))
    assert abs(tracking.T_local_base[2, 3]) < 1e-9
