"""The bus: states, hand-over, fallbacks, and what happens when a module breaks its promise."""

from dataclasses import replace

import numpy as np
import pytest
from fakes import PERIOD_NS, RIG, ExactModule, ScriptedDetector, observation, true_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneslam.atlas.atlas import BRIDGED, Atlas
from sceneslam.bus.bus import Bus
from sceneslam.bus.events import EventLog
from sceneslam.bus.policy import Policy
from sceneslam.types import se3
from sceneslam.types.rig import Sensor

TABLE = {"Bright": ["bright", "dark"], "Dark": ["dark", "bright"]}


def policy(**changes):
    values = {
        "handover": "cold",
        "confirm_window_s": 2.0,
        "first_confirm_window_s": 0.0,
        "lost_patience_s": 0.3,
        "blind_patience_s": 0.1,
        "bridge_s": 0.5,
    }
    return Policy(**(values | changes))


def drive(modules, *, steps=100, scene_at=lambda i: "Bright", table=TABLE, **options):
    """Run the bus over a straight drive; return it with its atlas, log and detector."""
    has_odometry = options.pop("has_odometry", True)
    feed = options.pop("feed", lambda index: observation(index, has_odometry=has_odometry))
    atlas, log, detector = Atlas(voxel_m=0.05), EventLog(), ScriptedDetector(scene_at)
    bus = Bus(
        detector=detector,
        modules=modules,
        scenes=table,
        policy=policy(**options),
        rig=RIG,
        atlas=atlas,
        log=log,
    )
    for index in range(steps):
        if bus.state == "terminate":
            break
        bus.step(feed(index))
    bus.close(index * PERIOD_NS)
    return bus, atlas, log, detector


def events(log, kind):
    return [event for event in log.events if event["event"] == kind]


def dark_from(index):
    return lambda i: "Dark" if i >= index else "Bright"


def assert_exact(atlas):
    T_first = true_pose(int(atlas.trajectory.stamps_ns[0]))
    for stamp_ns, T_map_base in zip(
        atlas.trajectory.stamps_ns.tolist(), atlas.trajectory.T_world_base, strict=True
    ):
        expected = se3.inverse(T_first) @ true_pose(stamp_ns)
        np.testing.assert_allclose(T_map_base, expected, atol=1e-9)


def test_first_scene_starts_its_module_at_the_origin():
    _, atlas, log, _ = drive({"bright": ExactModule(), "dark": ExactModule()}, steps=5)
    assert set(atlas.pose_modules) == {"bright"}
    np.testing.assert_array_equal(atlas.trajectory.T_world_base[0], np.eye(4))
    path = [(e["from"], e["to"]) for e in events(log, "state")]
    assert path == [("init", "start"), ("start", "run"), ("run", "terminate")]


def test_switch_waits_for_the_confirmation_window():
    _, _atlas, log, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule()}, scene_at=dark_from(40)
    )
    decision = events(log, "decision")[1]
    assert decision["stamp_ns"] == (40 + 20) * PERIOD_NS
    assert (decision["from"], decision["to"], decision["reason"]) == ("bright", "dark", "scene")


def test_one_disagreeing_image_starts_the_window_anew():
    def scene_at(index):
        return "Bright" if index < 40 or index == 59 else "Dark"

    _, _, log, _ = drive({"bright": ExactModule(), "dark": ExactModule()}, scene_at=scene_at)
    assert events(log, "decision")[1]["stamp_ns"] == (60 + 20) * PERIOD_NS


def test_trajectory_is_continuous_and_complete_across_the_switch():
    _, atlas, log, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule()}, scene_at=dark_from(40)
    )
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)
    T_map_local = np.array(events(log, "handover")[1]["T_map_local"])
    np.testing.assert_allclose(T_map_local, true_pose(60 * PERIOD_NS), atol=1e-9)


def test_same_module_for_the_new_scene_is_told_and_not_restarted():
    module = ExactModule()
    _, _, log, _ = drive(
        {"only": module}, scene_at=dark_from(40), table={"Bright": ["only"], "Dark": ["only"]}
    )
    assert module.activations == 1 and module.scenes == ["Bright", "Dark"]
    assert len(events(log, "decision")) == 1


def test_lost_module_is_bridged_by_odometry_then_replaced():
    bright = ExactModule(lost=range(50, 200))
    _, atlas, log, _ = drive({"bright": bright, "dark": ExactModule()})
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)
    assert atlas.pose_modules[49:55] == ("bright", BRIDGED, BRIDGED, BRIDGED, BRIDGED, "dark")
    assert events(log, "decision")[1]["reason"] == "lost"


def test_lost_module_is_bridged_by_constant_velocity_without_odometry():
    bright = ExactModule(lost=range(50, 200))
    _, atlas, _, _ = drive({"bright": bright, "dark": ExactModule()}, has_odometry=False)
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)


def test_patience_is_shorter_where_the_pose_is_guessed():
    bright = ExactModule(lost=range(50, 200))
    _, atlas, log, _ = drive({"bright": bright, "dark": ExactModule()}, has_odometry=False)
    assert events(log, "decision")[1]["stamp_ns"] == 51 * PERIOD_NS
    assert atlas.pose_modules[49:53] == ("bright", BRIDGED, BRIDGED, "dark")


def test_lost_module_without_a_fallback_invents_no_pose():
    module = ExactModule(lost=range(50, 70))
    _bus, atlas, log, _ = drive(
        {"only": module},
        table={"Bright": ["only"], "Dark": ["only"]},
        has_odometry=False,
    )
    assert len(atlas.trajectory) == 80
    assert len(events(log, "decision")) == 1
    assert atlas.pose_modules[-1] == "only"


def test_two_lost_modules_do_not_take_turns_for_ever():
    lost = range(50, 400)
    _, _, log, _ = drive(
        {"bright": ExactModule(lost=lost), "dark": ExactModule(lost=lost)}, steps=300
    )
    assert len(events(log, "decision")) <= 8


def test_raising_module_is_stopped_and_its_fallback_runs():
    bright = ExactModule(raises={50})
    _, atlas, log, _ = drive({"bright": bright, "dark": ExactModule()})
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)
    assert "out of memory" in events(log, "fault")[0]["what"]
    assert bright.shutdowns == 1


def test_pose_of_nan_never_reaches_the_trajectory():
    bright = ExactModule(returns_nan={50})
    _, atlas, log, _ = drive({"bright": bright, "dark": ExactModule()})
    assert np.isfinite(atlas.trajectory.T_world_base).all()
    assert "not finite" in events(log, "fault")[0]["what"]


def test_module_that_cannot_be_activated_gives_way_at_the_start():
    _bus, atlas, log, _ = drive(
        {"bright": ExactModule(raises_on_activate=True), "dark": ExactModule()}
    )
    assert set(atlas.pose_modules) == {"dark"}
    path = [(e["from"], e["to"]) for e in events(log, "state")]
    assert path[:3] == [("init", "start"), ("start", "start"), ("start", "run")]


def test_module_that_cannot_be_activated_leaves_the_old_one_running():
    bright = ExactModule()
    _, atlas, log, _ = drive(
        {"bright": bright, "dark": ExactModule(raises_on_activate=True)}, scene_at=dark_from(40)
    )
    assert set(atlas.pose_modules) == {"bright"}
    assert len(atlas.trajectory) == 100 and bright.activations == 1
    path = [(e["from"], e["to"], e["reason"]) for e in events(log, "state")]
    assert ("switch", "run", "failure") in path
    assert len(events(log, "decision")) == 1 and events(log, "refused")[0]["to"] == "dark"


def test_run_terminates_when_no_module_is_left():
    bus, atlas, _log, detector = drive(
        {"bright": ExactModule(raises={50}), "dark": ExactModule(raises_on_activate=True)}
    )
    assert bus.state == "terminate" and detector.is_shut_down
    assert len(atlas.trajectory) == 51  # the last one bridged


def test_detector_that_raises_keeps_the_scene():
    def scene_at(index):
        if index == 30:
            raise ValueError("bad weights")
        return "Bright"

    _, atlas, log, _ = drive({"bright": ExactModule(), "dark": ExactModule()}, scene_at=scene_at)
    assert len(atlas.trajectory) == 100
    assert "bad weights" in events(log, "fault")[0]["what"]


def test_unsure_votes_neither_confirm_nor_break_a_window():
    def scene_at(index):
        return ("Bright" if index < 40 else "Dark") if index % 2 else None

    _, _, log, _ = drive({"bright": ExactModule(), "dark": ExactModule()}, scene_at=scene_at)
    assert events(log, "decision")[1]["stamp_ns"] == (41 + 20) * PERIOD_NS


def test_modules_and_detector_are_shut_down_at_the_end():
    modules = {"bright": ExactModule(), "dark": ExactModule()}
    _, _, _, detector = drive(modules, scene_at=dark_from(40))
    assert [module.shutdowns for module in modules.values()] == [1, 1]
    assert detector.is_shut_down


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


def test_sensor_that_falls_silent_calls_in_the_fallback():
    def feed(index):
        return observation(index) if index < 50 else replace(observation(index), image_bgr=None)

    class Blind(ExactModule):
        requires = (frozenset({Sensor.ODOMETRY}),)

    modules = {"bright": ExactModule(), "dark": Blind()}
    _, atlas, log, _ = drive(modules, feed=feed)
    assert events(log, "decision")[1]["reason"] == "lost"
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
