"""The command line: exit codes, one sentence per mistake, and stopping half-way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pytest

from sceneslam.types.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
SINGLE = ("+scenario=single", "source=mcap", "source.path=room.mcap")


def command(*overrides):
    return [sys.executable, "-m", "sceneslam", *overrides, "hydra.run.dir=out"]


def call(folder, *overrides):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        command(*overrides),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_run_says_what_happened_in_ten_lines_at_most(folder):
    done = call(folder, *SINGLE)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.strip().splitlines()
    assert len(lines) <= 10 and lines[-1].endswith("out/report.html")
    assert "30/30" in done.stderr  # the progress bar
    assert json.loads((folder / "out" / "metrics.json").read_text())["coverage"] == 1.0


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        ((), "slam: got nothing"),
        (("+scenario=single", "source=mcap"), "source.path: got nothing"),
        (("+scenario=single", "source=mcap", "source.path=nowhere.mcap"), "nowhere.mcap"),
        ((*SINGLE, "+scenaro=x"), "did you mean scenario?"),
        ((*SINGLE, "policy.confirm_window_s=-1"), "policy.confirm_window_s: got -1"),
        ((*SINGLE, "detector._target_=os.system"), "detector._target_: got 'os.system'"),
        ((*SINGLE, "slam.only.feature_count=many"), "slam.only.feature_count: got 'many'"),
        ((*SINGLE, "policy=typo"), "policy: got 'typo', allowed: one of bayes, default"),
        ((*SINGLE, "policy.typo=1"), "There is no key policy.typo"),
        ((*SINGLE, "policy={typo: 1}"), "There is no key policy.typo"),
        ((*SINGLE, "scenes={Dark: [only]}"), "use +scenes={Dark: [only]}"),
        ((*SINGLE, "evaluation.scenes={Hall: Any}"), "use +evaluation.scenes={Hall: Any}"),
        ((*SINGLE, "slam=process"), "use +slam@slam.KEY=process"),
        ((*SINGLE, "sinks=mcap"), "use +sinks@sinks.KEY=mcap"),
        ((*SINGLE, "policy.gate=null", "sinks=null"), "error: sinks=null: a group holds options"),
        ((*SINGLE, "scenes.Any=[onyl]"), "scenes.Any: got ['onyl']"),
        (
            (*SINGLE, "effects=[lights_out,depth_gap]"),
            "effects: got ['lights_out', 'depth_gap'], allowed: one of them at a time",
        ),
        ((*SINGLE, "--config-dir", "nowhere", "seed=1"), "nowhere' not found"),
        ((*SINGLE, "seed=${nope}"), "seed: got 'an interpolation'"),
        ((*SINGLE, "allow_targets=${foo:1}"), "allow_targets: got 'an interpolation'"),
        ((*SINGLE, "scenes.Any=[only"), "scenes.Any=[only: no viable"),
    ],
)
def test_mistake_is_one_sentence_without_a_traceback(folder, overrides, sentence):
    done = call(folder, *overrides)
    assert done.returncode in (1, 2)
    assert sentence in done.stderr + done.stdout
    assert "Traceback" not in done.stderr + done.stdout
    assert not (folder / "out").exists()


def test_a_mistake_is_one_sentence_whatever_is_set_for_hydra(folder, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    done = call(folder, *SINGLE, "policy.typo=1")
    assert done.returncode == 2 and done.stderr.startswith("error: ")


def test_a_folder_that_cannot_be_made_is_one_sentence(folder):
    words = [*command(*SINGLE)[:-1], "hydra.run.dir=room.mcap/out"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stderr.startswith("error: hydra.run.dir")
    assert "room.mcap/out" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("written", "sentence"),
    [
        (b"defaults: default", "Invalid defaults list in 'policy/mine', defaults must be a list"),
        (b"defaults: [mine]", "defaults: a file is in its own list"),
        ("dwell_s: 1 # größe".encode("latin-1"), "a YAML file is not UTF-8 text, at 'dwell_s: 1"),
    ],
)
def test_file_that_hydra_breaks_on_is_one_sentence(folder, tmp_path, written, sentence):
    (tmp_path / "policy").mkdir()
    (tmp_path / "policy" / "mine.yaml").write_bytes(written)
    done = call(folder, "--config-dir", str(tmp_path), *SINGLE, "policy=mine")
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {sentence}")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("asked", [["--help"], ["--cfg", "job"]])
def test_reader_that_has_gone_is_no_error(folder, asked):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        command(*asked), cwd=folder, env=environment, stdout=writer, stderr=subprocess.PIPE
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("asked", ["list", "--version", "--help", "--hydra-help"])
def test_answer_that_a_full_disk_loses_is_an_error(folder, asked):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with Path("/dev/full").open("wb") as full:
        words = [sys.executable, "-m", "sceneslam", asked]
        done = subprocess.run(
            words, cwd=folder, env=environment, stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 1 and done.stderr.startswith("error: standard output: OSError")


def test_cut_recording_is_read_as_far_as_it_goes(folder, recording):
    data = recording.read_bytes()
    (folder / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    done = call(folder, "+scenario=single", "source=mcap", "source.path=cut.mcap")
    assert done.returncode == 1 and "could not be read" in done.stderr
    assert "Traceback" not in done.stderr
    assert 5 < len(Trajectory.read_tum(folder / "out" / "trajectory.tum")) < 30


def test_cut_recording_is_an_error_without_slam_too_and_from_the_cache(
    folder, recording, monkeypatch
):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(folder / "cache"))
    data = recording.read_bytes()
    (folder / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    for _ in range(2):
        done = call(folder, "run=detect_only", "source=mcap", "source.path=cut.mcap")
        assert done.returncode == 1 and "could not be read" in done.stderr
        assert "scenes confirmed" in done.stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_run_saves_what_it_has(folder, number):
    overrides = (*SINGLE, "run.mode=live")  # paced: 30 observations take a second
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command(*overrides), cwd=folder, env=environment, stderr=subprocess.PIPE, text=True
    )
    events = folder / "out" / "events.jsonl"
    deadline_s = monotonic() + 60
    while not (events.exists() and events.stat().st_size) and monotonic() < deadline_s:
        sleep(0.02)
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 1 and "stopped after" in errors
    assert "Traceback" not in errors
    saved = Trajectory.read_tum(folder / "out" / "trajectory.tum")
    assert np.isfinite(saved.T_world_base).all() and (folder / "out" / "report.html").exists()


def test_sweep_runs_every_job(folder):
    done = call(folder, "-m", *SINGLE, "hydra.sweep.dir=sweep", "slam.only.feature_count=300,500")
    assert done.returncode == 0, done.stderr
    assert {path.parent.name for path in (folder / "sweep").glob("*/metrics.json")} == {"0", "1"}
    assert not list(Path(folder).glob("out/metrics.json"))


def test_recorded_run_can_be_run_again_to_the_same_trajectory(folder):
    exact = ("sinks.mcap.image_format=png", "sinks.mcap.depth_every=1")
    done = call(folder, *SINGLE, "+sinks@sinks.mcap=mcap", *exact)
    assert done.returncode == 0, done.stderr
    first = (folder / "out" / "trajectory.tum").read_bytes()
    (folder / "out" / "run.mcap").rename(folder / "again.mcap")
    done = call(folder, "+scenario=single", "source=mcap", "source.path=again.mcap")
    assert done.returncode == 0, done.stderr
    assert (folder / "out" / "trajectory.tum").read_bytes() == first
