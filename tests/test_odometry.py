"""Dead reckoning of motions that are known."""

import numpy as np

from sceneslam.atlas.atlas import Atlas
from sceneslam.interfaces import SlamModule
from sceneslam.modules.slam.odometry import Odometry
from sceneslam.types import se3
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Rig, Sensor, Wheels


def active():
    module = Odometry()
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    return module


def arc(count, *, yaw_step_rad=0.02, period_ns=100_000_000):
    """Return observations along an arc that starts far from the origin of `odom`."""
    T_step = se3.from_xy_yaw(0.05, 0.0, yaw_step_rad)
    T_odom_base = se3.from_xy_yaw(5.0, -3.0, 2.0)
    observations = []
    for index in range(count):
        observations.append(Observation(stamp_ns=index * period_ns, T_odom_base=T_odom_base))
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


def test_doubt_grows_with_the_way():
    module = active()
    trackings = [module.track(observation) for observation in arc(100)]
    assert np.all(np.diff([np.trace(each.map_covariance) for each in trackings]) > 0)
    drift = trackings[-1].map_covariance
    assert 0.05 < np.sqrt(drift[0, 0]) < 1.0
    assert np.linalg.eigvalsh(drift).min() > 0


def test_the_whole_way_counts_once_in_the_atlas():
    module, atlas = active(), Atlas(voxel_m=0.05)
    atlas.begin_session("odometry", np.eye(4))
    trackings = [module.track(observation) for observation in arc(400, yaw_step_rad=0.0)]
    for each in trackings:
        atlas.add(
            each.stamp_ns, each.T_local_base, "odometry", each.covariance, each.map_covariance
        )
    covariances = atlas.covariances(Wheels())[-1], trackings[-1].map_covariance
    found, drifted = (np.sqrt(np.diag(each))[[0, 1, 5]] for each in covariances)
    np.testing.assert_allclose(found, drifted, rtol=0.2)


def test_standing_still_adds_no_doubt():
    module = active()
    observations = [Observation(stamp_ns=i * 10**8, T_odom_base=np.eye(4)) for i in range(50)]
    covariances = [module.track(observation).map_covariance for observation in observations]
    np.testing.assert_allclose(covariances[0], covariances[-1], atol=1e-12)


def test_missing_odometry_is_lost_and_its_way_is_made_up_for():
    module = active()
    observations = arc(20)
    held = [module.track(observation) for observation in observations[:10]][-1]
    for observation in observations[10:15]:
        lost = module.track(Observation(stamp_ns=observation.stamp_ns, T_odom_base=None))
        assert lost.status is TrackingStatus.LOST
        np.testing.assert_array_equal(lost.T_local_base, held.T_local_base)
    back = module.track(observations[15])
    expected = se3.inverse(observations[0].T_odom_base) @ observations[15].T_odom_base
    assert back.status is TrackingStatus.TRACKING
    np.testing.assert_allclose(back.T_local_base, expected, atol=1e-12)


def test_activation_starts_anew_and_shutdown_may_come_twice():
    module = active()
    first = [module.track(observation).T_local_base for observation in arc(20)]
    module.shutdown()
    module.shutdown()
    assert module.get_map().points is None
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    again = [module.track(observation).T_local_base for observation in arc(20)]
    np.testing.assert_array_equal(first[0], np.eye(4))
    np.testing.assert_array_equal(first, again)
