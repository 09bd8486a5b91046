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
    happened,
    loop,
    part_of,
    poseless_run,
    shaken,
    stamps,
    switched_run,
    true_loop,
    without,
)
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.association import interpolated, select
from sceneslam.evaluation.metrics import coverage, evaluate, write_metrics
from sceneslam.evaluation.report.story import tell
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.results import Results
from sceneslam.types.errors import ConfigError
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

KEYS = {
    "ate_rmse_m",
    "ate_max_m",
    "rpe_trans_m",
    "rpe_rot_rad",
    "rpe_interval_s",
    "ate_rot_rad",
    "segment_trans_m",
    "segment_rot_rad",
    "length_ratio",
    "coverage",
    "correct_rate",
    "switches",
    "false_switches",
    "realtime_factor",
    "bus_overhead_us",
    "detector_us",
    "modules",
    "peak_rss_mb",
    "bridged",
    "missing_why",
    "observations",
    "duration_s",
    "path_length_m",
    "dropped",
    "faults",
}
SWITCH_KEYS = {
    "stamp_ns",
    "decided_ns",
    "scene",
    "from",
    "to",
    "reason",
    "confirm_delay_s",
    "gap_s",
    "jump_m",
    "jump_rad",
    "jump_is_error",
    "cost_ms",
    "first_pose_ms",
    "catch_up_s",
}
TRUTH_KEYS = (
    "ate_rmse_m",
    "ate_max_m",
    "rpe_trans_m",
    "rpe_rot_rad",
    "ate_rot_rad",
    "segment_trans_m",
    "length_ratio",
    "correct_rate",
    "false_switches",
)


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


def test_truth_of_another_time_gives_null_and_a_sentence():
    late = GroundTruth(trajectory=loop(200, START_NS + 10**12))
    metrics = evaluate(switched_run(), late, settings=SETTINGS)
    assert metrics["ate_rmse_m"] is None
    assert metrics["correct_rate"] is None
    assert "no pose could be held against the ground truth" in metrics["notes"][0]


@pytest.mark.parametrize("count", [2, 4, 30])
@pytest.mark.parametrize("offset_ns", [0, 1, 37_000_000, PERIOD_NS - 1])
def test_correct_rate_of_a_right_run_is_one_whatever_the_stamps_of_the_truth(count, offset_ns):
    run = part_of(switched_run(), slice(50, 50 + count))
    finely = interpolated(loop(200), stamps(199, START_NS + offset_ns))
    metrics = evaluate(run, GroundTruth(trajectory=finely), settings=SETTINGS)
    assert metrics["correct_rate"] == 1.0


def test_correct_rate_asks_for_nothing_before_or_after_the_truth():
    truth = GroundTruth(trajectory=interpolated(loop(200), stamps(80, START_NS + 5_037_000_000)))
    assert evaluate(switched_run(), truth, settings=SETTINGS)["correct_rate"] == 1.0


def test_correct_rate_is_not_lowered_where_truth_or_observations_pause():
    run = part_of(switched_run(), np.r_[0:150, 180:200])
    truth = GroundTruth(trajectory=select(loop(200), np.r_[0:40, 80:200]))
    assert evaluate(run, truth, settings=SETTINGS)["correct_rate"] == 1.0


def test_correct_rate_counts_the_observations_without_a_pose():
    run = without(without(switched_run(), slice(100, 150)), slice(0, 50))
    rate = evaluate(run, true_loop(), settings=SETTINGS)["correct_rate"]
    assert rate == pytest.approx((4.9 + 1.0 + 4.9) / 19.9, abs=1e-9)


def test_pose_before_the_first_true_pose_is_held_against_it():
    run = part_of(switched_run(), slice(100, 200))
    early = interpolated(loop(200), stamps(199, START_NS + PERIOD_NS - 4_000_000))
    truth = GroundTruth(trajectory=early)
    assert evaluate(run, truth, settings=SETTINGS)["truth_matched"] == 100


def test_error_of_the_saved_truth_is_that_of_the_metrics(tmp_path):
    def at(count, rate_hz):
        stamps_ns = START_NS + np.round(np.arange(count) / rate_hz * 1e9).astype(np.int64)
        return interpolated(loop(1300), stamps_ns)

    estimate = shaken(at(300, 30), 0.02)
    run = replace(switched_run(300), trajectory=estimate, observed_ns=estimate.stamps_ns)
    results = Results(
        folder=tmp_path,
        config={},
        versions={},
        title="",
        evaluation=replace(SETTINGS, association_gap_s=0.02),
        has_report=False,
        value_label="",
        faults=[],
        source=None,
    )
    metrics = results.save_rest(run, GroundTruth(trajectory=at(2500, 20)))
    saved = Trajectory.read_tum(tmp_path / "groundtruth.tum")
    assert saved.stamps_ns[-1] - START_NS < 10.1e9
    assert absolute_errors(estimate, saved, 0.02).rmse_m == pytest.approx(metrics["ate_rmse_m"])


def test_longer_truth_does_not_lower_the_correct_rate():
    first = part_of(switched_run(), slice(0, 100))
    assert evaluate(first, true_loop(), settings=SETTINGS)["correct_rate"] == 1.0


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
    run = replace(part_of(switched_run(), slice(0, 1)), events=switched_run().events[:4])
    metrics = evaluate(run, true_loop(), settings=SETTINGS)
    assert metrics["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["rpe_trans_m"] is None
    assert metrics["coverage"] == 1.0


def test_what_live_mode_did_not_take_and_what_failed_is_in_the_metrics():
    events = [happened("fault", START_NS, what="kiss_icp failed: bad cloud")]
    metrics = evaluate(replace(switched_run(), dropped=7, events=events), None, settings=SETTINGS)
    assert metrics["dropped"] == 7
    assert metrics["faults"] == ["kiss_icp failed: bad cloud"]


def test_metrics_of_the_same_run_are_the_same():
    first = evaluate(switched_run(), true_loop(), settings=SETTINGS)
    assert first == evaluate(switched_run(), true_loop(), settings=SETTINGS)


def default_settings():
    path = Path(__file__).parents[1] / "conf" / "evaluation" / "default.yaml"
    arguments = yaml.safe_load(path.read_text())
    assert arguments.pop("_target_") == "sceneslam.evaluation.settings.EvaluationSettings"
    return arguments


@pytest.mark.parametrize("key", ["correct_limit_m", "correct_limit_ratio"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_settings_out_of_range_are_named(key, value):
    with pytest.raises(ConfigError, match=f"{key}: got"):
        EvaluationSettings(**default_settings() | {key: value})


def test_only_a_share_may_be_zero():
    assert EvaluationSettings(**default_settings() | {"correct_limit_ratio": 0.0})
    with pytest.raises(ConfigError, match="correct_limit_m: got"):
        EvaluationSettings(**default_settings() | {"correct_limit_m": 0.0})


def test_default_settings_are_valid():
    arguments = default_settings()
    assert EvaluationSettings(**arguments).association_gap_s == 0.01
