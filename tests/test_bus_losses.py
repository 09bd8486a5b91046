"""The bus: losses, silent sensors and improper answers cost no pose that could be told."""

from dataclasses import replace

import numpy as np
import pytest
from driving import GATE, assert_exact, dark_from, drive, events
from fakes import PERIOD_NS, ExactModule, observation, true_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneslam.types import se3
from sceneslam.types.rig import Sensor
from sceneslam.types.run import BRIDGED


def test_module_lost_right_after_the_switch_is_survived():
    """Both modules gave the hand-over's instant a pose: no velocity can be told from these two."""
    dark = ExactModule(lost={61, 62})
    _, atlas, _, _ = drive(
        {"bright": ExactModule(), "dark": dark}, scene_at=dark_from(40), has_odometry=False
    )
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)


def test_fallback_that_never_tracks_gives_the_first_choice_another_chance():
    bright, dark = ExactModule(lost=range(50, 56)), ExactModule(lost=range(0, 1000))
    _, atlas, _, _ = drive({"bright": bright, "dark": dark}, steps=300, has_odometry=False)
    assert atlas.pose_modules.count("bright") > 240


def test_slow_sensor_is_not_a_lost_module():
    """The module's sensor speaks with every fifth observation, as a 2 Hz laser beside a camera."""

    class Slow(ExactModule):
        requires = (frozenset({Sensor.POINTS}),)

    def feed(index):
        points = np.zeros((1, 3), np.float32) if index % 5 == 0 else None
        return replace(observation(index), points_lidar=points)

    modules = {"bright": Slow(), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, lost_patience_s=0.3, feed=feed)
    assert len(events(log, "decision")) == 1 and len(atlas.trajectory) == 100
    assert_exact(atlas)


@pytest.mark.parametrize("wheels", ["frozen", "missing"])
def test_fallback_comes_at_once_where_no_wheels_bridge(wheels):
    """Wheels that lie bridge as little as wheels that are not there."""

    class Certain(ExactModule):
        def track(self, observation):
            return replace(super().track(observation), covariance=1e-6 * np.eye(6))

    def feed(index):
        frozen = true_pose(min(index, 40) * PERIOD_NS)
        return replace(observation(index), T_odom_base=frozen if wheels == "frozen" else None)

    modules = {"bright": Certain(lost=range(70, 1000)), "dark": Certain()}
    _, atlas, log, _ = drive(modules, feed=feed, gate=GATE, lost_patience_s=1.0)
    decision = events(log, "decision")[1]
    assert decision["reason"] == "lost" and decision["stamp_ns"] == 71 * PERIOD_NS
    assert_exact(atlas)


def test_wheels_that_lied_bridge_again_some_seconds_after_the_module_was_lost():
    class Certain(ExactModule):
        def track(self, observation):
            return replace(super().track(observation), covariance=1e-6 * np.eye(6))

    def feed(index):
        slipped = true_pose((index + 10 * (index >= 40)) * PERIOD_NS)
        return replace(observation(index), T_odom_base=slipped)

    module = Certain(lost=range(45, 1000))
    table = {"Bright": ["bright"]}
    _, atlas, log, _ = drive({"bright": module}, feed=feed, gate=GATE, table=table, steps=150)
    told = [(one["stamp_ns"] // PERIOD_NS, one["is_believed"]) for one in events(log, "odometry")]
    assert told == [(40, False), (95, True)]
    indices = (atlas.trajectory.stamps_ns // PERIOD_NS).tolist()
    assert indices[44:] == [44, *range(95, 150)]


def test_sensor_that_falls_silent_calls_in_the_fallback():
    def feed(index):
        return observation(index) if index < 50 else replace(observation(index), image_bgr=None)

    class Blind(ExactModule):
        requires = (frozenset({Sensor.ODOMETRY}),)

    modules = {"bright": ExactModule(), "dark": Blind()}
    _, atlas, log, _ = drive(modules, feed=feed)
    decision = events(log, "decision")[1]
    assert decision["reason"] == "silent"
    # The last image is 49: two periods of silence, then the patience of 0.3 s.
    assert decision["stamp_ns"] in range(53 * PERIOD_NS, 57 * PERIOD_NS)
    assert_exact(atlas)


@pytest.mark.parametrize("answer", [None, "pose", np.eye(3)])
def test_answer_that_is_no_tracking_ends_the_module_not_the_run(answer):
    class Wrong(ExactModule):
        def track(self, observation):
            if observation.stamp_ns != 50 * PERIOD_NS:
                return super().track(observation)
            if not isinstance(answer, np.ndarray):
                return answer
            return replace(super().track(observation), T_local_base=answer)

    _, atlas, log, _ = drive({"bright": Wrong(), "dark": ExactModule()})
    assert len(atlas.trajectory) == 100 and len(events(log, "fault")) == 1
    assert_exact(atlas)


def test_module_may_go_on_with_its_own_matrix():
    class InPlace(ExactModule):
        def activate(self, rig):
            super().activate(rig)
            self._mine = np.eye(4)

        def track(self, observation):
            self._mine[:] = super().track(observation).T_local_base
            return replace(super().track(observation), T_local_base=self._mine)

    _, atlas, _, _ = drive({"bright": InPlace(), "dark": ExactModule()})
    assert_exact(atlas)
    (session,) = atlas.sessions
    np.testing.assert_allclose(
        session.trajectory.T_world_base[10], true_pose(10 * PERIOD_NS), atol=1e-9
    )


@settings(max_examples=25, deadline=None)
@given(
    switch=st.integers(1, 60),
    lost=st.sets(st.integers(1, 79), max_size=20),
    twist=st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array),
)
def test_trajectory_is_continuous_wherever_the_switch_and_the_losses_fall(switch, lost, twist):
    start = se3.exp(twist)

    class Elsewhere(ExactModule):
        """Its `local` begins anywhere, as that of a module that loaded a map."""

        def track(self, observation):
            tracking = super().track(observation)
            return replace(tracking, T_local_base=start @ tracking.T_local_base)

    modules = {"bright": ExactModule(lost=lost), "dark": Elsewhere(lost=lost)}
    _, atlas, _, _ = drive(modules, steps=80, scene_at=dark_from(switch), confirm_window_s=0.5)
    assert len(atlas.trajectory) == 80
    assert_exact(atlas)


@pytest.mark.parametrize("startup_s", [{"slow": 8.0}, {"slow": 8.0, "quick": 1.0}])
def test_a_module_that_starts_slowly_does_not_keep_another_from_a_lost_robot(startup_s):
    modules = {
        "bright": ExactModule(lost=range(60, 1000)),
        "slow": ExactModule(),
        "quick": ExactModule(),
    }
    table = {"Bright": ["bright"], "Dark": ["slow", "quick"]}
    _, atlas, log, _ = drive(
        modules,
        steps=200,
        table=table,
        scene_at=dark_from(30),
        has_odometry=False,
        handover="rewind",
        startup_s=startup_s,
        retry_s=2.0,
        lost_patience_s=1.0,
    )
    decisions = [(one["to"], one["stamp_ns"] / 1e9) for one in events(log, "decision")]
    assert [key for key, _ in decisions] == ["bright", "quick", "slow"]
    assert decisions[1][1] <= 6.0 + 1.0 + 1.2 and decisions[2][1] <= 15.0
    assert modules["slow"].activations == 1
    assert BRIDGED not in atlas.pose_modules[-60:]


@pytest.mark.parametrize("fault", ["lost", "raises"])
def test_what_started_beside_a_slow_module_and_failed_leaves_that_to_take_over(fault):
    quick = ExactModule(**{fault: range(1000)})
    modules = {"bright": ExactModule(lost=range(60, 1000)), "slow": ExactModule(), "quick": quick}
    table = {"Bright": ["bright"], "Dark": ["slow", "quick"]}
    options = {"handover": "rewind", "startup_s": {"slow": 8.0}, "lost_patience_s": 1.0}
    _, _, log, _ = drive(modules, steps=200, table=table, scene_at=dark_from(30), **options)
    assert [one["to"] for one in events(log, "refused")] == ["quick"]
    assert [one["to"] for one in events(log, "decision")] == ["bright", "slow"]
    assert modules["slow"].activations == 1


def test_what_started_beside_a_slow_module_does_not_replace_one_that_tracks_again():
    modules = {
        "bright": ExactModule(lost=range(40, 55)),
        "slow": ExactModule(raises_on_activate=True),
        "last": ExactModule(),
    }
    table = {"Bright": ["bright"], "Dark": ["slow", "bright", "last"]}
    startup_s = {"slow": 4.0, "last": 8.0}
    options = {"handover": "rewind", "startup_s": startup_s, "lost_patience_s": 1.0}
    _, _, log, _ = drive(modules, steps=160, table=table, scene_at=dark_from(20), **options)
    assert [one["to"] for one in events(log, "decision")] == ["bright"]
    assert modules["bright"].scenes[-1] == "Dark" and modules["last"].activations == 0
