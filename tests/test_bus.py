"""The bus: states, hand-over, fallbacks, and modules that break their promise."""

import weakref

import numpy as np
import pytest
from driving import assert_exact, dark_from, drive, events
from fakes import PERIOD_NS, ExactModule, observation, true_pose

from sceneslam.types.run import BRIDGED


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


def test_same_module_for_the_new_scene_is_replaced_when_the_patience_is_over():
    """It had tracked for less than a window, so that modules that were tried would have to wait."""
    modules = {"bright": ExactModule(lost={30, *range(45, 100)}), "dark": ExactModule()}
    table = {scene: ["bright", "dark"] for scene in ("Bright", "Dark")}
    _, _, log, _ = drive(modules, scene_at=dark_from(20), table=table)
    assert [event["stamp_ns"] for event in events(log, "decision")] == [0, 48 * PERIOD_NS]


@pytest.mark.parametrize("choices", [("dark",), ("dark", "bright")])
@pytest.mark.parametrize("why", ["lost", "failed"])
def test_module_that_stays_because_no_other_can_take_over_is_told_the_scene(why, choices):
    cannot = {"lost": {"lost": range(100)}, "failed": {"raises_on_activate": True}}[why]
    modules = {"bright": ExactModule(), "dark": ExactModule(**cannot)}
    table = {"Bright": ["bright"], "Dark": choices}
    _, atlas, log, _ = drive(modules, scene_at=dark_from(40), table=table)
    assert events(log, "refused")[0]["why"] == why and set(atlas.pose_modules) == {"bright"}
    assert modules["bright"].scenes == ["Bright", "Dark"]


def test_lost_module_is_bridged_by_odometry_then_replaced():
    bright = ExactModule(lost=range(50, 200))
    _, atlas, log, _ = drive({"bright": bright, "dark": ExactModule()})
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)
    assert atlas.pose_modules[49:55] == ("bright", BRIDGED, BRIDGED, BRIDGED, "dark", "dark")
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
    assert atlas.pose_modules[49:53] == ("bright", BRIDGED, "dark", "dark")


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


@pytest.mark.parametrize("has_odometry", [True, False])
@pytest.mark.parametrize("fault", [{"raises": {20}}, {"raises_on_activate": True}])
def test_a_scene_without_a_module_left_is_bridged_until_another_scene_has_one(fault, has_odometry):
    bus, atlas, log, _ = drive(
        {"bright": ExactModule(**fault), "dark": ExactModule()},
        table={"Bright": ["bright"], "Dark": ["dark"]},
        scene_at=dark_from(50),
        has_odometry=has_odometry,
    )
    assert events(log, "decision")[-1]["to"] == "dark" and atlas.pose_modules[-1] == "dark"
    assert list(bus.unserved) == ["Bright"] and "slam.bright" in bus.unserved["Bright"]
    states = [event["to"] for event in events(log, "state")]
    assert len(states) < 12 and states.count("terminate") == 1
    assert not has_odometry or "raises_on_activate" in fault or len(atlas.trajectory) == 100


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


def test_a_run_that_is_over_holds_no_image():
    images = []

    def feed(index):
        one = observation(index)
        images.append(weakref.ref(one.image_bgr))
        return one

    modules = {"bright": ExactModule(), "dark": ExactModule()}
    held = drive(modules, feed=feed, scene_at=dark_from(10), handover="rewind")
    assert held[0].state == "terminate" and not any(image() is not None for image in images)
