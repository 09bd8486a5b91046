"""The experiment `faults`: what it calls a recovery, and damage that it finds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from configured import config

from sceneslam.app import run
from sceneslam.experiments.faults.experiment import FaultsExperiment
from sceneslam.experiments.faults.survival import survival
from sceneslam.experiments.faults.torn import torn_files
from sceneslam.experiments.faults.witness import TOLD
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import TrialResult
from sceneslam.types.trajectory import Trajectory

FAULTS = ["raise", "kill", "nan", "hang"]
SETTINGS = {
    "struck": ["slam.bright", "slam.dark"],
    "seed": 5,
    "right_m": 0.5,
    "faults_min": 3,
    "availability_min": 0.999,
    "recovery_max_s": 30.0,
    "cut_offs": {"kill": 3, "broken pipe": 1},
    "cut_off_observations": 60,
    "lost_max_s": 1.0,
}


def faulty(trial):
    """Return the configuration of a trial: both modules are struck."""
    module = {
        "_target_": "sceneslam.modules.slam.faulty.FaultyModule",
        "module": {"_target_": "fakes.ExactModule"},
        "faults": FAULTS,
        "rate_ratio": 0.1,
        "lasting_s": 0.5,
        "jump_m": 2.0,
    }
    struck = trial.values["slam"]
    return config(
        slam__bright=module | struck["bright"],
        slam__dark=module | struck["dark"],
        policy__handover="rewind",
        run__isolation="process",
        run__step_deadline_s=0.5,
        run__restarts_max=100,
        run__restart_backoff_s=0.0,
        sinks={"witness": {"_target_": "sceneslam.experiments.faults.witness.Witness"}},
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Give the verdict of one run, and its folder."""
    folder = tmp_path_factory.mktemp("faults")

    def run_trials(trials):
        for trial in trials:
            done = run(faulty(trial), folder / "runs" / trial.name)
            yield TrialResult(
                trial=trial,
                folder=folder / "runs" / trial.name,
                metrics=done.metrics,
                trajectory=done.trajectory,
                online=done.trajectory,
                faults=done.faults,
            )

    return FaultsExperiment(runs=1, **SETTINGS).run(run_trials, folder), folder / "runs" / "run_000"


def test_a_run_with_faults_in_processes_costs_no_pose_and_tears_no_file(found):
    verdict, _ = found
    assert [figure for figure in verdict.figures if not figure.holds] == []
    assert {figure.name for figure in verdict.figures} >= {"bus deaths", "pose availability"}
    cut_off = {"program: kill", "program: broken pipe"}
    assert cut_off <= {row[0] for row in verdict.table.rows} <= {*FAULTS, *cut_off}


def survived(folder):
    return survival("run", folder, records(folder), right_m=0.5)


def records(folder):
    return sorted(folder.glob("faults_*.jsonl"))


def test_every_strike_in_the_record_is_judged(found):
    _, folder = found
    lines = [line for path in records(folder) for line in path.read_text().splitlines()]
    strikes = survived(folder).strikes
    assert [strike.kind for strike in strikes] == [json.loads(line)["kind"] for line in lines]
    assert all(0 <= strike.recovery_s < 30.0 for strike in strikes)
    assert all(0 < strike.clock_s < 30.0 for strike in strikes)


def test_a_finished_trial_that_is_kept_keeps_its_record(found):
    verdict, folder = found

    def keep(trials):
        for trial in trials:
            whole = Trajectory.read_tum(folder / "trajectory.tum")
            parts = {"metrics": {}, "trajectory": whole, "online": whole, "faults": ()}
            yield TrialResult(trial=trial, folder=folder, **parts)

    kept = FaultsExperiment(runs=1, **{**SETTINGS, "cut_offs": {}}).run(keep, folder.parents[1])
    assert kept.figures[0] == verdict.figures[0] and kept.figures[0].value > 0


def test_poses_that_stay_wrong_are_no_recovery(found, tmp_path):
    _, folder = found
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    told = dict(np.load(folder / TOLD))
    first = json.loads(records(folder)[0].read_text().splitlines()[0])
    told["positions_m"][told["stamps_ns"] >= first["stamp_ns"]] += 2.0
    (tmp_path / TOLD).unlink()
    np.savez(tmp_path / TOLD, **told)
    assert survived(tmp_path).strikes[0].recovery_s == np.inf


@pytest.mark.parametrize(
    ("name", "torn"),
    [
        ("trajectory.tum", lambda content: content[:-5]),
        ("events.jsonl", lambda content: content[: content.index(b'"vote"', 3000) - 30]),
        ("map/points.ply", lambda content: content.replace(b"vertex 0", b"vertex 9")),
    ],
)
def test_a_torn_file_is_damage(found, tmp_path, name, torn):
    _, folder = found
    assert survived(folder).damage == []
    (tmp_path / "map").mkdir()
    for path in [*folder.glob("*.*"), *(folder / "map").iterdir()]:
        (tmp_path / path.relative_to(folder)).write_bytes(path.read_bytes())
    (tmp_path / name).write_bytes(torn((folder / name).read_bytes()))
    (what,) = survived(tmp_path).damage
    assert what.startswith(name.removeprefix("map/"))


def test_no_runs_are_refused():
    with pytest.raises(ConfigError, match="runs"):
        FaultsExperiment(runs=0, **SETTINGS)


def test_files_that_are_cut_off_are_torn_and_foreign_ones_are_not(tmp_path):
    (tmp_path / "trajectory.tum").write_text("# stamp\n1.0 0.0 0")
    (tmp_path / "metrics.json").write_text('{"a": ')
    (tmp_path / "run.mcap").write_bytes(b"\x89MCAP0\r\nhalf")
    (tmp_path / "map.png").write_bytes(b"\x89PNG half")
    (tmp_path / "notes.txt").write_text("notes.txt")
    (tmp_path / "run.rrd.part").write_bytes(b"half")
    assert torn_files(tmp_path) == ("map.png", "metrics.json", "run.mcap", "trajectory.tum")


def test_cut_offs_of_an_unknown_kind_are_refused():
    with pytest.raises(ConfigError, match=r"cut_offs\.meteorite"):
        FaultsExperiment(runs=1, **{**SETTINGS, "cut_offs": {"meteorite": 1}})
