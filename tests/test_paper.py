"""The experiments of the paper, on runs that are made up."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import PERIOD_NS, START_NS, happened, loop, moved, stamps
from omegaconf import OmegaConf
from ros_recordings import _source_config as make_config
from told_runs import Told, teller

from sceneslam.evaluation.association import select
from sceneslam.experiments.paper import alone, detection
from sceneslam.experiments.paper.alone import AloneExperiment
from sceneslam.experiments.paper.detection import DetectionExperiment
from sceneslam.experiments.paper.difference import DifferenceExperiment
from sceneslam.experiments.paper.images import draw_images, draw_rooms, source_of
from sceneslam.experiments.paper.ordered import OrderedSwitchExperiment
from sceneslam.experiments.paper.startup import StartupExperiment
from sceneslam.experiments.paper.switch import SwitchExperiment
from sceneslam.experiments.paper.views import cloud_of, modules_of, read_ply
from sceneslam.ros.writer import ObservationWriter
from sceneslam.testing.room import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

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


QUIET = {
    "switches": [],
    "false_switches": 0,
    "detection": {"missed": 1},
    "detector_us": {"median": 40.0, "p95": 900.0},
}


def test_detection_tells_when_a_change_was_confirmed_and_what_the_grey_was(tmp_path, monkeypatch):
    metrics = {
        "switches": [{"stamp_ns": CONFIRMED_NS, "scene": "Dark", "confirm_delay_s": 2.1}],
        "false_switches": 0,
        "detection": {"missed": 0},
        "detector_us": {"median": 40.0, "p95": 16_000.0},
    }
    told = Told(metrics=metrics, events=darkening())
    shown = []
    monkeypatch.setattr(detection, "draw_images", lambda path, folder, at: shown.extend(at))
    experiment = DetectionExperiment(
        window_s=2.0, late_max_s=0.3, vote_max_ms=15.0, paper_s=[12.0, 21.0]
    )
    verdict = experiment.run(teller(tmp_path / "runs", lambda trial: told), tmp_path)
    assert verdict.table.rows == [("Bright -> Dark", 3.0, 5.0, 2.1, 130.0, 30.0, 12.0)]
    assert shown == [DARK_NS - 2 * 10**9, CONFIRMED_NS]
    assert [figure.holds for figure in verdict.figures] == [True, True, True, True, False]


def test_without_a_change_there_is_no_picture_of_its_images(tmp_path, monkeypatch):
    monkeypatch.setattr(detection, "draw_images", lambda path, folder, at: pytest.fail("drawn"))
    told = Told(metrics=QUIET, events=darkening()[:-1])
    experiment = DetectionExperiment(
        window_s=2.0, late_max_s=0.3, vote_max_ms=15.0, paper_s=[12.0, 21.0]
    )
    verdict = experiment.run(teller(tmp_path / "runs", lambda trial: told), tmp_path)
    assert verdict.table.rows == [] and list(verdict.pictures) == ["grey_mean.png"]
    assert [figure.name for figure in verdict.figures if not figure.holds] == ["changes missed"]


def test_a_module_answers_for_the_light_it_is_meant_for_only(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(alone, "draw_rooms", lambda path, folder: drawn.append(path.name))

    def tell(trial):
        is_lost = trial.name == "bright/lights_off"
        ate_m = None if is_lost else 0.01
        metrics = {"ate_rmse_m": ate_m, "coverage": 0.0 if is_lost else 1.0, "correct_rate": 1.0}
        return Told(metrics={**metrics, "modules": {}})

    experiment = AloneExperiment(
        own={"bright": "on", "dark": "off"}, ate_max_m={"bright": 0.05, "dark": 0.05}
    )
    verdict = experiment.run(teller(tmp_path / "runs", tell), tmp_path)
    assert len(verdict.table.rows) == 4 and verdict.holds and drawn == ["rooms.png"]
    assert [figure.name for figure in verdict.figures[::2]] == [
        "bright, lights on: coverage",
        "dark, lights off: coverage",
    ]


def switched(*, switches=1, coverage=1.0, is_error=True):
    switch = {"gap_s": 0.0, "jump_m": 0.01, "jump_is_error": is_error}
    return {
        "switches": [switch] * switches,
        "coverage": coverage,
        "ate_rmse_m": 0.01,
        "ate_max_m": 0.02,
    }


# Two points of one module, as our maps are written.
PLY = b"""ply
format binary_little_endian 1.0
comment module 0 bright one
element vertex 2
property float x
property float y
property float z
property uchar module
end_header
""" + np.array([(0, 1, 2, 0), (3, 4, 5, 0)], [(n, "<f4") for n in "xyz"] + [("m", "u1")]).tobytes()


def test_the_papers_own_switch_waits_for_its_start_but_ours_has_to_keep_the_bounds(tmp_path):
    asked = []

    def tell(trial):
        asked.append(trial.overrides)
        is_ours = trial.name == "rewind"
        return Told(metrics=switched(coverage=1.0 if is_ours else 0.9, is_error=is_ours))

    def run_trials(trials):
        for outcome in teller(tmp_path / "runs", tell)(trials):
            (outcome.folder / "map").mkdir()
            (outcome.folder / "map" / "points.ply").write_bytes(PLY)
            yield outcome

    experiment = SwitchExperiment(
        handovers=["rewind", "cold"], startup_s={"dark": 1.0}, ate_max_m=0.05
    )
    verdict = experiment.run(run_trials, tmp_path)
    assert verdict.holds and verdict.table.rows[0][-1] == 2.0
    seam = verdict.table.columns.index("seam [cm]")
    assert verdict.table.rows[0][seam] == 1.0 and np.isnan(verdict.table.rows[1][seam])
    assert asked[0] == ("policy.handover=rewind",)
    assert asked[1] == ("policy.handover=cold", "++policy.startup_s.dark=1.0")


def test_the_points_of_a_map_are_read_with_the_names_of_its_modules(tmp_path):
    (tmp_path / "points.ply").write_bytes(PLY)
    rows = read_ply(tmp_path / "points.ply")
    assert modules_of(tmp_path / "points.ply") == ["bright one"]
    assert cloud_of(rows, "red").points.tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize(
    ("before_m", "after_m", "failed"),
    [
        (0.0, 0.01, []),
        (0.0, 0.03, ["rewind: apart at most"]),
        (0.001, 0.01, ["rewind: apart before the switch"]),
    ],
)
def test_an_ordered_switch_changes_nothing_before_it_and_little_after(
    tmp_path, before_m, after_m, failed
):
    path = loop(100)
    T_world_base = path.T_world_base.copy()
    T_world_base[:50, 1, 3] += before_m
    T_world_base[50:, 1, 3] += after_m
    aside = Trajectory(stamps_ns=path.stamps_ns, T_world_base=T_world_base)
    asked = {}

    def tell(trial):
        asked[trial.name] = trial.values
        trajectory = path if trial.name == "unswitched" else aside
        metrics = {"ate_rmse_m": 0.01, "ate_max_m": 0.02, "association_gap_s": 0.01}
        return Told(metrics=metrics, trajectory=trajectory, truth=path)

    experiment = OrderedSwitchExperiment(
        at_s=5.0,
        scenes=["Bright", "Dark"],
        switched={"rewind": {"policy": {"handover": "rewind"}}},
        judged="rewind",
        difference_max_m=0.02,
    )
    verdict = experiment.run(teller(tmp_path / "runs", tell), tmp_path)
    assert [figure.name for figure in verdict.figures if not figure.holds] == failed
    assert asked["unswitched"] == {"detector": {"schedule": [[0.0, "Bright"]]}}
    assert asked["rewind"]["detector"]["schedule"][1] == [5.0, "Dark"]
    assert (tmp_path / "paths.png").stat().st_size > 5000


def test_images_and_rooms_are_drawn_from_the_runs_own_recording(folder):
    plain = {"source": make_config("mcap") | {"path": str(folder / "room.mcap")}}
    OmegaConf.save(OmegaConf.create(plain), folder / "config.yaml")
    source = source_of(folder)
    stamps_ns = np.array([one.stamp_ns for one in source])
    poses = np.stack([se3.from_xy_yaw(0.1 * k, 0.0, 0.0) for k in range(len(stamps_ns))])
    truth = Trajectory(stamps_ns=stamps_ns, T_world_base=poses)
    truth.write_tum(folder / "groundtruth.tum")
    draw_images(folder / "images.png", folder, [int(stamps_ns[3]), int(stamps_ns[20])])
    draw_rooms(folder / "rooms.png", folder)
    for name in ("images.png", "rooms.png"):
        assert (folder / name).stat().st_size > 10_000, name


def difference(tmp_path, switched, unswitched):
    """Return the verdict on two runs over 50 observations; 0.03 m are allowed."""
    metrics = {"ate_rmse_m": 0.01, "association_gap_s": 0.01, "observations": 50}

    def tell(trial):
        trajectory = unswitched if trial.name.endswith("unswitched") else switched
        return Told(metrics=metrics, trajectory=trajectory)

    experiment = DifferenceExperiment(lit_module="bright", difference_max_m={"one": 0.03})
    return experiment.run(teller(tmp_path / "runs", tell), tmp_path)


@pytest.mark.parametrize(("offset_m", "holds"), [(0.02, True), (0.04, False)])
def test_difference_is_the_largest_between_the_two_runs(tmp_path, offset_m, holds):
    path = loop(50)
    aside = moved(path, se3.from_parts(np.eye(3), np.array([0.0, offset_m, 0.0])))
    verdict = difference(tmp_path, path, aside)
    assert verdict.figures[1].value == pytest.approx(offset_m) and verdict.holds is holds
    assert (tmp_path / "difference.png").stat().st_size > 5000


def test_two_runs_are_compared_over_the_whole_path(tmp_path):
    verdict = difference(tmp_path, select(loop(50), np.arange(20)), loop(50))
    assert [(figure.value, figure.holds) for figure in verdict.figures] == [
        (0.4, False),
        (0.0, True),
    ]


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
    told = Told(metrics={"switches": [switch | {"to": "bright"}]}, events=[cost])
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
    values = [figure.value for figure in verdict.figures]
    assert values == pytest.approx([0.2, 0.1, 0.02, 0.9])  # a tenth of what a start takes
    assert [figure.holds for figure in verdict.figures] == [True, True, True, False]


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


def test_the_page_holds_every_table_and_picture_of_the_commands():
    page = (PAGE / "README.md").read_text()
    tables = sorted((PAGE / "results").glob("*/table.csv"))
    assert len(tables) == 6
    for path in tables:
        assert f"<!-- {path.relative_to(PAGE.parent)} -->" in page, path
    for path in (PAGE / "results").glob("*/*.png"):
        assert f"({path.relative_to(PAGE)})" in page and path.stat().st_size < 150_000, path
