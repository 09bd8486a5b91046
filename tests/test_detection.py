"""Detection scored alone decides as the full run does, a hundred times faster."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from configured import config as faked
from fakes import LiveFeedSource
from hydra import compose, initialize_config_module

from sceneslam.app import run
from sceneslam.config.resolve import resolved
from sceneslam.detection.features import RecordingFeatures
from sceneslam.detection.grid import Axis, try_all
from sceneslam.detection.run import _shares, detect
from sceneslam.experiments import side_by_side
from sceneslam.types.errors import ConfigError, ModuleError
from sceneslam.types.files import AppendedFile
from sceneslam.types.observation import SceneVote
from sceneslam.types.truth import GroundTruth, SceneChange

ROOT = Path(__file__).parents[1]
TINY = ("story=flicker", "source.camera.size_wh=[80,60]", "source.camera.rate_hz=10")
FULL = ("+scenario=single", "slam@slam.only=odometry", "detector=grey_mean", "run.report=false")
FULL = (*FULL, "~sinks@sinks.rerun", "+scenes={Bright:[only],Dark:[only]}", "run.progress=false")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def config(cache, monkeypatch):
    """Give what a command line would run, with a cache of its own."""
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(cache))

    def composed(*overrides):
        with initialize_config_module("sceneslam.conf", version_base="1.3"):
            return resolved(compose("config", overrides=["run.progress=false", *overrides]))

    return composed


def told(folder, *kinds):
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    return [event for event in events if event["event"] in kinds]


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("policy.confirm_window_s=0.3", "detector.threshold=110"),
        ("policy.confirm_window_s=0.0", "detector.threshold=130", "run.max_observations=150"),
        ("policy=bayes", "policy.scene_filter.correlation_s=0.1"),
    ],
)
def test_votes_and_scenes_are_those_of_the_full_run(config, tmp_path, words):
    words = (*TINY, *words)
    detect(config(*words, "run=detect_only"), tmp_path / "alone")
    finished = run(config(*FULL, *words), tmp_path / "full")
    alone = told(tmp_path / "alone", "vote", "scene")
    assert alone == told(tmp_path / "full", "vote", "scene") and len(alone) > 100
    metrics = json.loads((tmp_path / "alone" / "metrics.json").read_text())
    assert metrics["detection"] == finished.metrics["detection"]
    assert metrics["detection"]["missed"] is not None


def test_real_recording_in_less_light_is_decided_as_by_the_full_run(config, tmp_path, shared_data):
    path = shared_data / "tum_fr1_rpy"
    words = (f"source.path={path}", "source=tum_rgbd", "effects=lights_out")
    words = (*words, "effects.schedule=[[0.0,1.0],[0.08,0.0]]", "policy.confirm_window_s=0.2")
    words = (*words, "run.max_observations=60")
    detect(config(*words, "run=detect_only"), tmp_path / "alone")
    single = ("+scenario=single", "slam@slam.only=depth", *FULL[2:])
    run(config(*single, *words), tmp_path / "full")
    alone = told(tmp_path / "alone", "vote", "scene")
    assert alone == told(tmp_path / "full", "vote", "scene")
    assert [event["scene"] for event in told(tmp_path / "alone", "scene")] == ["Bright", "Dark"]


THRESHOLDS, WINDOWS = Axis(key="detector.threshold", values=[60, 100, 300]), [0.0, 1.0, -1.0]


def test_grid_gives_what_every_setting_gives_alone(config, tmp_path):
    words = (*TINY, "run=detect_only")
    axes = [THRESHOLDS, Axis(key="policy.confirm_window_s", values=WINDOWS)]
    tried = list(try_all(config(*words), axes))
    assert len(tried) == 9
    for one in tried:
        setting = [f"{key}={value}" for key, value in one.setting.items()]
        if one.error:
            with pytest.raises(ConfigError, match=r"threshold: got 300|window_s: got -1"):
                detect(config(*words, *setting), tmp_path)
        else:
            detect(config(*words, *setting), tmp_path)
            assert json.loads((tmp_path / "metrics.json").read_text()) == one.metrics
    assert sum(bool(one.error) for one in tried) == 5


@pytest.mark.parametrize(
    ("name", "ending"), [("Dark", ", 100.0 % right"), ("Night", ", 50.0 % right"), (None, "")]
)
def test_share_of_right_votes_is_said_by_the_names_of_the_truth(name, ending):
    votes = [SceneVote(stamp_ns=at, scene="Cellar" if at else "Hall") for at in (0, 1)]
    scenes = (SceneChange(stamp_ns=0, scene="Bright"), SceneChange(stamp_ns=1, scene="Dark"))
    names = {"Hall": "Bright", "Cellar": name} if name else {"Hall": "Hall", "Cellar": "Cellar"}
    shares = _shares(votes, GroundTruth(scenes=scenes), names)
    assert shares == f"Hall 50.0 %, Cellar 50.0 %{ending}"


def test_recording_is_read_once_for_all_settings(config, tmp_path, cache, monkeypatch):
    words = (*TINY, "run=detect_only")
    detect(config(*words), tmp_path)
    monkeypatch.setattr("sceneslam.detection.recall.measure", None)  # a second time fails
    detect(config(*words, "detector.threshold=60", "run.progress=true"), tmp_path)
    with pytest.raises(TypeError):
        detect(config(*words, "run.max_observations=50"), tmp_path)  # other images


def test_features_are_measured_again_after_an_edit(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(tmp_path)
    code, exposures = tmp_path / "my_own_light.py", tmp_path / "exposures.txt"
    source = {"_target_": "fakes.FakeSource", "steps": 20, "dark_from": 9}
    target = "sceneslam.sources.changes.exposure_times.ExposureTimes"
    effects = {"_target_": target, "path": str(exposures), "reference_s": None}
    settings = faked(
        source=source,
        effects=effects,
        run__mode="detect_only",
        allow_targets=["fakes", "my_own_light"],
    )
    for text in ("0.0 0.01\n", "0.0 0.02\n"):
        for version in ("1", "2"):
            exposures.write_text(text)
            code.write_text(f"version = {version}\n")
            for _ in range(2):
                detect(settings, tmp_path / "run")
    assert len(list((tmp_path / "cache").glob("*.npz"))) == 4


def test_events_that_a_full_disk_cuts_off_are_a_fault(config, tmp_path, monkeypatch):
    def fail(file, piece):
        raise OSError("no space left on device")

    monkeypatch.setattr(AppendedFile, "append", fail)
    (fault,) = detect(config(*TINY, "run=detect_only"), tmp_path)
    assert fault == "events.jsonl is not complete: OSError: no space left on device"


def test_thousand_settings_take_seconds(config):
    axes = [
        Axis(key="detector.threshold", values=range(40, 140)),
        Axis(key="policy.confirm_window_s", values=[k / 10 for k in range(10)]),
    ]
    words = (*TINY, "run=detect_only")
    next(try_all(config(*words), axes))  # the recording is read here
    began_s = process_time()
    assert len(list(try_all(config(*words), axes))) == 1000
    assert process_time() - began_s < 10.0


def test_features_are_kept_to_the_bit(tmp_path):
    features = RecordingFeatures(
        stamps_ns=np.array([1, 2**60 + 1]),
        values=np.array([[0.1], [np.pi]]),
        is_there=np.array([False, True]),
        scenes=(SceneChange(stamp_ns=2**60 + 1, scene="Bright"),),
    )
    features.write(tmp_path / "features.npz")
    read = RecordingFeatures.read(tmp_path / "features.npz")
    for name in ("stamps_ns", "values", "is_there"):
        assert np.array_equal(getattr(read, name), getattr(features, name))
    assert read.scenes == features.scenes


def torn(path):
    path.write_bytes(path.read_bytes()[:-100])


def emptied(path):
    path.write_bytes(b"")


def with_a_wrong_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize("harm", [torn, emptied, with_a_wrong_byte])
def test_damaged_features_are_computed_again(config, tmp_path, monkeypatch, harm, caplog):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(tmp_path / "cache"))
    words = config(*TINY, "run=detect_only", "run.max_observations=20")
    detect(words, tmp_path / "first")
    (kept,) = (tmp_path / "cache").glob("*.npz")
    whole = kept.read_bytes()
    harm(kept)
    detect(words, tmp_path / "second")
    assert "cached features are damaged" in caplog.text
    assert len(RecordingFeatures.read(kept).stamps_ns) == 20 and len(kept.read_bytes()) == len(
        whole
    )
    first, second = (tmp_path / name / "events.jsonl" for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()


def test_features_that_cannot_be_kept_cost_no_result(config, tmp_path, monkeypatch, caplog):
    def fail(features, path):
        raise OSError("no space left on device")

    monkeypatch.setattr(RecordingFeatures, "write", fail)
    words = config(*TINY, "run=detect_only", "run.max_observations=15")
    assert detect(words, tmp_path) == () and (tmp_path / "metrics.json").is_file()
    assert "the features are not kept" in caplog.text and "no space left" in caplog.text


@pytest.mark.parametrize("method", ["activate", "get_features", "decide"])
def test_a_detector_that_fails_is_one_sentence(config, tmp_path, monkeypatch, method):
    def fail(*_):
        raise OSError("the camera is gone")

    monkeypatch.setattr(f"sceneslam.modules.detectors.grey_mean.GreyMean.{method}", fail)
    words = config(*TINY, "run=detect_only", "run.max_observations=12")
    with pytest.raises(ModuleError, match="the detector failed: OSError: the camera is gone"):
        detect(words, tmp_path)


def test_live_source_is_refused_by_a_run_without_slam_and_closed(tmp_path, monkeypatch):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(LiveFeedSource, "is_open", True)
    source = {"_target_": "fakes.LiveFeedSource", "steps": 9, "dark_from": 5}
    with pytest.raises(ConfigError, match=r"run\.mode: got 'detect_only', allowed: live, since"):
        detect(faked(source=source, run__mode="detect_only"), tmp_path / "run")
    assert not LiveFeedSource.is_open and list(tmp_path.iterdir()) == []


def test_detector_without_features_is_refused(config, tmp_path):
    words = ("detector._target_=sceneslam.modules.slam.odometry.Odometry", "run=detect_only")
    with pytest.raises(ConfigError, match="detector"):
        detect(config(*words), tmp_path)


def test_modules_are_not_built_by_a_run_without_slam(config, tmp_path):
    with pytest.raises(ConfigError, match=r"run\.mode"):
        run(config("+scenario=bright_to_dark", "run=detect_only"), tmp_path)


@pytest.mark.parametrize("key", ["atlas.load", "atlas.save"])
def test_map_is_refused_by_a_run_without_slam(config, tmp_path, key):
    with pytest.raises(ConfigError, match=rf"{key}: got 'map', allowed: null where run\.mode is"):
        detect(config(*TINY, "run=detect_only", f"{key}=map"), tmp_path / "alone")
    assert list(tmp_path.iterdir()) == []


def test_reference_is_refused_by_a_run_without_slam(config, tmp_path):
    with pytest.raises(ConfigError, match=r"reference: got .*, allowed: null where run\.mode is"):
        detect(config(*TINY, "run=detect_only", "reference={seed:1}"), tmp_path / "alone")


def swept(cache, folder, *words):
    command = [sys.executable, "-m", "sceneslam", "-m", *TINY, "run=detect_only", *words]
    done = subprocess.run(
        [*command, "hydra.sweep.dir=out"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "SCENESLAM_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    with (folder / "out" / "table.csv").open(newline="") as file:
        return done, list(csv.DictReader(file))


def test_command_sweeps_settings_and_recordings_into_one_table(cache, tmp_path):
    settings = ("detector.threshold=range(80,121,10)", "policy.confirm_window_s=0.5,1,-1")
    done, rows = swept(cache, tmp_path, "run.max_observations=100,200", *settings)
    assert done.returncode == 1 and "30 settings" in done.stdout, done.stderr
    observed = [row["observations"] for row in rows if row["status"] == "done"]
    assert observed == ["100"] * 10 + ["200"] * 10
    failed = [row for row in rows if row["status"] == "failed"]
    assert len(failed) == 10 and {row["policy.confirm_window_s"] for row in failed} == {"-1"}
    assert (tmp_path / "out" / "index.html").is_file()


def test_reading_that_is_measured_takes_no_cached_features(tmp_path, recording, monkeypatch):
    monkeypatch.setenv("SCENESLAM_CACHE_DIR", str(tmp_path / "cache"))
    room = side_by_side.Recording(source=("source=mcap", f"source.path={recording}"), modules=())
    assert side_by_side.run(room, "reading", tmp_path, None)[0] == "reading"
    assert not (tmp_path / "cache").exists()


def test_one_limit_of_a_rule_and_places_of_lists_are_swept(config):
    limits = Axis(key="detector.rules.dark.when.grey_mean", values=[[None, 1.0], [None, 250.0]])
    tried = list(try_all(config(*TINY, "run=detect_only", "detector=rules"), [limits]))
    assert [one.error for one in tried] == ["", ""] and tried[0].metrics != tried[1].metrics
    words = (*TINY, "run=detect_only", "detector=manual", "detector.schedule=[[0.0,Dark]]")
    names = Axis(key="detector.schedule.0.1", values=["Bright", "Dark"])
    found = [one.metrics["detection"] for one in try_all(config(*words), [names])]
    assert found[0]["false"] != found[1]["false"]


def test_lists_and_flags_are_swept_like_numbers(cache, tmp_path):
    lists = "detector.features=[grey_mean,'corner_count',depth_ratio],[grey_mean,depth_ratio]"
    flags = "run.progress=true,false"
    _, rows = swept(cache, tmp_path, "detector=rules", lists, flags, "run.max_observations=20")
    assert [row["run.progress"] for row in rows] == ["True"] * 2 + ["False"] * 2
    assert rows[0]["detector.features"] == "[grey_mean, corner_count, depth_ratio]"
    assert [row["status"] for row in rows] == ["done", "failed"] * 2


def test_cells_without_a_swept_key_are_left_out_and_named(cache, tmp_path):
    words = ("detector=grey_mean,learned", "detector.threshold=80,100", "run.max_observations=20")
    done, rows = swept(cache, tmp_path, *words)
    told_of = [(row["detector"], row["detector.threshold"]) for row in rows]
    assert told_of == [("grey_mean", "80"), ("grey_mean", "100"), ("learned", "")]
    assert done.returncode == 0 and "left out: detector.threshold" in done.stdout, done.stderr


def test_swept_key_that_no_cell_has_is_named(cache, tmp_path):
    with pytest.raises(FileNotFoundError):  # there is no table
        swept(cache, tmp_path, "detector=grey_mean,learned", "detector.treshold=80,100")
