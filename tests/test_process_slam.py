"""Programs as SLAM modules: the protocol, what comes late, and what a program may do wrong."""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from driving import assert_exact, drive, events
from fakes import RIG, ExactModule, observation, true_pose
from isolation import limits
from test_module_answers import LAYERS

from sceneslam.answers import checked_layers
from sceneslam.config.check import check_node
from sceneslam.experiments.programs.case import run_case
from sceneslam.experiments.programs.hostile import KINDS, plan
from sceneslam.interfaces import ClosesLoops
from sceneslam.modules.slam.process.__main__ import FOLDER, build
from sceneslam.modules.slam.process.fields import answers, layers
from sceneslam.modules.slam.process.module import ProcessSlam
from sceneslam.modules.slam.process.protocol import (
    HEAD_BYTES,
    ProtocolError,
    pack,
    read_fields,
    read_head,
    text,
)
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, ModuleError
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.rig import Sensor

PROGRAM = Path(__file__).with_name("odometry_program.py")


@pytest.fixture
def started():
    """Give a function that starts a module on a command, and end its programs."""
    modules = []

    def start(*command, late_max_s=1.0, settings=None, **changes):
        bounds = limits(**({"step_deadline_s": 10.0} | changes))
        values = {"late_max_s": late_max_s, "limits": bounds, "closes_loops": True}
        values |= settings or {}
        modules.append(ProcessSlam(command=[*map(str, command)], **values))
        return modules[-1]

    yield start
    for module in modules:
        module.note_failure()


def echo(started, late=1, **options):
    module = started(sys.executable, PROGRAM, late, **options)
    module.activate(RIG)
    return module


@pytest.mark.parametrize(
    ("settings", "closes"),
    [({}, True), ({"closes_loops": True}, True), ({"closes_loops": False}, False)],
)
def test_a_program_closes_loops_unless_its_settings_say_otherwise(started, settings, closes):
    module = started(sys.executable, PROGRAM, 1, settings=settings)
    assert isinstance(module, ClosesLoops) and module.closes_loops is closes


@pytest.mark.parametrize("name", LAYERS)
def test_a_program_gives_a_layer_by_its_fields(name):
    given = {one: getattr(LAYERS[name], one) for one in LAYERS[name].__dataclass_fields__}
    reply = {f"{name}.{one}": np.asarray(value) for one, value in given.items()}
    found = getattr(checked_layers(layers(reply)), name)
    assert type(found) is type(LAYERS[name])
    for one, value in given.items():
        np.testing.assert_array_equal(getattr(found, one), value)
        assert isinstance(getattr(found, one), type(value))
    missing = next(iter(given))
    del reply[f"{name}.{missing}"]
    with pytest.raises(ProtocolError, match=f"whose {name} is incomplete: .*{missing}"):
        layers(reply)


ADRIFT = """
#include "sceneslam.hpp"
struct Adrift : sceneslam::Slam {
  std::string sensors() const override { return "odometry"; }
  void activate(const sceneslam::Fields&) override {}
  std::vector<sceneslam::Pose> track(const sceneslam::Fields& observation) override {
    sceneslam::Pose pose;
    pose.stamp_ns = *observation.values<std::int64_t>("stamp_ns");
    pose.has_covariance = pose.has_map_covariance = true;
    for (int k = 0; k < 36; k += 7) pose.covariance[k] = 2.0, pose.map_covariance[k] = 3.0;
    if (is_lost) pose.status = sceneslam::Status::lost, pose.can_begin = true;
    is_lost = true;
    return {pose};
  }
  bool is_lost = false;
};
int main() {
  Adrift adrift;
  return sceneslam::serve(adrift);
}
"""


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Give the C++ example, built."""
    if not any(map(shutil.which, ("c++", "g++", "clang++"))):
        pytest.skip("there is no C++ compiler")
    out = tmp_path_factory.mktemp("programs") / "wheels"
    build("wheels", out)
    return out


def test_program_in_cpp_says_all_that_a_pose_has(started, tmp_path):
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if compiler is None:
        pytest.skip("there is no C++ compiler")
    (tmp_path / "adrift.cpp").write_text(ADRIFT)
    command = [compiler, "-std=c++17", "-I", FOLDER, tmp_path / "adrift.cpp", "-o", "adrift"]
    subprocess.run(command, check=True, cwd=tmp_path)
    module = started(tmp_path / "adrift")
    module.activate(RIG)
    held, lost = (module.track(observation(index)) for index in range(2))
    assert held.status is TrackingStatus.TRACKING and not held.can_begin
    np.testing.assert_array_equal(held.covariance, 2.0 * np.eye(6))
    np.testing.assert_array_equal(held.map_covariance, 3.0 * np.eye(6))
    assert lost.status is TrackingStatus.LOST and lost.can_begin


def test_what_is_packed_is_read_again():
    fields = {
        "empty": np.zeros((0, 3), np.float32),
        "image": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
        "scalar": np.array(7, np.int64),
        "text": text("größer"),
    }
    data = b"".join(pack("track", 3, fields))
    head = read_head(data[:HEAD_BYTES])
    assert (head.kind, head.number, head.length) == ("track", 3, len(data) - HEAD_BYTES)
    found = read_fields(head, data[HEAD_BYTES:])
    assert list(found) == list(fields)
    for name, array in fields.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def test_no_damaged_message_is_read_as_anything_else_than_an_error():
    data = bytearray(b"".join(pack("track", 3, {"a": np.arange(5.0), "b": text("scan")})))
    rng = np.random.default_rng(0)
    for _ in range(500):
        torn = bytearray(data)
        torn[rng.integers(len(data))] ^= 1 << rng.integers(8)
        torn = torn[: rng.integers(HEAD_BYTES, len(data) + 1)]
        try:
            read_fields(read_head(bytes(torn[:HEAD_BYTES])), torn[HEAD_BYTES:])
        except ProtocolError:
            continue


def test_a_program_of_another_version_is_refused():
    data = b"".join(pack("hello", 1, {}))
    with pytest.raises(ProtocolError, match="speaks version 2, expected 1"):
        read_head(data.replace(b"SceneSL1", b"SceneSL2"))


def test_program_in_cpp_follows_the_wheels_and_maps(started, wheels):
    module = started(wheels)
    assert module.requires == (frozenset({Sensor.ODOMETRY}),)
    module.activate(RIG)
    module.set_scene("Bright")
    for index in range(10):
        tracking = module.track(observation(index + 3))
    expected = se3.inverse(true_pose(3 * 10**8)) @ true_pose(12 * 10**8)
    np.testing.assert_allclose(tracking.T_local_base, expected, atol=1e-9)
    assert tracking.status is TrackingStatus.TRACKING
    assert len(module.get_map().points.points) == 10
    module.shutdown()
    assert len(module.get_map().points.points) == 10


def test_header_for_cpp_is_short_enough_to_be_read():
    assert len((FOLDER / "sceneslam.hpp").read_text().splitlines()) <= 250


def test_a_silent_sensor_is_missing_in_what_a_program_gets(started, wheels):
    module = started(wheels)
    module.activate(RIG)
    module.track(observation(0))
    assert module.track(observation(1, has_odometry=False)).status is TrackingStatus.LOST


def test_an_exception_in_cpp_is_the_reason_that_is_given(started, wheels):
    module = started(wheels)
    module.activate(RIG)
    odd = replace(observation(0), T_odom_base=np.eye(4, dtype=np.float32))
    with pytest.raises(ModuleError, match="the program gave up: array is f4"):
        module.track(odd)


def test_rbpf_of_mrpt_maps_a_room(started, tmp_path):
    try:
        build("mrpt_rbpf", tmp_path / "rbpf")
    except ModuleError as error:
        pytest.skip(str(error).splitlines()[0])
    from sceneslam.testing.room import RIG as ROOM
    from sceneslam.testing.room import room_observation

    module = started(tmp_path / "rbpf", "5", "0.1")
    module.activate(ROOM)
    first = room_observation(0).T_odom_base
    for index in range(0, 60, 6):
        tracking = module.track(room_observation(index))
    truth = se3.inverse(first) @ room_observation(54).T_odom_base
    assert np.linalg.norm(tracking.T_local_base[:3, 3] - truth[:3, 3]) < 0.1
    grid = module.get_map().grid
    assert (grid.log_odds > 1.0).sum() > 50  # walls of 20 m in cells of 0.1 m
    assert len(module.get_trajectory().stamps_ns) > 1


def test_what_a_program_prints_does_not_get_between_the_messages(started):
    assert echo(started).track(observation(0)).status is TrackingStatus.TRACKING


def test_late_poses_are_carried_on_by_odometry_until_they_come(started):
    module = echo(started, late=4)
    for index in range(12):
        tracking = module.track(observation(index))
        expected = se3.inverse(true_pose(0)) @ true_pose(observation(index).stamp_ns)
        np.testing.assert_allclose(tracking.T_local_base, expected, atol=1e-9)
        is_answered = index % 4 == 3
        assert (tracking.status is TrackingStatus.TRACKING) == is_answered
    assert len(module.get_trajectory().stamps_ns) == 12


def test_a_program_that_corrects_its_map_did_not_move(started):
    module, T_new_old = echo(started), se3.from_xy_yaw(1.0, 0.0, 0.0)
    for index in range(4):
        seen = observation(index, has_odometry=False)
        module._pipeline.note(seen)
        if index < 3:
            T = true_pose(seen.stamp_ns)
            reply = {
                "stamps_ns": np.array([seen.stamp_ns]),
                "T_local_base": (T_new_old @ T if index == 2 else T)[None],
                "revision": np.array(index // 2),
            }
            module._take(reply)
    T_local_base = module._pipeline.report(seen).T_local_base
    np.testing.assert_allclose(T_local_base, T_new_old @ true_pose(seen.stamp_ns), atol=1e-9)


def test_poses_that_are_too_late_are_lost(started):
    module = echo(started, late=100, late_max_s=0.5)
    statuses = [module.track(observation(index)).status for index in range(10)]
    assert statuses[5] is TrackingStatus.DEGRADED
    assert statuses[6:] == [TrackingStatus.LOST] * 4


def test_a_new_session_is_a_new_run_of_the_program(started):
    module = echo(started)
    for _ in range(2):
        tracking = module.track(observation(5))
        np.testing.assert_allclose(tracking.T_local_base, np.eye(4), atol=1e-12)
        module.shutdown()
        module.activate(RIG)


@pytest.mark.parametrize("command", [[], ["no/such/program"]])
def test_a_command_that_cannot_be_run_is_refused(command):
    with pytest.raises(ConfigError, match="command: got"):
        ProcessSlam(command=command, late_max_s=1.0, limits=limits(), closes_loops=True)


def test_a_program_that_is_no_slam_program_is_refused_before_the_first_frame(started):
    with pytest.raises(
        ConfigError, match=r"command: .*greeting .*wrote bytes that are not a message: b'Usage"
    ):
        _ = started(
            "sh", "-c", "echo 'Usage: slam [options] and much more text than fits'"
        ).requires
    with pytest.raises(ConfigError, match=r"exit code 3; it wrote last: no licence"):
        _ = started("sh", "-c", "echo no licence >&2; exit 3").requires


AT_TRACK = {plan(seed)[0]: seed for seed in range(400) if plan(seed)[1] == "track"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_program_that_does_wrong_is_stopped_and_nothing_else(kind):
    """The experiment `programs` does this at every moment of a session."""
    bounds = limits(step_deadline_s=0.5, start_deadline_s=20.0, memory_limit_mb=400)
    case = run_case(AT_TRACK[kind], bounds)
    assert case.kind == kind
    assert case.sentence.startswith("the program ") and "\n" not in case.sentence
    assert case.harm == ()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_program_leaves_requests_to_stop_to_its_parent(started, number):
    module = echo(started)
    os.kill(module._running._popen.pid, number)
    assert module.track(observation(0)).status is TrackingStatus.TRACKING
    assert module.get_map() is not None


def test_a_program_that_is_killed_is_replaced_by_the_fallback_and_comes_back(started):
    module = started(sys.executable, PROGRAM, start_deadline_s=30.0)

    def feed(index):
        if index == 30:
            os.kill(module._running._popen.pid, signal.SIGKILL)
        while index == 40 and not module.is_ready:  # a recording does not wait for a start
            starting = [module._running._stdout] if module._running else []
            select.select(starting, [], [], 1.0 if starting else 0.01)
        return observation(index)

    _, atlas, log, _ = drive(
        {"bright": module, "dark": ExactModule()}, steps=100, feed=feed, retry_s=1.0
    )
    runs = [event["module"] for event in events(log, "handover")]
    assert runs == ["bright", "dark", "bright"]
    assert "was killed by signal 9" in events(log, "fault")[0]["what"]
    assert len(atlas.trajectory.stamps_ns) == 100
    assert_exact(atlas)


def test_a_program_is_run_only_where_the_command_line_allows_it():
    node = {
        "_target_": "sceneslam.modules.slam.process.module.ProcessSlam",
        "closes_loops": True,
        "command": ["./mine", "--fast"],
        "late_max_s": 1.0,
        "limits": {"_target_": "sceneslam.supervision.limits.Limits", **asdict(limits())},
    }
    check_node(node, "slam.only", allow=["./mine"])
    with pytest.raises(ConfigError, match=r"slam.only.command: .*allow_targets=\[./mine\]"):
        check_node(node, "slam.only", allow=["sh"])
    with pytest.raises(ConfigError, match=r"slam.only.command: got 7, allowed: a list, each text"):
        check_node(node | {"command": 7}, "slam.only", allow=["./mine"])


@pytest.mark.parametrize("more", [{}, {"can_begin": np.array([True, False])}])
def test_a_program_that_is_lost_may_say_that_it_could_begin(more):
    reply = {"stamps_ns": np.array([1, 2]), "T_local_base": np.tile(np.eye(4), (2, 1, 1))}
    lost = answers({**reply, "status": np.array([2, 2]), **more})
    assert [one.can_begin for one in lost] == [bool(more), False]
