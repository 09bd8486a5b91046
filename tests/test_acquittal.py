"""A module that was suspected of what the wheels did wrong is right after all, poses included."""

from dataclasses import replace

import numpy as np
import pytest
from driving import GATE, drive, events
from fakes import PERIOD_NS, ExactModule, observation
from fakes import true_pose as pose_at
from test_bus_gate import ONE, errors_m

from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.run import BRIDGED
from sceneslam.types.trajectory import Trajectory

OPTIONS = {"steps": 120, "table": ONE, "gate": GATE, "handover": "rewind"}


class Uncertain(ExactModule):
    """Does not say how certain it is up to an index, so that wheels are believed against it."""

    def __init__(self, until=55, **kinds):
        super().__init__(**kinds)
        self.until = until

    def track(self, observation):
        tracking = super().track(observation)
        if tracking.status is TrackingStatus.LOST or observation.stamp_ns <= self.until * PERIOD_NS:
            return tracking
        return replace(tracking, covariance=1e-6 * np.eye(6))


def frozen(first, *, without=(), silent=()):
    """Wheels that stand still from an index on; some observations without image, or anything."""

    def feed(index):
        wheels = pose_at(min(index, first) * PERIOD_NS)
        given = replace(observation(index), T_odom_base=wheels)
        if index in without or index in silent:
            given = replace(given, image_bgr=None)
        return replace(given, T_odom_base=None) if index in silent else given

    return feed


def bridged(atlas):
    return [index for index, one in enumerate(atlas.pose_modules) if one == BRIDGED]


def test_poses_are_the_module_s_again_where_the_wheels_turn_out_to_be_wrong():
    _, atlas, log, _ = drive({"bright": Uncertain()}, feed=frozen(40, without=[48]), **OPTIONS)
    suspected = events(log, "suspect")[0]["stamp_ns"] // PERIOD_NS
    assert 40 < suspected < 55
    assert [event["is_believed"] for event in events(log, "odometry")] == [False]
    assert errors_m(atlas.online).max() > 0.05  # what the wheels told meanwhile
    assert errors_m(atlas.trajectory).max() < 1e-9 and len(atlas.sessions) == 1
    assert bridged(atlas) == [48]
    local = atlas.sessions[0].trajectory.stamps_ns // PERIOD_NS
    assert local.tolist() == [index for index in range(120) if index != 48]


def test_poses_are_interpolated_where_it_was_lost_meanwhile():
    module = Uncertain(lost=range(46, 54))
    _, atlas, _, _ = drive({"bright": module}, feed=frozen(40), **OPTIONS)
    assert errors_m(atlas.trajectory).max() < 1e-9 and bridged(atlas) == list(range(46, 54))


def test_what_a_short_memory_has_forgotten_stays_and_the_module_stays_where_it_was():
    _, atlas, _, _ = drive({"bright": Uncertain(70)}, feed=frozen(40), buffer_s=2.0, **OPTIONS)
    errors = errors_m(atlas.trajectory)
    assert errors[41:50].max() > 0.1 and errors[55:].max() < 1e-9


def test_a_module_that_slid_while_it_was_degraded_is_not_acquitted():
    class Sliding(ExactModule):
        """Slides sideways at 0.15 m/s while DEGRADED; certain, and right, afterwards."""

        def track(self, observation):
            tracking, index = super().track(observation), observation.stamp_ns // PERIOD_NS
            slid = se3.from_xy_yaw(0.0, 0.015 * (min(max(index, 40), 70) - 40), 0.0)
            is_bad = 40 <= index < 65
            return replace(
                tracking,
                T_local_base=slid @ tracking.T_local_base,
                status=TrackingStatus.DEGRADED if is_bad else TrackingStatus.TRACKING,
                covariance=1e-6 * np.eye(6),
            )

    _, atlas, log, _ = drive({"bright": Sliding()}, **OPTIONS)
    assert events(log, "suspect") and errors_m(atlas.trajectory).max() < 0.1


def test_a_correction_of_its_past_meanwhile_is_no_motion():
    class Revised(Uncertain):
        """Corrects its past by half a metre."""

        def track(self, observation):
            tracking = super().track(observation)
            if observation.stamp_ns <= 50 * PERIOD_NS:
                return tracking
            moved = se3.from_xy_yaw(0.5, 0.0, 0.0) @ tracking.T_local_base
            return replace(tracking, T_local_base=moved, revision=1)

    feed = frozen(40, without=[52, 53])
    _, atlas, _, _ = drive({"bright": Revised()}, feed=feed, **OPTIONS)
    np.testing.assert_allclose(errors_m(atlas.trajectory)[51:], 0.5, atol=1e-6)


@pytest.mark.parametrize(("loop_at", "data_at"), [(36, 37), (39, 37), (39, 40)])
def test_poses_are_interpolated_in_the_map_of_the_next_answer(loop_at, data_at):
    """It has no data from where the suspicion begins until it closes a loop, or before that."""
    said = []

    class Closing(Uncertain):
        """Drifts by 10 cm until 30; closes a loop, and reports the whole path at its end."""

        def track(self, observation):
            tracking, index = super().track(observation), observation.stamp_ns // PERIOD_NS
            said.append((observation.stamp_ns, tracking.T_local_base))
            aside = se3.from_xy_yaw(0.0, min(index, 30) / 300 if index < loop_at else 0.0, 0.0)
            T_local_base = aside @ tracking.T_local_base
            return replace(tracking, T_local_base=T_local_base, revision=int(index >= loop_at))

        def get_trajectory(self):
            stamps_ns, poses = zip(*said, strict=True)
            return Trajectory(stamps_ns=np.array(stamps_ns), T_world_base=np.stack(poses))

    feed = frozen(40, without=range(34, data_at))
    _, atlas, log, _ = drive({"bright": Closing(60)}, feed=feed, **OPTIONS)
    assert events(log, "revised")[-1]["from_ns"] == 34 * PERIOD_NS
    assert errors_m(atlas.trajectory).max() < 1e-9 and len(atlas.sessions) == 1


def test_a_second_disagreement_before_the_first_was_decided_belongs_to_it():
    feed = frozen(40, silent=range(46, 58))
    options = {**OPTIONS, "lost_patience_s": 5.0}
    _, atlas, _, _ = drive({"bright": Uncertain(62)}, feed=feed, **options)
    assert errors_m(atlas.trajectory).max() < 1e-9 and len(atlas.sessions) == 1


@pytest.mark.parametrize("first", range(6))
def test_poses_of_the_module_before_are_not_in_doubt(first):
    """The first choice returns from standby, and the wheels freeze about then."""
    options = {"steps": 140, "gate": GATE, "handover": "rewind", "retry_s": 1.0}
    lost = range(20, 32)

    def run(until, **more):
        modules = {"bright": Uncertain(until, lost=lost), "dark": ExactModule()}
        return drive(modules, **options, **more)

    _, _, log, _ = run(10**6)
    decided_ns = [one["stamp_ns"] for one in events(log, "decision") if one["reason"] == "return"]
    back = decided_ns[0] // PERIOD_NS
    _, atlas, log, _ = run(back + 9, feed=frozen(back - 2 + first))
    assert errors_m(atlas.trajectory)[: back + 1].max() < 1e-9
    assert errors_m(atlas.trajectory).max() < 0.3
