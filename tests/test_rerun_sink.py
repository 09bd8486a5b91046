import sys

import numpy as np
import pytest
from evaluation_runs import first_events, loop, switch_events, votes

from sceneslam.interfaces import Sink
from sceneslam.sinks.rerun import RerunSink
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Rig, Sensor
from sceneslam.types.truth import GroundTruth

RIG = Rig(
    sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.SCAN}),
    camera=Camera(size_wh=(64, 48), fx=50.0, fy=50.0, cx=32.0, cy=24.0),
    laser=Laser(),
)


def sink_to(path, **changes):
    values = {"required": False, "image_every": 1, "depth_every": 5, "scan_every": 5}
    return RerunSink(path, **(values | {"jpeg_quality": 80} | changes))


def observe(stamp_ns: int) -> Observation:
    ranges_m = np.full(90, 2.0, np.float32)
    ranges_m[:5] = np.inf
    scan = LaserScan(
        stamp_ns=stamp_ns, ranges_m=ranges_m, angle_min_rad=-1.0, angle_step_rad=0.02,
        range_min_m=0.1, range_max_m=8.0,
    )  # fmt: skip
    return Observation(
        stamp_ns=stamp_ns,
        image_bgr=np.full((48, 64, 3), stamp_ns // 10**8 % 255, np.uint8),
        depth_m=np.full((48, 64), 1.5, np.float32),
        scan=scan,
    )


def test_recording_holds_images_poses_and_detector_values(tmp_path):
    rerun = pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    path = tmp_path / "deep" / "run.rrd"
    sink = sink_to("deep/run.rrd")
    assert isinstance(sink, Sink)
    sink.open(RIG, tmp_path)
    path_of_robot = loop(30)
    for event in [*first_events(), *votes(30, 15)]:
        sink.write_event(event)
    for k, stamp_ns in enumerate(path_of_robot.stamps_ns.tolist()):
        pose = None if k == 0 else path_of_robot.T_world_base[k]
        sink.write(observe(stamp_ns), pose, "rgbd" if k < 20 else "laser")
        if k == 20:
            for event in switch_events(stamp_ns, stamp_ns):
                sink.write_event(event)
    sink.write_truth(GroundTruth(trajectory=path_of_robot))
    sink.close()
    sink.close()
    assert path.stat().st_size > 10_000
    assert path.read_bytes()[:4] in (b"RRF2", b"RRIO", b"RRF0")
    assert rerun.__version__


def test_observation_with_nothing_in_it_is_written(tmp_path):
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    sink = sink_to("run.rrd")
    sink.open(Rig(sensors=frozenset()), tmp_path)
    sink.write(Observation(stamp_ns=1), None, "")
    sink.write_truth(GroundTruth())
    sink.close()
    assert (tmp_path / "run.rrd").stat().st_size > 0


@pytest.mark.parametrize(
    "wrong", [{"depth_every": 0}, {"image_every": -1}, {"scan_every": 0}, {"jpeg_quality": 101}]
)
def test_arguments_out_of_range_are_named(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        sink_to("run.rrd", **wrong)


@pytest.fixture
def without_rerun(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)  # importing it raises ImportError


def test_missing_extra_says_what_to_install_where_it_is_required(without_rerun):
    with pytest.raises(ConfigError, match=r"pip install 'sceneslam\[rerun\]'"):
        sink_to("run.rrd", required=True)


def test_missing_extra_writes_nothing_where_it_is_not_required(without_rerun, tmp_path):
    sink = sink_to("run.rrd")
    sink.open(RIG, tmp_path)
    sink.write(observe(0), loop(1).T_world_base[0], "rgbd")
    sink.write_event(first_events()[0])
    sink.write_truth(GroundTruth(trajectory=loop(3)))
    sink.close()
    assert list(tmp_path.iterdir()) == []
