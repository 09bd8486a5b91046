"""The experiment `matrix`: its oracle, and its sweep of the detector."""

import json

import numpy as np
import pytest

from sceneslam.experiments.matrix.oracle import best_of
from sceneslam.experiments.matrix.sweep import Grid, sweep
from sceneslam.types import se3
from sceneslam.types.experiment import Outcome, Trial
from sceneslam.types.trajectory import Trajectory

RATE_HZ = 10


def driven(speeds_m_s):
    """Return a drive along x at RATE_HZ, one speed per second; NaN: no pose in that second."""
    steps = np.repeat(np.array(speeds_m_s, float), RATE_HZ) / RATE_HZ
    x_m = np.concatenate([[0.0], np.cumsum(np.nan_to_num(steps))])
    known = np.concatenate([[True], ~np.isnan(steps)])
    stamps_ns = np.arange(len(x_m)) * (10**9 // RATE_HZ)
    poses = np.stack([se3.from_xy_yaw(x, 0.0, 0.0) for x in x_m])
    return Trajectory(stamps_ns=stamps_ns[known], T_world_base=poses[known])


def test_oracle_takes_each_second_from_the_module_that_errs_least():
    truth = driven([1.0, 1.0, 1.0])
    oracle = best_of([driven([1.0, 1.5, 1.2]), driven([1.3, 1.1, 1.0])], truth)
    assert oracle.stamps_ns.tolist() == [0, 10**9, 2 * 10**9, 3 * 10**9]
    np.testing.assert_allclose(oracle.positions_m[:, 0], [0.0, 1.0, 2.1, 3.1])


def test_oracle_knows_the_way_where_no_module_does():
    truth = driven([1.0, 1.0, 1.0, 1.0])
    oracle = best_of([driven([1.1, float("nan"), float("nan"), 1.0])], truth)
    np.testing.assert_allclose(oracle.positions_m[:, 0], [0.0, 1.1, 2.1, 3.1, 4.1])


def outcome_of(folder, greys):
    events = [
        {"event": "vote", "stamp_ns": number * 10**8, "scene": "-", "value": grey}
        for number, grey in enumerate(greys)
    ]
    folder.mkdir(parents=True)
    (folder / "events.jsonl").write_text("".join(json.dumps(one) + "\n" for one in events))
    return Outcome(
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
