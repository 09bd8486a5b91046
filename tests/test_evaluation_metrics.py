import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from evaluation_runs import (
    PERIOD_NS,
    SETTINGS,
    START_NS,
    loop,
    poseless_run,
    stamps,
    switch_events,
    switched_run,
    true_loop,
)
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.evaluation.association import select
from sceneslam.evaluation.metrics import coverage, evaluate, write_metrics
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.evaluation.story import tell
from sceneslam.evaluation.summary import summary_lines
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange

KEYS = {
    "ate_rmse_m", "ate_max_m", "rpe_trans_m", "rpe_rot_rad", "coverage", "correct_rate",
    "switches", "false_switches", "realtime_factor", "bus_overhead_us", "detector_us",
    "modules", "peak_rss_mb", "bridged", "observations", "duration_s", "path_length_m",
}  # fmt: skip
SWITCH_KEYS = {
    "stamp_ns", "scene", "from", "to", "reason", "confirm_delay_s", "gap_s", "jump_m",
    "jump_rad", "cost_ms",
}  # fmt: skip
TRUTH_KEYS = (
    "ate_rmse_m", "ate_max_m", "rpe_trans_m", "rpe_rot_rad", "correct_rate", "false_switches",
)  # fmt: skip


def relabel(run: RunResult, index: slice, module: str) -> RunResult:
    modules = list(run.modules)
    modules[index] = [module] * len(modules[index])
    return replace(run, modules=modules)


def shift_from(run: RunResult, index: int, T_map_map: np.ndarray) -> RunResult:
    """Move all poses from `index` on, as a bad hand-over does."""
    T_world_base = run.trajectory.T_world_base.copy()
    T_world_base[index:] = T_map_map @ T_world_base[index:]
    trajectory = Trajectory(stamps_ns=run.trajectory.stamps_ns, T_world_base=T_world_base)
    return replace(run, trajectory=trajectory)


def without(run: RunResult, gone: slice) -> RunResult:
    kept = np.delete(np.arange(len(run.trajectory)), gone)
    modules = [run.modules[k] for k in kept]
    return replace(run, trajectory=select(run.trajectory, kept), modules=modules)


def test_metrics_have_every_key_and_are_plain_json(tmp_path):
    metrics = evaluate(switched_run(), true_loop(), settings=SETTINGS, peak_rss_mb=321.0)
    assert metrics.keys() >= KEYS
    assert metrics["switches"][0].keys() == SWITCH_KEYS
    assert metrics["modules"]["laser"].keys() == {"frame_ms", "poses", "share"}
    write_metrics(tmp_path / "metrics.json", metrics)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics


def test_metrics_of_a_good_run_are_good():
    metrics = evaluate(switched_run(), true_loop(), settings=SETTINGS)
    assert metrics["ate_rmse_m"] == pytest.approx(0.0017, abs=0.0003)  # sqrt(3) * 1 mm
    assert metrics["correct_rate"] == 1.0
    assert metrics["coverage"] == 1.0
    assert metrics["duration_s"] == pytest.approx(19.9)
    assert metrics["realtime_factor"] == pytest.approx(19.9 / 8.0)
    assert metrics["modules"]["rgbd"]["frame_ms"] == {"median": 20.0, "p95": 29.0}
    assert metrics["modules"]["laser"]["share"] == 0.5
    assert metrics["notes"] == []


def test_without_truth_its_metrics_are_null_and_not_absent():
    metrics = evaluate(switched_run(), None, settings=SETTINGS)
    assert metrics.keys() >= KEYS
    assert [metrics[key] for key in TRUTH_KEYS] == [None] * len(TRUTH_KEYS)
    assert metrics["switches"][0]["confirm_delay_s"] is None


def test_without_truth_the_jump_is_what_the_handover_measured():
    (switch,) = evaluate(switched_run(), None, settings=SETTINGS)["switches"]
    assert (switch["jump_m"], switch["jump_rad"], switch["cost_ms"]) == (0.5, 0.25, 3.5)
    assert switch["gap_s"] == 0.0


def test_truth_of_another_time_gives_null_and_a_sentence():
    late = GroundTruth(trajectory=loop(200, START_NS + 10**12))
    metrics = evaluate(switched_run(), late, settings=SETTINGS)
    assert metrics["ate_rmse_m"] is None
    assert metrics["correct_rate"] is None
    assert "no pose could be held against the ground truth" in metrics["notes"][0]


def test_longer_truth_does_not_lower_the_correct_rate():
    run = switched_run()
    first = without(replace(run, observed_ns=run.observed_ns[:100]), slice(100, 200))
    assert evaluate(first, true_loop(), settings=SETTINGS)["correct_rate"] == 1.0


def test_jump_is_the_error_of_the_motion_across_the_seam():
    run = shift_from(switched_run(), 100, se3.from_xy_yaw(0.3, 0.0, 0.0))
    (switch,) = evaluate(run, true_loop(), settings=SETTINGS)["switches"]
    assert switch["jump_m"] == pytest.approx(0.3, abs=0.005)
    assert switch["jump_rad"] == pytest.approx(0.0, abs=1e-6)


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
    assert (switch["jump_m"], switch["gap_s"]) == (0.5, 0.75)  # the hand-over's own


def test_difference_from_a_reference_is_reported():
    reference = loop(200)
    metrics = evaluate(switched_run(), None, settings=SETTINGS, reference=reference)
    assert metrics["reference"]["matched"] == 200
    assert 0.001 < metrics["reference"]["rms_difference_m"] < 0.003
    assert metrics["reference"]["max_difference_m"] < 0.006


@given(st.lists(st.booleans(), max_size=40))
def test_coverage_is_the_share_after_the_first_pose(got_pose):
    trajectory = select(loop(len(got_pose)), np.flatnonzero(got_pose))
    run = replace(poseless_run(len(got_pose)), trajectory=trajectory)
    value = coverage(run)
    if not got_pose:
        assert value is None
    elif not any(got_pose):
        assert value == 0.0
    else:
        after_first = got_pose[got_pose.index(True) :]
        assert value == pytest.approx(sum(after_first) / len(after_first))


@pytest.mark.parametrize("observed", [0, 1, 30])
@pytest.mark.parametrize("truth", [None, true_loop(), GroundTruth()])
def test_run_without_poses_still_has_metrics_and_a_summary(tmp_path, observed, truth):
    metrics = evaluate(poseless_run(observed), truth, settings=SETTINGS)
    write_metrics(tmp_path / "metrics.json", metrics)
    assert metrics["ate_rmse_m"] is None
    assert metrics["switches"] == []
    assert summary_lines(metrics)
    assert tell(metrics)


def test_run_with_one_pose_has_no_error_and_full_coverage():
    run = without(switched_run(), slice(1, 200))
    run = replace(run, observed_ns=run.observed_ns[:1], events=run.events[:4])
    metrics = evaluate(run, true_loop(), settings=SETTINGS)
    assert metrics["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["rpe_trans_m"] is None
    assert metrics["coverage"] == 1.0


def test_summary_has_at_most_ten_short_lines():
    run = switched_run()
    again = [
        event
        for k in range(110, 190, 5)
        for event in switch_events(START_NS + k * PERIOD_NS, START_NS)
    ]
    run = replace(run, events=[*run.events, *again])
    metrics = evaluate(run, true_loop(), settings=SETTINGS, reference=loop(200))
    lines = summary_lines(metrics)
    assert 5 <= len(lines) <= 10
    assert all(len(line) <= 120 for line in lines)
    assert "10.0 s: rgbd -> laser (scene: Dark), 2.00 s after the change" in lines[2]


def test_metrics_of_the_same_run_are_the_same():
    first = evaluate(switched_run(), true_loop(), settings=SETTINGS)
    assert first == evaluate(switched_run(), true_loop(), settings=SETTINGS)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_settings_out_of_range_are_named(value):
    with pytest.raises(ConfigError, match="correct_limit_m: got"):
        EvaluationSettings(
            association_gap_s=0.01, rpe_interval_s=1, correct_limit_m=value, correct_limit_rad=1
        )


def test_default_settings_are_valid():
    path = Path(__file__).parents[1] / "conf" / "evaluation" / "default.yaml"
    arguments = yaml.safe_load(path.read_text())
    assert arguments.pop("_target_") == "sceneslam.evaluation.settings.EvaluationSettings"
    assert EvaluationSettings(**arguments).association_gap_s == 0.01
