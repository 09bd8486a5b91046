"""Experiments: many runs, one verdict."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from configured import config
from fakes import LiveFeedSource
from omegaconf import ListConfig, OmegaConf

from sceneslam import cli
from sceneslam.config.provenance import provenance
from sceneslam.evaluation.verdict import verdict_lines, write_verdict
from sceneslam.experiment import _prepare, _run_unless_finished, _Trials, _try_sources
from sceneslam.experiments.openloris.dataset import Dataset
from sceneslam.experiments.openloris.rates import Rates, mean
from sceneslam.types.errors import InputError
from sceneslam.types.experiment import Figure, Relation, Table, Trial, Verdict

ROOT = Path(__file__).parents[1]
AT_LEAST, AT_MOST = Relation.AT_LEAST, Relation.AT_MOST
WORDS = [sys.executable, "-m", "sceneslam"]
VINS = "vins_mono_color_imu_with_loop"  # of which a rate is promised
EXTRINSICS = "home_cafe:\n  imu: [0.2, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]\n"


def figure(value, relation, bound):
    return Figure(name="some error", value=value, relation=relation, bound=bound, unit="m")


@pytest.mark.parametrize(
    ("value", "relation", "bound", "holds"),
    [
        (1.0, AT_LEAST, 1.0, True),
        (0.9, AT_LEAST, 1.0, False),
        (1.0, AT_MOST, 1.0, True),
        (1.1, AT_MOST, 1.0, False),
        (float("nan"), AT_MOST, 1.0, False),
    ],
)
def test_a_figure_holds_on_its_side_of_the_bound(value, relation, bound, holds):
    assert figure(value, relation, bound).holds is holds


@pytest.mark.parametrize(
    ("value", "holds"),
    [(0.4, False), (0.5, True), (2.0, True), (2.1, False), (float("nan"), False)],
)
def test_a_figure_between_two_bounds_holds_within_both(value, holds, tmp_path):
    one = Figure.between("error squared", value, 0.5, 2.0)
    assert one.holds is holds
    write_verdict(tmp_path, "trial", Verdict(figures=[one], table=Table(columns=(), rows=[])))
    (plain,) = json.loads((tmp_path / "verdict.json").read_text())["figures"]
    assert (plain["relation"], plain["low"], plain["bound"]) == ("in", 0.5, 2.0)


def test_verdict_is_written_beside_its_table(tmp_path):
    figures = [figure(0.5, AT_MOST, 1.0), figure(float("nan"), AT_MOST, 1.0)]
    table = Table(columns=("run", "error [m]"), rows=[("one, two", 0.25), ("three", None)])
    verdict = Verdict(figures=figures, table=table)
    write_verdict(tmp_path, "trial", verdict)
    content = json.loads((tmp_path / "verdict.json").read_text())
    assert content["experiment"] == "trial" and content["holds"] is False
    assert content["figures"][0] == {
        "name": "some error",
        "value": 0.5,
        "unit": "m",
        "relation": "<=",
        "bound": 1.0,
        "holds": True,
    }
    assert content["figures"][1]["value"] is None and not content["figures"][1]["holds"]
    with (tmp_path / "table.csv").open() as file:
        assert list(csv.reader(file))[1] == ["one, two", "0.25"]
    assert (tmp_path / "table.md").read_text().splitlines()[3] == "| three | - |"
    assert [line.split()[0] for line in verdict_lines(verdict)] == ["holds", "FAILS"]


def rates(duration_s, together):
    return Rates(
        system="slam",
        scene="home",
        name="home-1-1",
        duration_s=duration_s,
        alone=50.0,
        odometry=80.0,
        together=together,
        told=0.0,
        ate_odometry_m=0.0,
        ate_together_m=0.0,
    )


def test_long_sequences_weigh_more():
    both = mean([rates(300.0, 90.0), rates(100.0, 50.0)], "home")
    assert both.together == pytest.approx(80.0) and both.margin == pytest.approx(0.0)
    assert both.duration_s == 400.0


def straight(name, *, frame="base_link", scale=1.0, seconds=range(0, 61)):
    """Poses along x at 0.5 m/s."""
    lines = "".join(f"{t_s:.1f} {0.5 * t_s * scale} 0 0 0 0 0 1\n" for t_s in seconds)
    return f"scene: {name}\nframe: {frame}\nseq: 1\n{lines}"


@pytest.fixture
def folder(tmp_path):
    """Give two scenes: the system is three times too fast in home, and failed in cafe."""
    files = {
        "gt/gt_home_1.txt": straight("home"),
        "gt/gt_cafe_1.txt": straight("cafe"),
        "recorded/odom/home.txt": straight("home"),
        "recorded/odom/cafe.txt": straight("cafe"),
        f"recorded/{VINS}/home.txt": straight("home", frame="imu", scale=3.0),
        "extrinsics.yaml": EXTRINSICS,
    }
    for name, text in files.items():
        (tmp_path / "data" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "data" / name).write_text(text)
    return tmp_path


def test_recordings_are_told_apart_by_their_headers_and_brought_to_base(folder):
    data = Dataset(folder / "data")
    assert [key.name for key in data.sequences] == ["cafe-1-1", "home-1-1"]
    (recorded,) = data.systems[VINS].values()
    assert recorded.T_base_frame == [0.2, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]
    assert recorded.trajectory.positions_m[0].tolist() == [-0.2, 0.0, -0.5]


def test_a_frame_without_extrinsics_is_named(folder):
    (folder / "data" / "extrinsics.yaml").write_text(EXTRINSICS.replace("imu", "camera"))
    with pytest.raises(InputError, match="no extrinsics of imu in scene home"):
        Dataset(folder / "data")


def call(folder, *overrides, name="openloris", out="out"):
    return subprocess.run(
        [*WORDS, f"+experiment={name}", *overrides, f"hydra.run.dir={out}"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_openloris_says_for_every_system_and_scene_whether_harm_was_done(folder):
    done = call(folder, "openloris.path=data")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "report  out/report.html"
    verdict = json.loads((folder / "out" / "verdict.json").read_text())
    values = {entry["name"]: entry["value"] for entry in verdict["figures"]}
    # Nothing was recorded in cafe: odometry alone is all there is, and right.
    assert values[f"{VINS}, cafe: together above the better of the two"] == pytest.approx(
        0.0, abs=0.1
    )
    assert values[f"{VINS}, home-1-1: together above the better of the two"] > -1.0
    assert len(values) == 6 and (folder / "out" / "rates.png").stat().st_size > 5000
    with (folder / "out" / "table.csv").open() as file:
        rows = {row["sequences"]: row for row in csv.DictReader(file)}
    assert float(rows["home-1-1"]["odometry [%]"]) == 100.0
    assert float(rows["home-1-1"]["alone [%]"]) < 30.0
    assert (folder / "out" / "runs" / VINS / "home-1-1" / "trajectory.tum").is_file()
    page = (folder / "out" / "report.html").read_text()
    assert "Does switching ever increase the error?" in page
    command = "python -m sceneslam +experiment=openloris openloris.path=data hydra.run.dir=out"
    assert f"<pre>{command}</pre>" in page


def test_runs_beside_each_other_give_what_runs_in_turn_give_and_go_on_where_they_stopped(folder):
    for out, jobs in (("in_turn", 1), ("beside", 2)):
        done = call(folder, "openloris.path=data", f"jobs={jobs}", out=out)
        assert done.returncode == 0, done.stderr
    tables = {(folder / out / "table.csv").read_text() for out in ("in_turn", "beside")}
    assert len(tables) == 1
    first, *others = sorted((folder / "beside" / "runs").rglob("finished.json"))
    first.unlink()
    was = {path: path.stat().st_mtime_ns for path in others}
    done = call(folder, "openloris.path=data", "jobs=2", out="beside")
    assert done.returncode == 0 and first.is_file()
    assert {path: path.stat().st_mtime_ns for path in others} == was


@pytest.mark.parametrize(("bound_m", "code"), [(0.1, cli.OK), (0.01, cli.INCOMPLETE)])
def test_an_experiment_whose_bound_does_not_hold_ends_with_code_one(
    tmp_path, monkeypatch, capsys, bound_m, code
):
    runtime, task = SimpleNamespace(output_dir=str(tmp_path)), SimpleNamespace(task=ListConfig([]))
    given = SimpleNamespace(runtime=runtime, overrides=task)
    figures = [Figure.at_most("far", 0.05, bound_m, "m"), Figure.at_most("near", 0.0, 1.0, "m")]
    verdict = Verdict(figures=figures, table=Table(columns=(), rows=[]))
    monkeypatch.setattr(cli.HydraConfig, "get", lambda: given)
    monkeypatch.setattr(cli, "run_experiment", lambda *_: verdict)
    ended = cli.carry_out(OmegaConf.create({"experiment": "matrix", "allow_targets": []}))
    errors = ("1 of 2 bounds do not hold: far",) if code else ()
    assert ended == cli.Ended(code=code, errors=errors)
    assert capsys.readouterr().err == "".join(f"error: {one}\n" for one in errors)


def test_a_disk_that_fails_in_an_experiment_is_one_sentence(tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise OSError(5, "input/output error", "verdict.json")

    runtime, task = SimpleNamespace(output_dir=str(tmp_path)), SimpleNamespace(task=ListConfig([]))
    given = SimpleNamespace(runtime=runtime, overrides=task)
    monkeypatch.setattr(cli.HydraConfig, "get", lambda: given)
    monkeypatch.setattr(cli, "run_experiment", fail)
    ended = cli.carry_out(OmegaConf.create({"experiment": "matrix", "allow_targets": []}))
    sentence = "OSError: [Errno 5] input/output error: 'verdict.json'"
    assert ended == cli.Ended(code=cli.UNUSABLE, errors=(sentence,))
    assert capsys.readouterr().err == f"error: {sentence}\n"


def test_a_trial_whose_metrics_could_not_be_saved_is_run_again(tmp_path, monkeypatch):
    def fail(path, metrics):
        raise OSError("no space left on device")

    settings = config(run__report=False)
    with monkeypatch.context() as full:
        full.setattr("sceneslam.results.write_metrics", fail)
        with pytest.raises(InputError, match=r"metrics\.json of a trial is missing: .* no space"):
            _run_unless_finished(settings, tmp_path, "trial")
    _run_unless_finished(settings, tmp_path, "trial")
    assert (tmp_path / "metrics.json").is_file() and (tmp_path / "finished.json").is_file()


NOWHERE = {"_target_": "fakes.ExactModule", "lost": list(range(100))}


@pytest.mark.parametrize(
    ("changes", "cause", "is_again"),
    [
        ({}, "sceneslam.results.save_map", True),
        ({"source__breaks_at": 70}, None, True),
        ({"source__fault": "damaged at 2 s"}, None, False),
        ({"slam__bright": NOWHERE, "slam__dark": NOWHERE}, None, False),
        ({}, None, False),
    ],
)
def test_a_trial_is_run_again_if_its_errors_may_be_gone(
    tmp_path, monkeypatch, changes, cause, is_again
):
    def fail(*_):
        raise MemoryError

    settings = config(run__report=False, **changes)
    with monkeypatch.context() as full:
        if cause is not None:
            full.setattr(cause, fail)
        _run_unless_finished(settings, tmp_path, "trial")
    was = (tmp_path / "metrics.json").stat().st_mtime_ns
    _run_unless_finished(settings, tmp_path, "trial")
    assert ((tmp_path / "metrics.json").stat().st_mtime_ns != was) is is_again


def changed(name):
    """Give a configuration that names a file, and the file with another content later."""
    pen = Path("pen")  # relative, as a command line gives it
    pen.mkdir()
    file = pen / ("pens_own.py" if name == "allow_targets" else "file")
    file.write_text("a = 1\n")
    values = {
        "allow_targets": {"allow_targets": ["fakes", "pens_own.detectors"]},
        "effects": {"effects": {"_target_": "x", "path": "pen/file"}},
        "detector": {"detector": {"_target_": "x", "path": "pen/file", "text": "a" * 5000}},
        "labels": {"detector": {"_target_": "x", "labels": "pen/file"}},
        "slam": {"slam": {"a": {"_target_": "x", "command": ["pen/file", "--fast"]}}},
        "source": {"source": {"_target_": "x", "inner": {"path": "pen"}}},
        "map": {"atlas": {"load": "pen", "save": "other"}},
        "same_map": {"atlas": {"load": "pen", "save": "pen/../pen"}},
        "record": {"effects": {"_target_": "x", "record": "pen/file"}},
    }
    return config(**values[name]), file


@pytest.mark.parametrize(
    ("name", "is_another"),
    [
        *((name, True) for name in ("allow_targets", "effects", "detector", "labels", "slam")),
        *((name, True) for name in ("source", "map")),
        *((name, False) for name in ("same_map", "record")),  # files that the run itself changes
    ],
)
def test_an_edited_file_or_code_makes_another_trial(tmp_path, monkeypatch, name, is_another):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "pen")
    settings, file = changed(name)
    before = provenance(settings)
    assert provenance(settings) == before
    file.write_text("a = 2\n")
    assert (provenance(settings) != before) is is_another


def test_a_trial_whose_process_is_killed_is_one_sentence(tmp_path):
    killed = config(run__report=False, sinks={"killer": {"_target_": "fakes.Killer", "at": 10}})
    trials = _Trials("matrix", tmp_path, [], 2, None)
    with pytest.raises(InputError, match=r"a trial's process ended \(it was killed, or jobs=2"):
        list(trials._made([(Trial(name="trial"), killed)]))


def test_faults_of_runs_beside_each_other_strike_in_the_runs_alone(tmp_path):
    record = tmp_path / "trial" / "struck.jsonl"
    target = "sceneslam.sources.changes.faulty.FaultySource"
    rates = {"rate_ratio": 1.0, "lasting_s": 0.5, "clock_jump_s": 1.0, "seed": 0}
    struck = {"_target_": target, "faults": ["duplicate"], "record": str(record), **rates}
    settings = config(run__report=False, effects=struck)
    list(_Trials("matrix", tmp_path, [], 2, None)._made([(Trial(name="trial"), settings)]))
    seen = json.loads((tmp_path / "trial" / "metrics.json").read_text())["observations"]
    assert len(record.read_text().splitlines()) == seen  # each once, the first one too


def test_a_trial_that_runs_begins_without_the_record_of_its_earlier_run(tmp_path):
    record = tmp_path / "struck.jsonl"
    target = "sceneslam.modules.slam.faulty.FaultyModule"
    rates = {"rate_ratio": 1.0, "lasting_s": 0.5, "jump_m": 1.0, "seed": 0}
    inner = {"_target_": "fakes.ExactModule"}
    struck = {"_target_": target, "module": inner, "faults": ["nan"], "record": str(record)}
    settings = config(run__report=False, slam__bright=struck | rates)
    _run_unless_finished(settings, tmp_path, "trial")
    struck_ns = [json.loads(line)["stamp_ns"] for line in record.read_text().splitlines()]
    (tmp_path / "finished.json").unlink()
    _run_unless_finished(settings, tmp_path, "trial")
    again_ns = [json.loads(line)["stamp_ns"] for line in record.read_text().splitlines()]
    assert again_ns == struck_ns and struck_ns
    _run_unless_finished(settings, tmp_path, "trial")
    assert len(record.read_text().splitlines()) == len(struck_ns)  # it is kept


@pytest.mark.parametrize("read", [_prepare, lambda settings: _try_sources([settings])])
def test_a_live_source_that_was_tried_before_the_trials_is_closed(monkeypatch, read):
    monkeypatch.setattr(LiveFeedSource, "is_open", True)
    read(config(source={"_target_": "fakes.LiveFeedSource", "steps": 9, "dark_from": 5}))
    assert not LiveFeedSource.is_open


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_processes_of_a_stopped_experiment_end_with_it_and_lose_nothing(tmp_path, number):
    words = ("matrix.stories=[there_and_back]", "matrix.seeds=[0]", "jobs=2")
    process = subprocess.Popen(
        [*WORDS, "+experiment=matrix", *words, "source.camera.size_wh=[80,60]"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    until = time.monotonic() + 200
    while not any(path.stat().st_size for path in tmp_path.rglob("journal.bin")):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.1)
    process.send_signal(number)
    process.communicate(timeout=60)  # every process has closed the pipe
    assert process.returncode != 0
    begun = {path.parent for path in tmp_path.rglob("journal.bin")}
    saved = {path.parent for path in tmp_path.rglob("trajectory.tum")}
    assert begun <= saved and len(saved) < 5 and not list(tmp_path.rglob("verdict.json"))


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ((), "openloris.path: got nothing"),
        (("openloris.path=data", "jobs=0"), "jobs: got 0"),
        (("openloris.path=data", "jobs=two"), "jobs: got 'two', allowed: a whole number"),
        (("openloris.path=data", "jobs=2.5"), "jobs: got 2.5, allowed: a whole number"),
        (("openloris.path=data", "jobs=true"), "jobs: got True, allowed: a whole number"),
        (("openloris.path=nowhere",), "expected a folder: nowhere"),
        (("openloris.path=data", "openloris.limits_m=null"), "openloris.limits_m: got None"),
        (("openloris.path=data", "policy.confirm_window_s=-1"), "policy.confirm_window_s: got -1"),
    ],
)
def test_a_mistake_is_one_sentence(folder, overrides, sentence):
    done = call(folder, *overrides)
    assert done.returncode == 2 and sentence in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("experiment", "overrides", "sentence"),
    [
        ("matrix", ("matrix.stories=[there_and_bak]", "matrix.seeds=[0]"), "source.story: got"),
        ("table", ("+table.recordings.x=['source=tum_rgbd','source.path=no']",), "a folder: no"),
        ("table", ("table.modules=[depht]",), "Could not find 'slam/depht'"),
        ("matrix", ("matrix.seeds=[0]", "atlas.save=map"), "atlas.save: got 'map'"),
        ("matrix", ("matrix.seeds=[0]", "reference={seed:1}"), "null in an experiment"),
        ("tune", ("tune.space.window.key=policy.windw_s",), "override 'policy.windw_s'"),
    ],
)
def test_what_cannot_be_run_is_told_before_the_first_run(tmp_path, experiment, overrides, sentence):
    done = call(tmp_path, *overrides, name=experiment)
    assert done.returncode == 2 and sentence in done.stderr
    assert "Error executing" not in done.stderr
    assert not list(tmp_path.glob("out/runs/*"))
