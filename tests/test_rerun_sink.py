import os
import re
import signal
import socket
import sys
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from evaluation_runs import first_events, loop, poseless_run, switch_events, switched_run, votes

from sceneslam.interfaces import ResultSink, Sink
from sceneslam.sinks import rerun_layout as at
from sceneslam.sinks.rerun import RerunSink
from sceneslam.sinks.rerun_legend import legend
from sceneslam.sinks.rerun_viewer import Viewer
from sceneslam.types.errors import ConfigError
from sceneslam.types.files import part_of
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Rig, Sensor
from sceneslam.types.truth import GroundTruth

RIG = Rig(
    sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.SCAN}),
    camera=Camera(size_wh=(64, 48), fx=50.0, fy=50.0, cx=32.0, cy=24.0),
    laser=Laser(),
)


def sink_to(path, **changes):
    values = {"viewer": None, "required": False}
    values |= {"image_every": 1, "depth_every": 5, "scan_every": 5}
    return RerunSink(path, **(values | {"jpeg_quality": 80, "map_colors": "modules"} | changes))


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
    assert isinstance(sink, Sink) and isinstance(sink, ResultSink)
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
    size = part_of(path).stat().st_size
    sink.write_result(switched_run())
    sink.close()
    assert path.stat().st_size > size + 20_000  # the map and the errors
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
    sink.write_result(poseless_run(1))
    sink.close()
    assert (tmp_path / "run.rrd").stat().st_size > 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth_every": 0},
        {"image_every": -1},
        {"scan_every": 0},
        {"jpeg_quality": 101},
        {"map_colors": "red"},
    ],
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


@pytest.mark.parametrize("path", [None, "run.rrd"])
def test_a_sink_has_either_a_file_or_a_viewer(path):
    viewer = None if path is None else Viewer(port=9876, web_port=None)
    with pytest.raises(ConfigError, match="path"):
        sink_to(path, viewer=viewer)


def test_recording_writes_files_and_a_viewer_does_not():
    assert sink_to("run.rrd").writes_files
    assert not sink_to(None, viewer=Viewer(port=9876, web_port=None)).writes_files


def test_ports_of_the_viewer_are_checked():
    with pytest.raises(ConfigError, match="web_port"):
        Viewer(port=9876, web_port=80)


def test_without_a_display_the_key_for_a_page_is_named(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"as sinks\.live\.viewer\.web_port=9090: there is no"):
        Viewer(port=free_ports(1)[0], web_port=None).open()


def test_a_port_that_something_else_listens_on_is_no_port_for_a_page():
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken, (free,) = other.getsockname()[1], free_ports(1)
        with pytest.raises(ConfigError, match=f"web_port: got {taken}, allowed: a port that"):
            Viewer(port=free, web_port=taken).open()


def test_viewer_shows_a_run_to_this_machine_only_and_stays_for_the_next(tmp_path, capfd):
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    ports = free_ports(2)
    viewer = Viewer(port=ports[0], web_port=ports[1])
    sink = sink_to(None, viewer=viewer)
    try:
        sink.open(RIG, tmp_path)
        sink.write(observe(0), loop(1).T_world_base[0], "rgbd")
        sink.close()
        assert {listening_on(port) for port in ports} == {"0100007F"}  # 127.0.0.1
        assert f"http://127.0.0.1:{ports[1]}/" in capfd.readouterr().err
        second = Viewer(port=ports[0], web_port=ports[1])
        assert "stays open" not in second.open() and second.process is None
    finally:
        os.killpg(viewer.process.pid, signal.SIGKILL)
        viewer.process.wait()
    assert list(tmp_path.iterdir()) == []


def free_ports(count):
    sockets = [socket.socket() for _ in range(count)]
    for held in sockets:
        held.bind(("127.0.0.1", 0))
    ports = [held.getsockname()[1] for held in sockets]
    for held in sockets:
        held.close()
    return ports


def listening_on(port):
    """The address, as /proc has it, on which a port of this machine is listened to."""
    table = Path("/proc/net/tcp")
    if not table.exists():
        pytest.skip("sockets are not listed here")
    return re.search(rf"([0-9A-F]{{8}}):{port:04X} 00000000:0000 0A", table.read_text())[1]


def test_legend_has_a_line_of_its_colour_for_every_name():
    picture = legend({"bright": (0, 114, 178), "dark": (213, 94, 0)})
    rows = [picture[16 + 32 * row, 20].tolist() for row in range(2)]
    assert rows == [[0, 114, 178], [213, 94, 0]]
    assert picture[:, 52:].any()  # the names


def stood_in_for(monkeypatch):
    """Return a sink and the recording that stands in for Rerun's, which need not be installed."""
    monkeypatch.setitem(sys.modules, "rerun", MagicMock())
    sink = sink_to("run.rrd")
    sink._recording = MagicMock()
    return sink, sink._recording


def test_events_from_before_the_first_observation_do_not_move_the_time_line(monkeypatch):
    sink, recording = stood_in_for(monkeypatch)
    warning = {"event": "warning", "stamp_ns": 0, "what": "a lens"}
    sink.write_event(warning)
    for stamp_ns in (10**18, 10**18 + 10**9):
        sink.write(Observation(stamp_ns=stamp_ns), None, "")
    sink.write_event(warning)
    times_s = [call.kwargs["duration"] for call in recording.set_time.call_args_list]
    assert times_s == [0.0, 0.0, 1.0, 0.0]


def test_curve_of_a_scene_falls_when_another_one_is_voted_for(monkeypatch):
    sink, recording = stood_in_for(monkeypatch)
    for scene in ("Bright", "Bright", "Dark"):
        sink.write_event({"event": "vote", "stamp_ns": 0, "scene": scene})
    levels = [call.args[0][0] for call in sink._rr.Scalars.call_args_list]
    assert levels == [1.0, 1.0, 1.0, 0.0]
    assert recording.log.call_args.args[0] == f"{at.VOTES}/Bright"


def test_tracker_states_do_not_crowd_the_decisions(tmp_path):
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    sink, logged = sink_to("run.rrd"), []
    sink.open(RIG, tmp_path)
    log = sink._recording.log
    sink._recording.log = lambda path, *a, **k: logged.append(path) or log(path, *a, **k)
    for event in ("tracking", "decision"):
        sink.write_event({"event": event, "stamp_ns": 1, "status": "tracking", "to": "bright"})
    sink.close()
    assert logged == ["tracking", "decisions"]
