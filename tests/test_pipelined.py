"""A system that answers late: not yet, several poses at once, and never for what it skips."""

from __future__ import annotations

import weakref
from dataclasses import replace

import numpy as np
import pytest
from fakes import PERIOD_NS, RIG, observation, true_pose

from sceneslam.answers import checked_trajectory
from sceneslam.atlas.atlas import Atlas
from sceneslam.modules.slam.pipelined import Pipelined
from sceneslam.motion.late import Pipeline
from sceneslam.motion.model import MotionModel
from sceneslam.testing import check_module
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.rig import Sensor, Wheels
from sceneslam.types.run import BRIDGED
from sceneslam.types.trajectory import Trajectory


class Exact:
    """Knows the motion exactly, and says it when `ready` of a number of observations is true."""

    requires = (frozenset({Sensor.ODOMETRY}),)

    def __init__(self, ready=lambda index: True, skips=()):
        self._ready, self._skips = ready, skips

    def activate(self, rig):
        self._waiting, self._T_odom_first, self._count = [], None, 0

    def set_scene(self, scene):
        pass

    def feed(self, observation):
        if observation.T_odom_base is None:
            return []
        if self._T_odom_first is None:
            self._T_odom_first = observation.T_odom_base
        T_local_base = se3.inverse(self._T_odom_first) @ observation.T_odom_base
        if self._count not in self._skips:
            self._waiting.append(
                Tracking(
                    stamp_ns=observation.stamp_ns,
                    T_local_base=T_local_base,
                    status=TrackingStatus.TRACKING,
                )
            )
        self._count += 1
        poses, self._waiting = (
            (self._waiting, []) if self._ready(self._count) else ([], self._waiting)
        )
        return poses

    def get_trajectory(self):
        return Trajectory.empty()

    def get_map(self):
        return MapLayers()

    def shutdown(self):
        pass


def driven(system, steps=30, late_max_s=0.5, *, has_odometry=True):
    module = Pipelined(system, late_max_s)
    module.activate(RIG)
    return module, [module.track(observation(index)) for index in range(steps)]


def assert_true(tracking, atol=1e-9):
    np.testing.assert_allclose(tracking.T_local_base, true_pose(tracking.stamp_ns), atol=atol)


def test_poses_in_time_are_passed_on():
    _, found = driven(Exact())
    assert {one.status for one in found} == {TrackingStatus.TRACKING}
    for one in found:
        assert_true(one)


@pytest.mark.parametrize("closes", [None, False, True])
def test_a_late_system_closes_loops_if_it_says_so(closes):
    system = Exact()
    if closes is not None:
        system.closes_loops = closes
    assert Pipelined(system, 0.5).closes_loops is bool(closes)


def test_not_yet_is_bridged_and_several_at_once_are_kept():
    module, found = driven(Exact(ready=lambda count: count % 4 == 0))
    assert found[2].status is TrackingStatus.DEGRADED and found[3].status is TrackingStatus.TRACKING
    for one in found:  # odometry is exact here
        assert_true(one)
    trajectory = module.get_trajectory()
    assert trajectory.stamps_ns.tolist() == [index * PERIOD_NS for index in range(28)]


def test_observation_that_is_skipped_gets_no_pose_of_its_own():
    module, _ = driven(Exact(ready=lambda count: count % 4 == 0, skips=(5, 6)), steps=12)
    assert set(module.get_trajectory().stamps_ns // PERIOD_NS) == set(range(12)) - {5, 6}


def test_pose_that_is_too_late_is_lost_until_it_comes():
    _, found = driven(Exact(ready=lambda count: count in (1, 20)), steps=22)
    states = [one.status for one in found]
    assert states[5] is TrackingStatus.DEGRADED  # 0.5 s of carrying on
    assert set(states[6:19]) == {TrackingStatus.LOST}
    assert states[19] is TrackingStatus.TRACKING


@pytest.mark.parametrize("stamp_ns", [99 * PERIOD_NS, -1])
def test_pose_that_nobody_waits_for_is_refused(stamp_ns):
    class Wrong(Exact):
        def feed(self, observation):
            status = TrackingStatus.TRACKING
            return [Tracking(stamp_ns=stamp_ns, T_local_base=np.eye(4), status=status)]

    with pytest.raises(ValueError, match="not waiting"):
        driven(Wrong(), steps=2)


def test_contract_of_a_slam_module_is_kept_by_a_system_that_is_three_images_late():
    class Behind(Exact):
        """Always says what it knew three observations ago."""

        def activate(self, rig):
            super().activate(rig)
            self._behind = []

        def feed(self, observation):
            self._behind += super().feed(observation)
            poses, self._behind = self._behind[:-3], self._behind[-3:]
            return poses

    check_module(lambda: Pipelined(Behind(), late_max_s=0.5))


class Late(Exact):
    """Knows every pose to 1 cm and 10 mrad, and gives it `lag` observations later."""

    def __init__(self, lag, is_revised=False):
        super().__init__()
        self._lag, self._is_revised = lag, is_revised

    def activate(self, rig):
        super().activate(rig)
        self._known = []

    def feed(self, seen):
        known = Tracking(
            stamp_ns=seen.stamp_ns,
            T_local_base=true_pose(seen.stamp_ns),
            status=TrackingStatus.TRACKING,
            covariance=0.01**2 * np.eye(6),
        )
        self._known.append(known)
        ready = len(self._known) - self._lag
        return self._known[max(ready - 1, 0) : max(ready, 0)]

    def get_trajectory(self):
        known = self._known if self._is_revised else []
        stamps_ns = np.array([one.stamp_ns for one in known], np.int64)
        poses = np.array([one.T_local_base for one in known]).reshape(-1, 4, 4)
        return Trajectory(stamps_ns=stamps_ns, T_world_base=poses)


def deviations_m(system, *, has_odometry=True, steps=60):
    """Return the standard deviations (N,) along x of the poses of a run with a system."""
    module, atlas = Pipelined(system, 0.5), Atlas(voxel_m=0.05)
    module.activate(RIG)
    session = atlas.begin_session("late", se3.identity())
    for index in range(steps):
        answer = module.track(observation(index, has_odometry=has_odometry))
        is_lost = answer.status is TrackingStatus.LOST
        if not is_lost:
            atlas.add_local(answer.stamp_ns, answer.T_local_base)
        name = BRIDGED if is_lost else "late"
        atlas.add(answer.stamp_ns, answer.T_local_base, name, answer.covariance)
    atlas.close_session(session, MapLayers(), checked_trajectory(module.get_trajectory()))
    return np.sqrt(atlas.covariances(Wheels() if has_odometry else None)[:, 0, 0])


@pytest.mark.parametrize("has_odometry", [False, True])
@pytest.mark.parametrize("is_revised", [False, True])
def test_a_pose_that_came_late_is_as_certain_as_its_answer(has_odometry, is_revised):
    in_time = deviations_m(Late(0))
    late = deviations_m(Late(4, is_revised), has_odometry=has_odometry)
    np.testing.assert_allclose(late[5:56], in_time[5:56], rtol=0.02)
    assert late[-1] > 1.1 * in_time[-1]  # nothing answered for it


def test_impossible_patience_is_refused():
    with pytest.raises(ConfigError, match="late_max_s"):
        Pipelined(Exact(), -1.0)


def test_system_of_another_kind_is_refused():
    with pytest.raises(ConfigError, match="system"):
        Pipelined("my_slam.MyPipeline", 0.5)


def said(answers, *, has_odometry=True):
    """Return what a system that says `answers` (index of observation -> fields) is taken to say."""
    pipeline, found = Pipeline(late_max_s=1.0), []
    for index in range(6):
        seen = observation(index, has_odometry=has_odometry)
        pipeline.note(seen)
        if index in answers:
            given = {"T_local_base": true_pose(seen.stamp_ns), "status": TrackingStatus.TRACKING}
            pipeline.take([Tracking(stamp_ns=seen.stamp_ns, **given | answers[index])])
        found.append(pipeline.report(seen))
    return found


def test_answers_are_kept_as_numbers_not_as_objects():
    pipeline, kept = Pipeline(late_max_s=1.0), []
    for index in range(5):
        pipeline.note(observation(index))
        T_local_base = true_pose(index * PERIOD_NS)
        kept.append(weakref.ref(T_local_base))
        status = TrackingStatus.TRACKING
        stamp_ns = index * PERIOD_NS
        pipeline.take([Tracking(stamp_ns=stamp_ns, T_local_base=T_local_base, status=status)])
    assert [one() is None for one in kept] == [True] * 4 + [False]


def test_a_correction_of_the_map_is_no_velocity():
    T_new_old = se3.from_xy_yaw(1.0, 0.0, 0.0)
    moved = {"T_local_base": T_new_old @ true_pose(2 * PERIOD_NS), "revision": 1}
    answers = said({0: {}, 1: {}, 2: moved}, has_odometry=False)
    expected = T_new_old @ true_pose(3 * PERIOD_NS)
    np.testing.assert_allclose(answers[3].T_local_base, expected, atol=1e-9)


def test_the_drift_of_a_systems_map_is_that_of_its_newest_answer():
    answers = said({k: {"map_covariance": (k + 1.0) * np.eye(6)} for k in (0, 1, 4)})
    yaw_variance = [answer.map_covariance[5, 5] for answer in answers]
    np.testing.assert_allclose(yaw_variance, [1, 2, 2, 2, 5, 5])
    T = se3.inverse(answers[3].T_local_base) @ answers[1].T_local_base
    np.testing.assert_allclose(answers[3].map_covariance, se3.carried(2.0 * np.eye(6), T))


def test_a_pose_that_is_carried_on_has_the_covariance_of_the_motion_too():
    given, lost = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), {"status": TrackingStatus.LOST}
    answers = said({0: {"covariance": np.eye(6)}, 1: {"covariance": given}, 4: lost})
    assert answers[1].covariance is given
    for index in (2, 3):
        T = se3.inverse(answers[index].T_local_base) @ answers[1].T_local_base
        model = MotionModel(RIG)
        model.predict(observation(1))
        moved = model.predict(observation(index)).covariance
        grown = answers[index].covariance - se3.carried(given, T)
        np.testing.assert_allclose(grown, moved, atol=1e-9)
    assert answers[4].covariance is None and answers[5].covariance is None
    assert all(answer.covariance is None for answer in said({0: {}})[1:])


def test_a_pose_is_carried_on_by_the_wheels_of_the_rig():
    class Certain(Exact):
        def feed(self, observation):
            covariance = np.eye(6) * 1e-6
            return [replace(one, covariance=covariance) for one in super().feed(observation)]

    found = []
    for noise_ratio in (0.07, 0.7):
        module = Pipelined(Certain(ready=lambda count: count == 1), 0.5)
        module.activate(replace(RIG, wheels=Wheels(noise_ratio=noise_ratio)))
        found.append([module.track(observation(index)) for index in range(3)][-1].covariance)
    assert found[1][0, 0] > 50.0 * found[0][0, 0]


def test_constant_velocity_is_less_certain_the_longer_it_lasts():
    seen = {"covariance": np.eye(6) * 0.01**2}
    answers = said({0: seen, 1: seen}, has_odometry=False)
    deviations_m = [float(np.sqrt(answer.covariance[0, 0])) for answer in answers[1:]]
    assert deviations_m[0] == pytest.approx(0.01)
    assert np.all(np.diff(deviations_m) > 0.005)
    assert 0.1 < deviations_m[-1] < 0.4  # 1.5 m/s^2 for 0.4 s are 0.12 m


def test_a_system_may_begin_anew_only_where_it_says_that_it_is_lost():
    lost = {"status": TrackingStatus.LOST, "can_begin": True}
    assert [answer.can_begin for answer in said({0: {}, 2: lost})] == [0, 0, 1, 1, 1, 1]
    assert not any(answer.can_begin for answer in said({0: {"can_begin": True}}))
