"""Whole runs with every module in a process of its own, beside the same runs without."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from configured import config
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sceneslam.app import run
from sceneslam.types.errors import ConfigError

SMALL = ("source.camera.size_wh=[320,240]", "source.camera.rate_hz=10", "source.duration_s=15.5")


def composed(*overrides):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        found = compose(
            "config", overrides=["run.progress=false", "~sinks@sinks.rerun", *overrides]
        )
        return OmegaConf.to_container(found, resolve=True)


def decisions(folder):
    """Return all events but those that tell what things cost."""
    events = map(json.loads, (folder / "events.jsonl").read_text().splitlines())
    return [event for event in events if event["event"] != "cost"]


@pytest.fixture
def leaves_no_process():
    """Fail where a test leaves a process behind, a dead one included."""
    before = children()
    yield
    assert children() <= before


def children():
    return set(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split())


@pytest.mark.slow
def test_both_isolations_give_the_same_run_to_the_bit(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(tmp_path / "cache"))
    inline, process = tmp_path / "inline", tmp_path / "process"
    for folder in (inline, process):
        isolation = f"run.isolation={folder.name}"
        finished = run(composed("+scenario=bright_to_dark", *SMALL, isolation), folder)
        assert finished.faults == () and len(finished.trajectory) >= 150
    assert decisions(inline) == decisions(process)
    assert {e["module"] for e in decisions(inline) if e["event"] == "handover"} == {
        "bright",
        "dark",
    }
    written = [*inline.glob("*.tum"), *(inline / "map").iterdir()]
    assert len(written) >= 6
    for path in written:
        assert path.read_bytes() == (process / path.relative_to(inline)).read_bytes(), path


@pytest.mark.parametrize(
    "changes",
    [
        {"slam__bright": {"_target_": "fakes.ExactModule", "speed": 3}},
        {"slam__bright": {"_target_": "fakes.NoSuchModule"}},
        {"slam__bright": {"_target_": "fakes.Mute"}},
        {"slam__bright": {"_target_": "fakes.DepthModule"}},
        {"slam__bright": {"_target_": "fakes.FakeSource", "steps": 1, "dark_from": 1}},
    ],
)
def test_a_wrong_configuration_is_named_as_it_is_inline(tmp_path, changes):
    sentences = []
    for isolation in ("inline", "process"):
        with pytest.raises(ConfigError) as caught:
            run(config(run__isolation=isolation, **changes), tmp_path)
        sentences.append(str(caught.value))
    assert sentences[0] == sentences[1]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("isolation", "container"),
        ("step_deadline_s", 0.0),
        ("memory_limit_mb", 0),
        ("restarts_max", -1),
    ],
)
def test_limits_that_make_no_sense_are_refused(tmp_path, key, value):
    with pytest.raises(ConfigError, match=f"run.{key}"):
        run(config(**{f"run__{key}": value}), tmp_path)


@pytest.mark.parametrize("how", ["be_killed", "hang", "flood_memory", "no_such_thing"])
def test_a_module_that_harms_its_process_costs_no_pose(tmp_path, how, leaves_no_process):
    harmful = {"_target_": "isolation.Harmful", "how": how, "at": 20}
    changes = {"run__isolation": "process", "run__step_deadline_s": 0.5}
    changes |= {"run__memory_limit_mb": 500, "allow_targets": ["fakes", "isolation"]}
    finished = run(config(slam__bright=harmful, **changes), tmp_path)
    assert finished.faults == () and len(finished.trajectory) == 100
    faults = [event for event in decisions(tmp_path) if event["event"] == "fault"]
    assert faults and "slam.bright failed while tracking" in faults[0]["what"]
    is_told = any("slam.bright could not give its map, which is lost" in e["what"] for e in faults)
    assert is_told is (how != "no_such_thing")  # a process that lives has its map


def test_ctrl_c_ends_the_run_and_its_processes(tmp_path, leaves_no_process):
    stopped = {"_target_": "isolation.InterruptsItsParent", "at": 20}
    changes = {"run__isolation": "process", "allow_targets": ["fakes", "isolation"]}
    before = signal.getsignal(signal.SIGINT)
    finished = run(config(slam__bright=stopped, **changes), tmp_path)
    assert finished.is_interrupted and 15 <= len(finished.trajectory) <= 25
    assert np.isfinite(finished.trajectory.T_world_base).all()
    assert signal.getsignal(signal.SIGINT) == before
