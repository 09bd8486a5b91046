"""Where a switch begins and ends in the trajectory, and what it did there."""

from dataclasses import replace

import pytest
from evaluation_runs import (
    SETTINGS,
    START_NS,
    first_events,
    happened,
    relabel,
    shift_from,
    stamps,
    switch_events,
    switched_run,
    true_loop,
    without,
)

from sceneslam.evaluation.metrics import evaluate
from sceneslam.evaluation.report.chronicle import chronicle
from sceneslam.evaluation.report.run_page import _switches
from sceneslam.evaluation.report.story import tell
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.types import se3
from sceneslam.types.run import RunResult
from sceneslam.types.truth import GroundTruth, SceneChange


def switched_back(at: int, to: str = "rgbd") -> RunResult:
    """The switched run with a second decision, from `laser` to `to`, at pose `at`."""
    run = relabel(switched_run(), slice(at, 200), to)
    stamp_ns = int(stamps(200)[at])
    return replace(run, events=[*run.events, *switch_events(stamp_ns, stamp_ns, "laser", to)])


def test_without_truth_the_jump_is_what_the_handover_measured():
    (switch,) = evaluate(switched_run(), None, settings=SETTINGS)["switches"]
    assert (switch["jump_m"], switch["jump_rad"], switch["cost_ms"]) == (0.5, 0.25, 3.5)
    assert switch["gap_s"] == 0.0 and not switch["jump_is_error"]


def test_without_truth_the_jump_is_told_as_a_motion_of_the_pose_and_not_as_an_error():
    metrics = evaluate(switched_run(), None, settings=SETTINGS)
    story, (line,) = " ".join(tell(metrics)), [x for x in summary_lines(metrics) if "->" in x]
    assert (
        "; the current pose was moved by 0.500 m and 14.32°, and the trajectory has no gap" in story
    )
    assert "moved by 0.500 m and 14.32°, gap" in line and "off by" not in story
    assert "<td>moved 0.5000 m</td><td>moved 14.32°</td>" in _switches(metrics)
    details = chronicle(switched_run(), metrics["switches"], value_label="")[-1].details
    assert "No gap." in details and "Error" not in " ".join(details)


def test_without_truth_a_pose_that_was_not_moved_has_no_jump():
    run = switched_run()
    still = {"jump_m": 0.0, "jump_rad": 0.0}
    events = [e | still if e["event"] == "handover" else e for e in run.events]
    metrics = evaluate(replace(run, events=events), None, settings=SETTINGS)
    told = " ".join([*tell(metrics), *summary_lines(metrics), _switches(metrics)])
    assert "; the trajectory has no gap." in told and "<td>–</td><td>–</td>" in told
    assert not any(text in told for text in ("0.000", "moved by", "off by"))


def test_jump_is_the_error_of_the_motion_across_the_seam():
    run = shift_from(switched_run(), 100, se3.from_xy_yaw(0.3, 0.0, 0.0))
    (switch,) = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert switch["jump_m"] == pytest.approx(0.3, abs=0.005)
    assert switch["jump_rad"] == pytest.approx(0.0, abs=1e-6)
    assert switch["jump_is_error"]


def test_seam_of_a_rewind_lies_where_the_new_poses_begin():
    run = relabel(
        shift_from(switched_run(), 85, se3.from_xy_yaw(0.3, 0, 0)), slice(85, 100), "laser"
    )
    (switch,) = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert switch["jump_m"] == pytest.approx(0.3, abs=0.005)


def test_bridged_poses_belong_to_the_seam():
    run = relabel(shift_from(switched_run(), 95, se3.from_xy_yaw(0.3, 0, 0)), slice(90, 100), "")
    metrics = evaluate(run, true_loop(), settings=SETTINGS)
    assert metrics["bridged"] == 10
    assert metrics["switches"][0]["jump_m"] == pytest.approx(0.3, abs=0.005)
    assert metrics["switches"][0]["gap_s"] == 0.0


def test_gap_is_the_time_without_poses_beyond_the_usual_period():
    run = without(switched_run(), slice(100, 108))
    metrics = evaluate(run, true_loop(), settings=SETTINGS)
    assert metrics["switches"][0]["gap_s"] == pytest.approx(0.8)
    assert metrics["coverage"] == pytest.approx(1 - 8 / 200)


def test_confirm_delay_counts_from_the_true_change_it_answers():
    (switch,) = evaluate(switched_run(), true_loop(true_at=85), settings=SETTINGS)["switches"]
    assert switch["confirm_delay_s"] == pytest.approx(1.5)


def named_otherwise(run: RunResult, second_at: int) -> RunResult:
    """The run with the scene Dark called Cellar, then Tunnel from pose `second_at` on."""
    names = {"Dark": "Cellar"}
    events = [
        {**event, "scene": names.get(event["scene"], event["scene"])} if "scene" in event else event
        for event in run.events
    ]
    stamp_ns = int(stamps(200)[second_at])
    again = [{**e, "scene": "Tunnel"} for e in switch_events(stamp_ns, stamp_ns) if "scene" in e]
    return replace(run, events=[*events, *again])


def test_confirm_delay_of_a_scene_with_another_name_counts_for_its_first_switch_only():
    settings = replace(SETTINGS, scenes={"Cellar": "Dark", "Tunnel": "Dark"})
    run = named_otherwise(switched_run(), second_at=150)
    first, second = evaluate(run, true_loop(true_at=85), settings=settings)["switches"]
    assert first["confirm_delay_s"] == pytest.approx(1.5)
    assert second["confirm_delay_s"] is None


def test_switch_to_a_scene_that_is_not_there_is_false():
    scenes = (SceneChange(stamp_ns=START_NS, scene="Bright"),)
    truth = GroundTruth(trajectory=true_loop().trajectory, scenes=scenes)
    metrics = evaluate(switched_run(), truth, settings=SETTINGS)
    assert metrics["false_switches"] == 1
    assert metrics["switches"][0]["confirm_delay_s"] is None


def test_light_that_is_back_before_the_switch_makes_it_false():
    truth = true_loop()
    back = SceneChange(stamp_ns=int(stamps(200)[95]), scene="Bright")
    truth = GroundTruth(trajectory=truth.trajectory, scenes=(*truth.scenes, back))
    metrics = evaluate(switched_run(), truth, settings=SETTINGS)
    assert metrics["false_switches"] == 1
    assert metrics["switches"][0]["confirm_delay_s"] is None


def test_light_that_is_back_before_a_slow_module_has_started_makes_no_switch_false():
    truth, run = true_loop(), switched_run()
    decided_ns = int(stamps(200)[90])
    events = [
        {**event, "decided_ns": decided_ns} if event["event"] == "decision" else event
        for event in run.events
    ]
    back = SceneChange(stamp_ns=int(stamps(200)[95]), scene="Bright")
    truth = GroundTruth(trajectory=truth.trajectory, scenes=(*truth.scenes, back))
    metrics = evaluate(replace(run, events=events), truth, settings=SETTINGS)
    (switch,) = metrics["switches"]
    assert metrics["false_switches"] == 0
    assert switch["stamp_ns"] - switch["confirm_delay_s"] * 1e9 == truth.scenes[1].stamp_ns


def test_switch_for_a_lost_module_is_never_false_and_has_no_delay():
    run = switched_run()
    events = [{**e, "reason": "lost"} if e["event"] == "decision" else e for e in run.events]
    scenes = (SceneChange(stamp_ns=START_NS, scene="Bright"),)
    truth = GroundTruth(trajectory=true_loop().trajectory, scenes=scenes)
    metrics = evaluate(replace(run, events=events), truth, settings=SETTINGS)
    assert metrics["false_switches"] == 0
    assert metrics["switches"][0]["confirm_delay_s"] is None


def test_switch_whose_module_never_gave_a_pose_has_no_seam():
    run = without(switched_run(), slice(100, 200))
    (switch,) = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert (switch["jump_m"], switch["jump_rad"], switch["gap_s"]) == (None, None, None)


def test_module_that_never_tracked_in_its_turn_is_not_given_a_later_seam():
    run = switched_back(110)
    again_ns = int(stamps(200)[150])
    run = replace(run, events=[*run.events, *switch_events(again_ns, again_ns)])
    run = relabel(relabel(run, slice(100, 110), ""), slice(150, 200), "laser")
    run = shift_from(run, 150, se3.from_xy_yaw(0.3, 0.0, 0.0))
    first, _, last = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert (first["jump_m"], first["jump_rad"], first["gap_s"]) == (None, None, None)
    assert last["jump_m"] == pytest.approx(0.3, abs=0.005)


def test_seam_back_to_a_module_does_not_reach_into_its_earlier_turn():
    run = relabel(switched_back(130), slice(100, 130), "")  # laser never tracked
    run = relabel(run, slice(0, 20), "wheels")
    run = shift_from(run, 20, se3.from_xy_yaw(0.3, 0.0, 0.0))  # not the seam asked about
    _, back = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert back["jump_m"] == pytest.approx(0.0, abs=0.01)
    assert back["gap_s"] == 0.0


def test_pose_at_the_stamp_of_the_next_decision_ends_a_turn():
    run = relabel(switched_back(111), slice(100, 110), "")  # laser: pose 110, then replaced
    events = [
        {**e, "stamp_ns": int(stamps(200)[110])} if e["stamp_ns"] == stamps(200)[111] else e
        for e in run.events
        if e["event"] != "vote"
    ]
    run = shift_from(replace(run, events=events), 105, se3.from_xy_yaw(0.3, 0.0, 0.0))
    first, back = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert first["jump_m"] == pytest.approx(0.3, abs=0.005)
    assert back["jump_m"] == pytest.approx(0.0, abs=0.01)


def test_module_that_could_not_be_activated_has_no_seam():
    run = switched_run(decided_at=110)
    at_ns = int(stamps(200)[100])
    failed = happened("decision", at_ns, scene="Dark", from_="rgbd", to="laser", reason="scene")
    run = replace(run, events=[*run.events[:3], failed, *run.events[3:]])
    first, second = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert (first["jump_m"], first["gap_s"]) == (None, None)
    assert (second["gap_s"], second["jump_m"] < 0.01) == (0.0, True)


def began_anew() -> RunResult:
    """`rgbd` is lost from pose 60 on, and begins anew at 80 with what it saw from pose 65 on."""
    run = relabel(switched_run(), slice(0, 200), "rgbd")
    at_ns, from_ns = (int(stamps(200)[index]) for index in (80, 65))
    lost = {"scene": "Bright", "from_": "rgbd", "to": "rgbd", "reason": "lost"}
    told = [
        happened("decision", at_ns, **lost),
        happened("handover", at_ns, module="rgbd", kind="rewind", from_ns=from_ns, jump_m=0.0),
    ]
    run = replace(run, events=[*first_events(), *told])
    run = shift_from(run, 65, se3.from_xy_yaw(0.3, 0.0, 0.0))
    return without(run, slice(60, 65))


def test_seam_of_a_module_that_begins_anew_lies_where_its_new_poses_begin():
    metrics = evaluate(began_anew(), true_loop(), settings=SETTINGS)
    (switch,) = metrics["switches"]
    assert switch["jump_m"] == pytest.approx(0.3, abs=0.005)
    assert switch["gap_s"] == pytest.approx(0.5)
    assert "“rgbd” began anew, because “rgbd” had lost track" in " ".join(tell(metrics))
    assert any("rgbd began anew (lost: " in line for line in summary_lines(metrics))
    entries = chronicle(began_anew(), metrics["switches"], value_label="mean of grey")
    assert entries[-1].what == "“rgbd” begins anew"


def test_what_a_module_lacked_is_not_said_where_it_was_not_kept():
    run = relabel(switched_run(), slice(90, 100), "")
    lacked = {int(stamp_ns): "a depth image" for stamp_ns in stamps(200)[90:100]}
    told = [
        evaluate(replace(run, missing=missing), None, settings=SETTINGS)["bridged_why"]
        for missing in (lacked, None)
    ]
    assert told == [{"without a depth image": 10}, {"for a reason that was not kept": 10}]
