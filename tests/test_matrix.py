"""The experiment `matrix`: its oracle, its promises, and its sweep of the detector."""

import json
from dataclasses import replace

import numpy as np
import pytest
from told_runs import Told, teller

from sceneslam.evaluation.accuracy import root_mean_square
from sceneslam.evaluation.path import segment_errors
from sceneslam.experiments.matrix.cell import Cell, regret_of
from sceneslam.experiments.matrix.experiment import MatrixExperiment
from sceneslam.experiments.matrix.oracle import best_of
from sceneslam.experiments.matrix.promises import Promises
from sceneslam.experiments.matrix.sweep import Grid, sweep
from sceneslam.experiments.tour_zones import _error_m
from sceneslam.types import se3
from sceneslam.types.experiment import Trial, TrialResult
from sceneslam.types.trajectory import Trajectory

RATE_HZ = 5
NAN = float("nan")


def driven(speeds_m_s, y_m=0.0):
    """Return a drive along x at RATE_HZ, one speed per second; NaN: no pose in that second."""
    steps = np.repeat(np.array(speeds_m_s, float), RATE_HZ) / RATE_HZ
    x_m = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps))])
    known = np.concatenate([[True], ~np.isnan(steps)])
    stamps_ns = np.arange(len(x_m)) * (10**9 // RATE_HZ)
    poses = np.stack([se3.from_xy_yaw(x, y_m, 0.0) for x in x_m])
    return Trajectory(stamps_ns=stamps_ns[known], T_world_base=poses[known])


def at_seconds(trajectory):
    """Return x at every whole second."""
    return trajectory.positions_m[:: round(1e9 / np.diff(trajectory.stamps_ns[:2])[0]), 0]


def test_oracle_takes_each_piece_from_the_module_that_errs_least():
    truth = driven([1.0, 1.0, 1.0])
    oracle = best_of([driven([1.0, 1.5, 1.2]), driven([1.3, 1.1, 1.0])], truth, 1.0, 1.0)
    np.testing.assert_allclose(np.diff(at_seconds(oracle)), [1.0, 1.1, 1.0])


def test_oracle_knows_which_errors_cancel_over_a_segment():
    truth = driven(np.ones(8))
    fast, slow = driven(np.full(8, 1.1)), driven(np.full(8, 0.88))
    oracle = best_of([fast, slow], truth, 1.0, 2.0)
    assert segment_m(oracle, truth, 2.0) < 0.06  # piece by piece: 0.2


def test_oracle_knows_the_path_where_no_module_does():
    truth = driven([1.0, 1.0, 1.0, 1.0])
    oracle = best_of([driven([1.1, NAN, NAN, 1.0])], truth, 1.0, 1.0)
    np.testing.assert_allclose(at_seconds(oracle), [0.0, 1.1, 2.1, 3.1, 4.1])


def test_oracle_is_no_worse_than_any_module_alone_however_long_the_pieces():
    rng = np.random.default_rng(0)
    truth = driven(np.ones(12))
    modules = [driven(1.0 + rng.normal(0, 0.1, 12)) for _ in range(3)]
    for piece_s in (0.6, 3.0, 100.0):
        error_m = segment_m(best_of(modules, truth, piece_s, 2.0), truth, 2.0)
        assert all(error_m <= segment_m(one, truth, 2.0) + 1e-3 for one in modules), piece_s


def test_a_drive_through_a_zone_has_no_error_without_a_pose_at_its_doors():
    truth, estimate = driven(np.ones(6)), driven([1.1, 1.1, NAN, NAN, 1.1, 1.1])
    ends_ns = 10**9 * np.array([[0, 1], [1, 3], [3, 5], [1, 5]])
    errors_m = [_error_m(estimate, truth, ends) for ends in ends_ns]
    np.testing.assert_allclose(errors_m, [0.1, NAN, NAN, 1.8], atol=1e-9)


def segment_m(estimate, truth, length_m):
    return root_mean_square(segment_errors(estimate, truth, 0.02, length_m).trans_m)


def cell(strategy, **values):
    numbers = {
        "coverage": 1.0,
        "correct_rate": 1.0,
        "segment_m": 0.1,
        "ate_m": 0.1,
        "ate_rot_rad": 0.01,
        "length_ratio": 1.0,
        "switches": 2.0,
        "false_switches": 0.0,
        "regret": 0.1,
    }
    return Cell(story="tour", seed=0, strategy=strategy, **numbers | values)


@pytest.mark.parametrize(
    ("ours", "alone", "failed"),
    [
        ({}, {}, []),
        ({"correct_rate": 0.98}, {}, ["tour: Correct Rate, rewind"]),
        ({}, {"correct_rate": 0.81}, ["tour: Correct Rate, bright alone"]),
        ({"regret": 0.3}, {}, ["rewind: regret over all stories"]),
        ({}, {"regret": -0.01}, ["least regret of any strategy, any seed"]),
        ({}, {"regret": -0.01, "coverage": 0.5}, []),
        ({"false_switches": 1.0}, {}, ["rewind: false switches, any seed"]),
        ({"regret": NAN}, {}, ["rewind: regret over all stories"]),
    ],
)
def test_a_promise_fails_when_it_is_broken(ours, alone, failed):
    promises = Promises(
        judged="rewind", regret_max=0.25, correct_min=0.99, alone_correct_max=0.8, false_max=0.0
    )
    cells = [cell("bright alone", **{"correct_rate": 0.5} | alone), cell("rewind", **ours)]
    figures = list(promises.figures(cells, ["bright alone"]))
    assert [figure.name for figure in figures if not figure.holds] == failed


def test_false_switches_that_are_unknown_at_one_seed_break_their_promise():
    promises = Promises(judged="rewind", regret_max=0.25, false_max=0.0)
    known = cell("rewind")
    cells = [cell("alone"), known, replace(known, seed=1, false_switches=NAN)]
    figures = list(promises.figures(cells, ["alone"]))
    assert not figures[-1].holds and figures[-1].name == "rewind: false switches, any seed"


def test_regret_is_of_the_errors_of_all_stories_together():
    small, large = (
        replace(cell("rewind", segment_m=error_m, regret=regret), story=story)
        for story, error_m, regret in (("a", 0.001, -0.5), ("b", 0.1, 0.25))
    )
    assert regret_of([small, large]) == pytest.approx(0.101 / 0.082 - 1.0)
    promises = Promises(judged="rewind", regret_max=0.25)
    alone = replace(cell("alone"), story="a"), replace(cell("alone"), story="b")
    figures = list(promises.figures([small, large, *alone], ["alone"]))
    assert all(figure.holds for figure in figures)


def test_every_strategy_is_run_with_every_seed_and_lies_in_the_table(tmp_path):
    asked = {}

    def tell(trial):
        asked[trial.name] = trial
        speed_m_s = {"a_alone": 1.02, "b_alone": 1.05}.get(trial.name.split("/")[1], 1.03)
        rate = 1.0 if "rewind" in trial.name else 0.5
        metrics = {
            "ate_rmse_m": speed_m_s - 1.0,
            "ate_rot_rad": 0.0,
            "segment_trans_m": 0.1,
            "length_ratio": speed_m_s,
            "correct_rate": rate,
            "coverage": 1.0,
            "switches": [],
            "false_switches": 0,
            "observations": 10 if trial.name == "tour/b_alone/1" else 30,  # it ended early
        }
        return Told(metrics=metrics, trajectory=driven([speed_m_s] * 3), truth=driven([1.0] * 3))

    experiment = MatrixExperiment(
        stories=["tour"],
        seeds=[0, 1],
        modules=["a", "b"],
        scenes={"Bright": ["a", "b"], "Dark": ["b", "a"]},
        alone=["policy.gate=null"],
        strategies={"rewind": ["policy.handover=rewind"]},
        piece_s=1.0,
        correct_limits={"limit_m": 0.25, "limit_rad": 0.17, "limit_ratio": 0.01},
        segment_m=1.0,
        promises={"judged": "rewind", "regret_max": 10.0},
        votes=None,
    )
    verdict = experiment.run(teller(tmp_path / "runs", tell), tmp_path)
    assert len(asked) == 6 and verdict.holds
    alone = asked["tour/b_alone/1"]
    table = "scenes={Bright: [b], Dark: [b]}"
    assert alone.overrides == ("story=tour", "seed=1", "policy.gate=null", table)
    assert [row[1] for row in verdict.table.rows] == ["a alone", "b alone", "rewind", "oracle"]
    assert verdict.table.rows[2][3] == "100.0 ± 0.0"
    assert verdict.table.rows[1][2:4] == ("66.7 ± 47.1", "33.3 ± 23.6")  # sample deviations
    assert len((tmp_path / "cells.csv").read_text().splitlines()) == 9
    assert (tmp_path / "paths.png").stat().st_size > 5000


def outcome_of(folder, greys):
    events = [
        {"event": "vote", "stamp_ns": number * 10**8, "scene": "-", "value": grey}
        for number, grey in enumerate(greys)
    ]
    folder.mkdir(parents=True)
    (folder / "events.jsonl").write_text("".join(json.dumps(one) + "\n" for one in events))
    return TrialResult(
        trial=Trial(name="dusk/rewind/0"),
        folder=folder,
        metrics={},
        trajectory=Trajectory.empty(),
        online=Trajectory.empty(),
        faults=(),
    )


@pytest.mark.parametrize(
    ("threshold", "hysteresis", "window_s", "changes"),
    [(100.0, 0.0, 0.0, 5), (100.0, 10.0, 0.0, 1), (100.0, 0.0, 0.3, 1), (50.0, 0.0, 0.0, 1)],
)
def test_hysteresis_and_window_each_hold_back_changes_about_the_threshold(
    tmp_path, threshold, hysteresis, window_s, changes
):
    greys = [105, 95, None, 104, 96, 103, 97, 20, 20, 20, 20, 20]
    grid = Grid(thresholds=[threshold], hystereses=[hysteresis], windows_s=[window_s])
    (found,) = sweep([outcome_of(tmp_path / "run", greys)], grid)
    assert (found.story, found.changes) == ("dusk", changes)
