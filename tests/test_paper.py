"""The experiments of the paper, on runs that are made up."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import PERIOD_NS, START_NS, happened, loop, moved, stamps
from scenery import RIG, room_observation
from told_runs import Told, teller

from sceneslam.experiments.paper.alone import AloneExperiment
from sceneslam.experiments.paper.detection import DetectionExperiment
from sceneslam.experiments.paper.difference import DifferenceExperiment
from sceneslam.experiments.paper.startup import StartupExperiment
from sceneslam.experiments.paper.switch import SwitchExperiment
from sceneslam.ros.writer import ObservationWriter
from sceneslam.types import se3

PAGE = Path(__file__).parents[1] / "experiments" / "paper"
DARK_NS, CONFIRMED_NS = START_NS + 30 * PERIOD_NS, START_NS + 50 * PERIOD_NS


def darkening():
    """Return the log of 10 s: grey falls from 130 to 30 after 3 s, confirmed after 5 s."""
    votes = [
        happened("vote", int(ns), scene="Bright", value=130.0 if ns < DARK_NS else 30.0)
        for ns in stamps(100)
    ]
    first = happened("scene", START_NS, scene="Bright", previous=None, since_ns=START_NS)
    dark = happened("scene", CONFIRMED_NS, scene="Dark", previous="Bright", since_ns=DARK_NS)
    return [*votes, first, dark]


def test_detection_tells_when_a_change_was_confirmed_and_what_the_grey_was(tmp_path):
    metrics = {
        "switches": [{"stamp_ns": CONFIRMED_NS, "scene": "Dark", "confirm_delay_s": 2.1}],
        "false_switches": 0,
        "detector_us": {"median": 40.0, "p95": 16_000.0},
    }
    told = Told(metrics=metrics, events=darkening())
    experiment = DetectionExperiment(window_s=2.0, late_max_s=0.3, vote_max_ms=15.0)
    verdict = experiment.run(teller(tmp_path / "runs", lambda trial: told), tmp_path)
    assert verdict.table.rows == [("Bright -> Dark", 3.0, 5.0, 2.1, 130.0, 30.0)]
    assert [figure.holds for figure in verdict.figures] == [True, True, True, False]


def test_a_module_answers_for_the_light_it_is_meant_for_only(tmp_path):
    def tell(trial):
        is_lost = trial.name == "bright/lights_off"
        ate_m = None if is_lost else 0.01
        metrics = {"ate_rmse_m": ate_m, "coverage": 0.0 if is_lost else 1.0, "correct_rate": 1.0}
        return Told(metrics={**metrics, "modules": {}})

    experiment = AloneExperiment(own={"bright": "on", "dark": "off"}, ate_max_m=0.05)
    verdict = experiment.run(teller(tmp_path / "runs", tell), tmp_path)
    assert len(verdict.table.rows) == 4 and verdict.holds
    assert [figure.name for figure in verdict.figures[::2]] == [
        "bright, lights on: coverage",
        "dark, lights off: coverage",
    ]


def switched(*, switches=1, coverage=1.0):
    switch = {"gap_s": 0.0, "jump_m": 0.01}
    return {
        "switches": [switch] * switches,
        "coverage": coverage,
        "ate_rmse_m": 0.01,
        "ate_max_m": 0.02,
    }


def test_the_papers_own_switch_waits_for_its_start_but_ours_has_to_keep_the_bounds(tmp_path):
    asked = []

    def tell(trial):
        asked.append(trial.overrides)
        is_ours = trial.name == "rewind"
        return Told(metrics=switched(coverage=1.0 if is_ours else 0.9))

    def run_trials(trials):
        for outcome in teller(tmp_path / "runs", tell)(trials):
            (outcome.folder / "map").mkdir()
            (outcome.folder / "map" / "points.ply").write_bytes(b"ply\nelement vertex 7\n")
            yield outcome

    experiment = SwitchExperiment(
        handovers=["rewind", "cold"], startup_s={"dark": 1.0}, ate_max_m=0.05
    )
    verdict = experiment.run(run_trials, tmp_path)
    assert verdict.holds and verdict.table.rows[0][-1] == 7.0
    assert asked[0] == ("policy.handover=rewind",)
    assert asked[1] == ("policy.handover=cold", "++policy.startup_s.dark=1.0")


@pytest.mark.parametrize(("offset_m", "holds"), [(0.02, True), (0.04, False)])
def test_difference_is_the_largest_between_the_two_runs(tmp_path, offset_m, holds):
    path = loop(50)
    aside = moved(path, se3.from_parts(np.eye(3), np.array([0.0, offset_m, 0.0])))

    def tell(trial):
        trajectory = aside if trial.name.endswith("unswitched") else path
        return Told(metrics={"ate_rmse_m": 0.01}, trajectory=trajectory)

    experiment = DifferenceExperiment(stories=["one"], lit_module="bright", difference_max_m=0.03)
    verdict = experiment.run(teller(tmp_path / "runs", tell), tmp_path)
    assert verdict.figures[0].value == pytest.approx(offset_m) and verdict.holds is holds
    assert (tmp_path / "difference.png").stat().st_size > 5000


def test_startup_is_timed_in_a_fresh_process_and_switches_by_the_log(tmp_path, monkeypatch):
    monkeypatch.setattr(
        subprocess,
        "run",
        lambda words, **_: subprocess.CompletedProcess(
            words, 0, '{"built_s": 0.1, "first_pose_s": 0.2}\n', ""
        ),
    )
    cost = happened("cost", START_NS, first_pose_ms=20.0, handover_ms=900.0, catch_up_s=2.0)
    switch = {"stamp_ns": START_NS, "from": "bright", "to": "dark"}
    told = Told(metrics={"switches": [switch]}, events=[cost])
    experiment = StartupExperiment(
        modules=["bright"],
        overrides=[],
        repeats=3,
        stories=["night"],
        start_max_s=1.0,
        first_pose_max_s=0.05,
        switch_max_s=0.8,
    )
    verdict = experiment.run(teller(tmp_path / "runs", lambda trial: told), tmp_path)
    assert [figure.value for figure in verdict.figures] == [0.2, 0.02, 0.9]
    assert [figure.holds for figure in verdict.figures] == [True, True, False]


def test_the_start_of_a_module_is_measured(tmp_path):
    writer = ObservationWriter(tmp_path / "room.mcap", rig=RIG, image_format="png")
    for index in range(3):
        writer.write(room_observation(index))
    writer.close()
    command = [sys.executable, "-m", "sceneslam.experiments.paper.ready", "slam.only"]
    overrides = ["+scenario=single", "slam@slam.only=odometry", "source=mcap"]
    done = subprocess.run(
        [*command, *overrides, f"source.path={tmp_path / 'room.mcap'}"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    times = json.loads(done.stdout.splitlines()[-1])
    assert 0.0 < times["built_s"] <= times["first_pose_s"] < 60.0


def test_the_page_holds_what_the_commands_printed():
    page = (PAGE / "README.md").read_text()
    tables = sorted((PAGE / "results").glob("*/table.md"))
    assert len(tables) == 5
    for path in tables:
        assert path.read_text() in page, path
    for path in (PAGE / "results").glob("*/*.png"):
        assert f"({path.relative_to(PAGE)})" in page and path.stat().st_size < 150_000, path
