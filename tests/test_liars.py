"""The experiment `liars`: who drives what with which wheels, and what is promised of it."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from sceneslam.evaluation.verdict import write_verdict
from sceneslam.experiments.liars.experiment import LiarsExperiment
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import TrialResult
from sceneslam.types.trajectory import Trajectory

SETTINGS = {
    "logs": {},
    "log_observations": None,
    "stories": ["flicker"],
    "alone": ["rgbd"],
    "lies": {"reversed": {"lie": "reversed"}, "absent": {"lie": "absent"}},
    "story_every_s": 12.0,
    "laser_ratio_max": 1.5,
    "absent_max_m": {"intel": 0.05},
    "moved_max_m": 0.002,
    "moved_ratio_max": 1.1,
    "correct_min": 1.0,
}
RELATION = "1.0 2.0 1.0 0.0 0.0 0.0 0.0 0.0\n"


def found(errors_m, **settings):
    """Return the verdict where a run's error is found by its name, and the trials."""
    trials = []

    def run_trials(asked):
        for trial in asked:
            trials.append(trial)
            error_m = errors_m[trial.name]
            metrics = {"ate_rmse_m": error_m, "correct_rate": 1.0}
            yield TrialResult(
                trial=trial,
                folder=Path(),
                metrics=metrics,
                trajectory=straight(error_m),
                online=Trajectory.empty(),
                faults=(),
            )

    verdict = LiarsExperiment(**{**SETTINGS, **settings}).run(run_trials, Path())
    return verdict, trials


def straight(error_m):
    if math.isnan(error_m):
        return Trajectory.empty()
    T_world_base = np.stack([np.eye(4), np.eye(4)])
    T_world_base[1, 0, 3] = 1.0 + error_m
    return Trajectory(stamps_ns=np.array([10**9, 2 * 10**9]), T_world_base=T_world_base)


def story(rgbd_m):
    """Return the errors of the runs of a story, those of rgbd by its wheels."""
    switched = {f"flicker/switched/{lie}": 0.01 for lie in ("none", "reversed", "absent")}
    alone = zip(("none", "reversed", "absent"), rgbd_m, strict=True)
    return switched | {f"flicker/rgbd/{lie}": error_m for lie, error_m in alone}


def test_module_that_needs_no_wheels_is_not_moved_by_them():
    assert found(story([0.010, 0.012, 0.011]))[0].holds
    verdict, _ = found(story([0.010, 0.014, 0.011]))
    (broken,) = [figure for figure in verdict.figures if not figure.holds]
    assert broken.name == "flicker, rgbd, reversed: ATE"


def test_laser_is_held_to_its_error_with_honest_wheels(tmp_path):
    relations = tmp_path / "some.relations"
    relations.write_text(RELATION)
    logs = {"intel": {"log": "some.clf", "relations": str(relations)}}
    names = ("none", "reversed", "absent")
    for errors_m, holds in (([0.02, 0.029, 0.049], True), ([0.02, 0.031, 0.049], False)):
        given = {f"intel/laser/{lie}": m for lie, m in zip(names, errors_m, strict=True)}
        verdict, trials = found(given, logs=logs, stories=[])
        assert verdict.holds is holds
    assert "source.path=some.clf" in trials[0].overrides
    assert trials[1].values == {"effects": {"lie": "reversed"}}
    assert verdict.table.rows[1] == ["reversed", "0.0310 (100.0%)"]


@pytest.mark.parametrize("poses", ["none", "others"])
def test_laser_without_a_pose_breaks_its_promise(tmp_path, poses):
    relations = tmp_path / "some.relations"
    relations.write_text(RELATION if poses == "none" else "50 60 0 0 0 0 0 0\n")
    error_m = math.nan if poses == "none" else 0.0
    given = {"intel/laser/none": error_m, "intel/laser/reversed": error_m}
    logs = {"intel": {"log": "some.clf", "relations": str(relations)}}
    lies = {"reversed": {"lie": "reversed"}}
    verdict, _ = found(given, logs=logs, stories=[], lies=lies)
    assert not verdict.holds and verdict.table.rows[1] == ["reversed", "-"]
    write_verdict(tmp_path, "liars", verdict)
    (figure,) = json.loads((tmp_path / "verdict.json").read_text())["figures"]
    assert figure["value"] is None and not figure["holds"]


def test_nothing_to_drive_is_named():
    with pytest.raises(ConfigError, match="logs_and_stories"):
        LiarsExperiment(**{**SETTINGS, "stories": []})
