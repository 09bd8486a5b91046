"""The simulator as a source: its contract, its cache and its configuration."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from sceneslam.config.resolve import resolved
from sceneslam.interfaces import Source
from sceneslam.sources.simulator import source as module
from sceneslam.sources.simulator.source import Simulator
from sceneslam.types.errors import ConfigError
from sceneslam.types.rig import Sensor

_YAML = Path(__file__).resolve().parents[1] / "conf" / "source" / "two_rooms.yaml"


_GYRO = ("rate_hz", "bias_radps", "noise_radps", "bias_walk_radps_per_sqrt_s")


def make(folder: Path, **changes: Any) -> Simulator:
    config = OmegaConf.create({"story": "bright_to_dark", "lights": "story", "seed": 0})
    config["source"] = OmegaConf.load(_YAML)
    plain: Any = OmegaConf.to_container(config, resolve=True)
    arguments = plain["source"] | {"cache_dir": str(folder), "workers": 1, "duration_s": 0.5}
    arguments["camera"]["size_wh"] = [96, 72]
    arguments.pop("_target_")
    return Simulator(**(arguments | changes))


@pytest.fixture(scope="module", autouse=True)
def light_once() -> Iterator[None]:
    """Light each place once for all tests of this file: it takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "build_place", cache(module.build_place))
        patch.setattr(module, "light_place", cache(module.light_place))
        yield


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Simulator:
    source = make(tmp_path_factory.mktemp("cache"), laser=True)
    list(source)
    return source


def same(first: Any, second: Any) -> bool:
    if first is None or second is None:
        return first is second
    return np.array_equal(first, second, equal_nan=True)


def test_two_rooms_is_a_source(rendered: Simulator) -> None:
    assert isinstance(rendered, Source)


def test_rig_and_length_are_known_without_rendering(tmp_path: Path) -> None:
    source = make(tmp_path, duration_s=None)
    assert source.rig.camera is not None
    assert source.rig.camera.size_wh == (96, 72)
    assert Sensor.SCAN not in source.rig.sensors
    assert 600 <= source.length <= 1050
    assert list(tmp_path.iterdir()) == []


def test_as_many_observations_come_as_were_announced(rendered: Simulator) -> None:
    stamps = [observation.stamp_ns for observation in rendered]
    assert len(stamps) == rendered.length == 15
    assert np.all(np.diff(stamps) > 0)
    assert list(rendered.faults) == []


def test_observations_hold_what_the_rig_says(rendered: Simulator) -> None:
    first = next(iter(rendered))
    assert all(first.has(sensor) for sensor in rendered.rig.sensors)
    assert first.image_bgr is not None
    assert first.image_bgr.shape == (72, 96, 3)
    assert first.depth_m is not None
    assert first.depth_m.dtype == np.float32


def test_scans_come_ten_times_a_second_with_their_own_stamps(rendered: Simulator) -> None:
    scans = [observation.scan for observation in rendered if observation.scan]
    assert [len(scan.ranges_m) for scan in scans] == [1081] * 5
    assert np.allclose(np.diff([scan.stamp_ns for scan in scans]), 1e8)


def test_gyro_samples_lie_between_observations(rendered: Simulator) -> None:
    parts = [observation.gyro_base for observation in rendered]
    times = [part[:, 0] for part in parts if part is not None]
    assert sum(len(part) for part in times) == 47  # 0 to 14 / 30 s at 100 Hz
    assert all(np.all((part <= 1e-9) & (part > -1 / 30 - 1e-9)) for part in times)


def test_true_poses_are_those_of_the_path_at_the_stamps(rendered: Simulator) -> None:
    truth = rendered.ground_truth().trajectory
    stamps = [observation.stamp_ns for observation in rendered]
    assert truth.stamps_ns.tolist() == stamps
    assert truth.T_world_base.dtype == np.float64


def test_the_same_configuration_gives_the_same_bytes_with_any_number_of_workers(
    rendered: Simulator, tmp_path: Path
) -> None:
    crowd = make(tmp_path, laser=True, workers=3)
    for ours, theirs in zip(rendered, crowd, strict=True):
        assert same(ours.image_bgr, theirs.image_bgr)
        assert same(ours.depth_m, theirs.depth_m)
        assert same(ours.T_odom_base, theirs.T_odom_base)
        assert same(ours.gyro_base, theirs.gyro_base)
        assert (ours.scan is None) == (theirs.scan is None)
        if ours.scan and theirs.scan:
            assert same(ours.scan.ranges_m, theirs.scan.ranges_m)


def test_another_seed_gives_another_recording(rendered: Simulator, tmp_path: Path) -> None:
    other = make(tmp_path, seed=1, duration_s=0.1)
    assert not same(next(iter(rendered)).image_bgr, next(iter(other)).image_bgr)


def test_a_second_source_reads_the_cached_file(tmp_path: Path) -> None:
    list(make(tmp_path, duration_s=0.1))
    (file,) = tmp_path.glob("*.mcap")
    before = file.stat().st_mtime_ns
    list(make(tmp_path, duration_s=0.1))
    assert file.stat().st_mtime_ns == before


@pytest.mark.parametrize("progress", [True, False])
def test_rendering_shows_a_bar_where_the_run_shows_its_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], progress: bool
) -> None:
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        config = resolved(compose("config", overrides=[f"run.progress={str(progress).lower()}"]))
    list(make(tmp_path, duration_s=0.1, progress=config["source"]["progress"]))
    assert ("rendering bright_to_dark" in capsys.readouterr().err) is progress


def test_a_damaged_cache_file_is_rendered_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first = [observation.image_bgr for observation in make(tmp_path, duration_s=0.1)]
    (file,) = tmp_path.glob("*.mcap")
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with caplog.at_level(logging.WARNING):
        again = [observation.image_bgr for observation in make(tmp_path, duration_s=0.1)]
    assert "damaged" in caplog.text
    assert all(same(one, other) for one, other in zip(first, again, strict=True))


def test_an_interrupted_rendering_leaves_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sceneslam.sources.simulator.source.changes_of", interrupt)
    with pytest.raises(KeyboardInterrupt):
        list(make(tmp_path, duration_s=0.1))
    assert {path.suffix for path in tmp_path.iterdir()} <= {".lock"}


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"duration_s": 0.01}, "duration_s"),
        ({"story": "bright_to_drak"}, "story"),
        ({"lights": "dim"}, "lights"),
        ({"workers": 0}, "workers"),
        ({"duration_s": -1.0}, "duration_s"),
        ({"camera": {"size_wh": [640, 480]}}, "camera.fov_deg"),
        ({"gyro": dict.fromkeys(_GYRO, 0.0)}, "gyro.rate_hz"),
        ({"gyro": {"rate": 1.0}}, "gyro.rate"),
    ],
)
def test_a_wrong_argument_is_named(tmp_path: Path, changes: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make(tmp_path, **changes)
    assert caught.value.key == key
