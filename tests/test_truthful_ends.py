"""What a run's exit code and words rest on: failures, missing poses, rests, damaged parts."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from configured import config
from fakes import FakeSource
from omegaconf import OmegaConf
from ros_recordings import make_source
from test_preflight import CAMERA, write_folder

from sceneslam.app import run
from sceneslam.cli import carry_out
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.ros.writer import ObservationWriter
from sceneslam.sources.bag.frames import FrameTree
from sceneslam.sources.bag.recording import ChunkedRecording
from sceneslam.sources.contract.ordered import Ordered
from sceneslam.sources.simulator.cache import Cache
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.storage.folder import RunFolder
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.se3 import from_xy_yaw

QUIET = {"run__report": False, "policy__handover": "cold"}


def alone(**settings):
    """Return a run of one module, whatever the light."""
    exact = {"_target_": "fakes.ExactModule", **settings}
    return {"slam": {"only": exact}, "scenes": {"Bright": ["only"], "Dark": ["only"]}, **QUIET}


def shortfalls(folder, **changes):
    return run(config(**changes), folder).metrics["shortfalls"]


def test_whole_run_has_no_shortfall(tmp_path):
    assert shortfalls(tmp_path, **alone()) == []


def test_poses_that_are_missing_are_a_shortfall_with_its_reason(tmp_path):
    changes = alone(lost=list(range(8, 100))) | {"policy__lost_patience_s": 600.0}
    (sentence,) = shortfalls(tmp_path, **changes)
    assert sentence.startswith("only 8 % of the observations got a pose")
    assert "evaluation.coverage_min_ratio 0.9" in sentence
    assert sentence.endswith("without: 92 while only was lost")
    assert shortfalls(tmp_path, **changes, evaluation__coverage_min_ratio=0.05) == []


def test_poses_that_a_reference_lacks_are_told(tmp_path, monkeypatch):
    hydra = SimpleNamespace(
        runtime=SimpleNamespace(choices={}, output_dir=str(tmp_path)),
        overrides=SimpleNamespace(task=OmegaConf.create(["allow_targets=[fakes]"])),
    )
    monkeypatch.setattr("sceneslam.cli.HydraConfig.get", lambda: hydra)
    lost = {"slam": {"only": {"lost": list(range(8, 100))}}}
    changes = alone() | {"policy__lost_patience_s": 600.0}
    with closing(RunFolder.claim(tmp_path)):  # as Hydra's callback does
        ended = carry_out(OmegaConf.create(config(**changes) | {"reference": lost}))
    assert ended.code == 1
    (sentence,) = ended.errors
    assert sentence.startswith("reference: only 8 % of the observations got a pose")


@pytest.mark.parametrize("isolation", ["inline", "process"])
def test_module_that_failed_is_named_wherever_it_ran(tmp_path, isolation):
    fails = {"_target_": "fakes.ExactModule", "raises": [20]}
    found = shortfalls(tmp_path, slam__bright=fails, run__isolation=isolation, **QUIET)
    (sentence,) = [one for one in found if "bright" in one]
    assert sentence.startswith("slam.bright failed once at 2.0 s: failed while tracking")
    assert "out of memory" in sentence


def test_bridged_poses_say_why(tmp_path):
    changes = alone(lost=list(range(30, 33)))
    metrics = run(config(**changes | {"policy__handover": "warm"}), tmp_path).metrics
    assert metrics["bridged_why"] == {"while only was lost": 3}
    assert "3 poses bridged (3 while only was lost)" in "\n".join(summary_lines(metrics))


class Stamped(FakeSource):
    """Observations at given seconds, with odometry at given places."""

    def __init__(self, *times_and_places):
        super().__init__(steps=0, dark_from=0)
        self._given = times_and_places

    def __iter__(self):
        for time_s, x_m in self._given:
            stamp_ns = round(time_s * 1e9)
            yield Observation(stamp_ns=stamp_ns, T_odom_base=from_xy_yaw(x_m, 0.0, 0.0))


@pytest.mark.parametrize(
    ("after", "faults"),
    [
        ((163.0, 0.42), 0),  # the logger's own step: it rested
        ((163.0, 3.0), 1),  # it drove, and nothing was recorded
        ((1e9, 0.42), 1),  # no battery lasts as long: the clock was set
    ],
)
def test_rest_is_no_fault_but_a_silent_sensor_is(after, faults, caplog):
    time_s, x_m = after
    steps = [(0.0, 0.0), (0.2, 0.2), (0.4, 0.4), after, (time_s + 0.2, x_m + 0.2)]
    ordered = Ordered(Stamped(*steps))
    assert len(list(ordered)) == 5
    assert len(ordered.faults) == faults
    assert ("the robot rested" in caplog.text) == (not faults)


@pytest.mark.parametrize(("x_m", "faults"), [(0.5, 0), (0.7, 1)])
def test_a_rest_before_the_first_step_is_compared_with_those_after_it(x_m, faults):
    steps = [(0.0, 0.0), (60.0, x_m), (61.0, x_m + 0.52), (62.0, x_m + 1.02)]
    ordered = Ordered(Stamped(*steps))
    assert len(list(ordered)) == 4
    assert len(ordered.faults) == faults


class Kept(FakeSource):
    """Observations of a list."""

    def __init__(self, observations):
        super().__init__(steps=0, dark_from=0)
        self._given = observations

    def __iter__(self):
        return iter(self._given)


@pytest.mark.parametrize(("lost", "faults"), [(0, 0), (30, 1)])
def test_a_log_that_is_triggered_by_motion_rests_from_the_first_scan_on(
    shared_data, caplog, lost, faults
):
    """A scan per 0.5 m or 0.5 rad of ACES; the robot stands for 20 s near its start."""
    source = make_source("carmen", shared_data / "carmen_aces" / "aces.clf")
    kept = []
    for one in source:
        T_prev_curr = se3.inverse(kept[-1].T_odom_base) @ one.T_odom_base if kept else None
        if T_prev_curr is None or not se3.is_within(T_prev_curr, 0.5, 0.5):
            kept.append(one)
    del kept[100 : 100 + lost]
    ordered = Ordered(Kept(kept))
    assert list(ordered) == kept
    assert len(ordered.faults) == faults
    assert "the robot rested" in caplog.text and "times, at most for 38.9 s" in caplog.text


class Images(Stamped):
    """Images at given seconds, without odometry."""

    def __iter__(self):
        for time_s in self._given:
            image_bgr = np.ones((4, 4, 3), np.uint8)
            yield Observation(stamp_ns=round(time_s * 1e9), image_bgr=image_bgr)


def test_gap_without_odometry_stays_a_fault():
    ordered = Ordered(Images(0.0, 0.1, 60.0, 60.1))
    assert len(list(ordered)) == 4 and "no observation for 59.9 s" in ordered.faults[0]


def test_image_of_another_size_is_left_out_like_a_damaged_one(tmp_path):
    write_folder(tmp_path)
    cv2.imwrite(str(tmp_path / "rgb3.png"), np.zeros((10, 12, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "depth5.png"), np.zeros((10, 12), np.uint16))
    source = TumRgbd(str(tmp_path), CAMERA, 5000.0, [0.3, 8.0], 0.02)
    found = list(source)
    assert len(found) == 20 and found[3].image_bgr is None and found[5].depth_m is None
    (fault,) = source.faults
    assert fault.startswith("image left out, it has 12x10 pixels, not 64x48: 2 times, first at")


def test_list_with_a_byte_order_mark_is_read(tmp_path):
    write_folder(tmp_path)
    text = (tmp_path / "rgb.txt").read_bytes()
    (tmp_path / "rgb.txt").write_bytes(b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n"))
    assert TumRgbd(str(tmp_path), CAMERA, 5000.0, [0.3, 8.0], 0.02).length == 20


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_mcap_cut_within_its_only_chunk_is_read_as_far_as_it_is_whole(tmp_path, compression):
    from mcap.writer import CompressionType, Writer

    camera = Camera(size_wh=(160, 90), fx=100, fy=100, cx=80, cy=45)
    rig = Rig(sensors=frozenset({Sensor.IMAGE}), camera=camera)
    rng = np.random.default_rng(1)
    with (tmp_path / "whole.mcap").open("wb") as file:
        kind = CompressionType[compression.upper()]
        made = ObservationWriter(tmp_path / "other.mcap", rig=rig, image_format="png")
        for index in range(30):
            image = rng.integers(0, 256, (90, 160, 3), dtype=np.uint8)
            made.write(Observation(stamp_ns=10**12 + index * 10**8, image_bgr=image))
        made.close()
        _copy_into_one_chunk(
            tmp_path / "other.mcap", Writer(file, chunk_size=1 << 30, compression=kind)
        )
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(len(data) * 0.6)])
    source = make_source("mcap", tmp_path / "cut.mcap")
    assert 12 <= len(list(source)) <= 18
    assert "cut off after 1." in source.faults[0]


def _copy_into_one_chunk(path, writer):
    from mcap.reader import make_reader

    writer.start(profile="ros2")
    with path.open("rb") as file:
        ids = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                ids[channel.id], message.log_time, message.data, message.publish_time
            )
    writer.finish()


def test_base_frame_of_a_recording_without_frames_is_refused():
    frameless = ChunkedRecording([], None)
    assert FrameTree(frameless, None).base is None
    with pytest.raises(ConfigError, match=r"base_frame: got 'base_link'.*no /tf_static"):
        FrameTree(frameless, "base_link")


def test_checksum_that_is_garbage_makes_the_file_anew(tmp_path):
    cache, made = Cache(tmp_path), []

    def make(path):
        made.append(path)
        path.write_bytes(b"rendered")

    path = cache.fetch("a", {}, make)
    assert cache.fetch("a", {}, make) == path and len(made) == 1
    path.with_suffix(".crc32").write_bytes(b"\xff\xfe\x00garbage")
    assert cache.fetch("a", {}, make).read_bytes() == b"rendered" and len(made) == 2


@pytest.mark.parametrize(
    "obstacle", ["a file in its place", "a folder in the file's place", "full"]
)
def test_cache_that_cannot_be_written_names_what_to_set(tmp_path, obstacle):
    folder = tmp_path / "cache"
    if obstacle == "a file in its place":
        folder.write_text("")
    made = []

    def make(path):
        made.append(path)
        if obstacle == "full":
            raise OSError(28, "No space left on device")
        path.write_bytes(b"rendered")

    if obstacle == "a folder in the file's place":
        Cache(folder).fetch("a", {}, make).unlink()
        Path(made.pop()).with_name(next(folder.glob("*.crc32")).stem + ".mcap").mkdir()
    with pytest.raises(InputError, match=r"source.cache_dir.*SCENESLAM_CACHE_DIR=FOLDER"):
        Cache(folder).fetch("a", {}, make)
    assert len(made) == (obstacle == "full")  # else before anything is rendered
