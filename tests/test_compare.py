"""Runs side by side: what is told of them, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from configured import config
from evaluation_runs import loop, moved

from sceneslam import run
from sceneslam.app import run as run_config
from sceneslam.compare import figures
from sceneslam.compare.__main__ import main
from sceneslam.compare.page import measured
from sceneslam.compare.runs import Run, differing, read_runs
from sceneslam.evaluation.association import select
from sceneslam.evaluation.figures.paths import _true_m
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.trajectory import Trajectory

WORDS = ("+scenario=single", "source=mcap", "run.progress=false", "slam@slam.only=odometry")


@pytest.fixture(scope="module")
def runs(tmp_path_factory, recording):
    folder = tmp_path_factory.mktemp("runs")
    source = f"source.path={recording}"
    return [
        run(*WORDS, source, folder=folder / "whole"),
        run(*WORDS, source, "run.max_observations=20", folder=folder / "part"),
    ]


def test_a_script_that_asks_for_a_reference_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"reference: got .*, allowed: null in a script"):
        run(*WORDS, "source.path=x", "reference={seed:1}", folder=tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_truth_is_placed_by_the_first_pose_that_it_covers():
    first = loop(200)
    truth = select(moved(first, se3.from_xy_yaw(3.0, 1.0, 2.0)), np.arange(50, 200))
    assert _true_m(first, truth) == pytest.approx(first.positions_m[50:, :2])
    later = Trajectory(stamps_ns=truth.stamps_ns + 10**12, T_world_base=truth.T_world_base)
    assert not len(_true_m(first, later))


def test_truth_is_that_of_the_run_to_which_it_is_aligned(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "draw_paths", lambda path, paths, truth: drawn.append(truth))
    made = partial(Run, folder=tmp_path, metrics={"association_gap_s": 0.01}, settings={})
    none = made(name="none", trajectory=Trajectory.empty(), truth=loop(10))
    some = made(name="some", trajectory=loop(20), truth=loop(20))
    assert figures.paths(tmp_path / "paths.png", [none, some])
    assert drawn == [some.truth]


def test_a_map_that_begins_later_is_drawn_where_the_others_are(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "draw_paths", lambda path, paths, truth: drawn.append(paths))
    whole = loop(100)
    begun = moved(select(whole, np.arange(20, 100)), se3.inverse(whole.T_world_base[20]))
    made = partial(Run, folder=tmp_path, metrics={"association_gap_s": 0.01}, settings={})
    whole_run = made(name="whole", trajectory=whole, truth=None)
    later_run = made(name="later", trajectory=begun, truth=None)
    for runs, expected in (([whole_run, later_run], whole), ([later_run, whole_run], begun)):
        figures.paths(tmp_path / "paths.png", runs)
        whole_m, later_m = (drawn[-1][name].positions_m for name in ("whole", "later"))
        assert later_m == pytest.approx(whole_m[20:], abs=1e-9)
        assert later_m[-1] == pytest.approx(expected.positions_m[-1])


def test_runs_are_apart_by_the_poses_within_their_own_association_gap(runs):
    first, second = read_runs([one.folder for one in runs])
    later = second.trajectory.stamped(second.trajectory.stamps_ns + 20_000_000)
    names = []
    for gap_s in (0.01, 0.03):
        metrics = {**second.metrics, "association_gap_s": gap_s}
        names.append(measured([first, replace(second, trajectory=later, metrics=metrics)])[-1][0])
    assert names[0] != names[1] == f"largest distance from {first.name}"


def test_a_script_gets_the_run_as_arrays(runs):
    whole = runs[0]
    assert whole.trajectory.T_world_base.shape == (30, 4, 4) and len(whole.modules) == 30
    assert (whole.folder / "report.html").is_file() and not whole.faults
    assert "30 observations" in repr(whole) and len(repr(whole)) < 2000


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("+scenario=nowhere",), "scenario/nowhere"),
        (("policy.typo=1",), "policy.typo"),
        (("story=a(b",), "quotes"),
        (("+experiment=faults",), "experiment"),
        ((*WORDS, "source.path=x.mcap", "detector._target_=os.system"), "os.system"),
    ],
)
def test_a_script_is_told_what_is_wrong(tmp_path, words, named):
    with pytest.raises(ConfigError, match=named):
        run(*words, folder=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_scripts_own_configurations(tmp_path, recording):
    (tmp_path / "conf" / "scenario").mkdir(parents=True)
    text = "# @package _global_\ndefaults: [single, override /slam@slam.only: odometry]\n"
    (tmp_path / "conf" / "scenario" / "mine.yaml").write_text(text)
    words = ("+scenario=mine", "source=mcap", f"source.path={recording}", "run.progress=false")
    done = run(*words, config_dir=tmp_path / "conf", folder=tmp_path / "out")
    assert done.metrics["poses"] == 30
    with pytest.raises(ConfigError, match="nowhere"):
        run(*words, config_dir=tmp_path / "nowhere", folder=tmp_path / "other")


@pytest.mark.parametrize(
    ("changes", "count"),
    [
        ({}, "none"),
        ({"source__fault": "damaged at 2 s"}, "1"),
        ({"slam__bright": {"_target_": "fakes.ExactModule", "raises": [20]}}, "1"),
        ({"source__breaks_at": 70, "source__fault": "damaged at 2 s"}, "2"),
    ],
)
def test_every_error_of_a_run_is_counted_once(tmp_path, changes, count):
    run_config(config(run__report=False, **changes), tmp_path)
    assert dict(measured(read_runs([tmp_path])))["faults"] == count


def test_a_run_of_an_earlier_version_has_the_faults_that_it_names(runs):
    (whole,) = read_runs([runs[0].folder])
    metrics = {name: value for name, value in whole.metrics.items() if name != "errors"}
    earlier = replace(whole, metrics=metrics | {"shortfalls": ["laser failed once"]})
    assert dict(measured([earlier]))["faults"] == "1"


def test_page_holds_what_was_measured_and_what_was_set_otherwise(runs, tmp_path, capsys):
    folders = [str(one.folder) for one in runs]
    assert main([*folders, "--out", str(tmp_path / "page")]) == 0
    told = capsys.readouterr().out
    assert "whole" in told and "part" in told and "largest distance from whole" in told
    page = (tmp_path / "page" / "report.html").read_text()
    assert page.count("<img ") == sum(1 for _ in (tmp_path / "page").glob("*.png")) > 0
    assert [one.key for one in differing(read_runs([one.folder for one in runs]))] == [
        "run.max_observations"
    ]
    assert "run.max_observations" in page and 'href="../' in page
    assert main([*folders, "--out", str(tmp_path / "page")]) == 0  # its own page is replaced


def test_nothing_foreign_and_no_run_is_overwritten(runs, tmp_path, capsys):
    folders = [str(one.folder) for one in runs]
    before = sorted(path.name for path in runs[0].folder.iterdir())
    assert main([*folders, "--out", folders[0]]) == 2
    assert sorted(path.name for path in runs[0].folder.iterdir()) == before
    (tmp_path / "report.html").write_text("mine")
    assert main([*folders, "--out", str(tmp_path)]) == 2
    assert (tmp_path / "report.html").read_text() == "mine"
    assert capsys.readouterr().err.count("error: --out") == 2


@pytest.mark.parametrize(
    ("name", "text"),
    [("metrics.json", "[]"), ("metrics.json", "{}"), ("config.yaml", "words")],
)
def test_files_that_are_not_those_of_a_run_are_named(runs, tmp_path, capsys, name, text):
    whole = runs[0].folder
    for one in ("metrics.json", "trajectory.tum", "config.yaml"):
        (tmp_path / one).write_bytes((whole / one).read_bytes())
    (tmp_path / name).write_text(text)
    assert main([str(whole), str(tmp_path), "--out", str(tmp_path / "page")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and name in error and str(tmp_path) in error


@pytest.mark.parametrize("kind", ["one", "twice", "empty", "damaged"])
def test_what_cannot_be_compared_is_named(runs, tmp_path, capsys, kind):
    whole = runs[0].folder
    (tmp_path / "metrics.json").write_text("{")
    (tmp_path / "trajectory.tum").write_text("")
    (tmp_path / "config.yaml").write_text("{}")
    other = {"one": [], "twice": [whole], "empty": [whole.parent], "damaged": [tmp_path]}[kind]
    assert main([str(path) for path in [whole, *other]]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and str(other[0] if other else whole) in error
    assert not Path("outputs/compare").exists()
