"""A robot of another vendor's DDS: what a run hears of it, and what it hears of the run.

Needs a Python that has rclpy, with the sensor and navigation messages and mcap, in an environment
of its own: `pip install 'ros-rclpy[fastrtps]<8' 'ros-sensor-msgs<5.4' 'ros-nav-msgs<5.4' mcap`, and
its path in SCENESLAM_ROS_PYTHON. `pytest -rP` prints what was measured. On a machine that is busy,
SCENESLAM_ROS_RATE=0.25 has the robot drive at a quarter of its speed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_topics import write_raw
from ros_recordings import make_source

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.ros import names
from sceneslam.script import run
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

PYTHON = os.environ.get("SCENESLAM_ROS_PYTHON")
RATE = float(os.environ.get("SCENESLAM_ROS_RATE", "1.0"))
ROBOT = Path(__file__).parent / "ros_peer" / "robot.py"
SCENARIO = "+scenario=bright_to_dark"
COLOUR, DEPTH = "/camera/color/image/compressed", "/camera/depth/image/compressed"
LASER = ("+scenario=single", "slam@slam.only=laser")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PYTHON, reason="SCENESLAM_ROS_PYTHON names no Python with rclpy"),
]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    pytest.importorskip("cyclonedds")
    exact = (
        "source.laser=true",
        "+sinks@sinks.mcap=mcap",
        "sinks.mcap.depth_every=1",
        "run.report=false",
    )
    return run(SCENARIO, *exact, folder=tmp_path_factory.mktemp("recorded"))


def drive(
    recording: Path,
    folder: Path,
    steps: Sequence[dict[str, Any]] = (),
    scenario: Sequence[str] = (SCENARIO,),
) -> dict[str, Any]:
    """Run live while the robot plays the recording; return what the robot heard of the run."""
    heard_path, plan_path = folder / "heard.json", folder / "plan.json"
    plan_path.write_text(json.dumps({"rate": RATE, "steps": list(steps)}))
    environment = os.environ | {"ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
    words = ["source=ros2", "run=live", "run.end_after_s=12", "run.report=false"]
    live = subprocess.Popen(
        [sys.executable, "-m", "sceneslam", *scenario, *words, "+sinks@sinks.ros2=ros2",
         f"hydra.run.dir={folder / 'run'}"],
        env=environment,
    )  # fmt: skip
    assert PYTHON is not None
    robot = [PYTHON, str(ROBOT), str(recording), str(heard_path), str(plan_path)]
    subprocess.run(robot, env=environment, check=True, timeout=600)
    live.wait(120)
    heard: dict[str, Any] = json.loads(heard_path.read_text())
    heard["metrics"] = json.loads((folder / "run" / "metrics.json").read_text())
    lines = (folder / "run" / "events.jsonl").read_text().splitlines()
    heard["events"] = [json.loads(line) for line in lines]
    return heard


def true_path(recorded) -> Trajectory:
    return make_source("mcap", next(recorded.folder.rglob("*.mcap"))).ground_truth().trajectory


def told(heard: dict[str, Any]) -> Trajectory:
    """Return the poses that the robot heard, at the stamps of the recording."""
    poses = np.array([pose for pose in heard["poses"] if pose[0] >= heard["began_ns"]])
    stamps_ns = np.array([pose[0] for pose in heard["poses"] if pose[0] >= heard["began_ns"]])
    since_ns = (stamps_ns - heard["began_ns"]) * heard["rate"]
    T_map_base = [se3.from_quat_xyzw(pose[2:5], pose[5:9]) for pose in poses]
    return Trajectory(
        stamps_ns=since_ns.astype(np.int64) + heard["first_ns"], T_world_base=np.stack(T_map_base)
    )


def test_run_over_the_air_is_as_good_as_the_run_over_the_recording(recorded, tmp_path):
    heard = drive(next(recorded.folder.rglob("*.mcap")), tmp_path)
    truth = true_path(recorded)
    assert heard["metrics"]["coverage"] >= 0.99
    error_m = absolute_errors(told(heard), truth, 0.04).rmse_m
    assert error_m <= 1.5 * recorded.metrics["ate_online_m"]
    assert heard["scenes"] == ["Bright", "Dark"] and heard["modules"] == ["bright", "dark"]
    assert heard["tf"] == ["map -> odom"] and heard["tf_count"] == len(heard["poses"])
    assert heard["map"]["occupied"] > 100 and heard["map"]["free"] > 1000
    assert heard["points"] > 1000 and len(heard["path"]) > 0.5 * len(heard["poses"])
    assert heard["late"] == ["/map", "/sceneslam/module", "/sceneslam/path", "/sceneslam/scene"]


@pytest.mark.parametrize(
    ("robot", "without", "scenario"),
    [
        ("camera, laser, wheels, gyro", (), (SCENARIO,)),
        ("camera alone", ("/scan", "/odom", "/imu"), (SCENARIO,)),
        ("laser and wheels", (names.IMAGE, names.DEPTH, names.CAMERA_INFO, "/imu"), LASER),
    ],
)
def test_raw_topics_of_a_robot_give_what_their_recording_gives(
    recorded, tmp_path, robot, without, scenario
):
    raw = write_raw(next(recorded.folder.rglob("*.mcap")), tmp_path / "raw.mcap", without=without)
    alone = ("run.report=false", "~sinks@sinks.rerun")
    source = ("source=mcap", f"source.path={raw}")
    expected = run(*scenario, *source, *alone, folder=tmp_path / "recorded")
    heard, truth = drive(raw, tmp_path, scenario=scenario), true_path(recorded)
    online = Trajectory.read_tum(expected.folder / "trajectory_online.tum")
    recorded_m = absolute_errors(online, truth, 0.04).rmse_m
    error_m, metrics = absolute_errors(told(heard), truth, 0.04).rmse_m, heard["metrics"]
    latency = metrics["latency_ms"]
    print(  # noqa: T201
        f"{robot}: coverage {metrics['coverage']:.3f}, {metrics['dropped_images']} images dropped, "
        f"ATE {error_m:.4f} m, over the recording {recorded_m:.4f} m, "
        f"p50 {latency['p50']:.0f} ms, p99 {latency['p99']:.0f} ms"
    )
    assert metrics["coverage"] >= 0.99 and error_m <= 1.5 * recorded_m


def test_faults_of_a_robot_are_named_and_the_run_goes_on(recorded, tmp_path):
    steps = [
        {"at_s": 4, "do": "drop", "for_s": 1.6, "topics": [COLOUR]},
        {"at_s": 7, "do": "delay", "for_s": 0.6, "by_s": 0.8, "topics": [DEPTH]},
        {"at_s": 9, "do": "swap", "topics": ["/odom"]},
        {"at_s": 16, "do": "restart", "for_s": 2.0},
        {"at_s": 20, "do": "jump", "by_s": -3600.0},
    ]
    heard = drive(next(recorded.folder.rglob("*.mcap")), tmp_path, steps)
    events = [(one["event"], one.get("topic")) for one in heard["events"]]
    assert heard["metrics"]["coverage"] >= 0.98
    for expected in (
        ("stream_silent", COLOUR),
        ("stream_returned", COLOUR),
        ("late", DEPTH),
        ("unordered", "/odom"),
        ("silent", None),
        ("returned", None),
        ("clock_jump", COLOUR),
        ("clock_jump", "/odom"),
    ):
        assert expected in events, expected
    assert heard["poses"][-1][0] < heard["began_ns"] - 3000e9  # the robot's own clock, as it jumped
    assert {"Bright", "Dark"} <= set(heard["scenes"])


def test_operator_steers_from_rclpy(recorded, tmp_path):
    steps = [
        {"at_s": 3, "do": "say", "topic": "/sceneslam/select_scene", "text": "Dark"},
        {"at_s": 8, "do": "say", "topic": "/sceneslam/select_scene", "text": ""},
        {"at_s": 9, "do": "say", "topic": "/sceneslam/save_map", "text": "half"},
        {"at_s": 16, "do": "say", "topic": "/sceneslam/pause", "is_on": True},
        {"at_s": 17, "do": "say", "topic": "/sceneslam/pause", "is_on": False},
        {"at_s": 24, "do": "say", "topic": "/initialpose", "pose": [100.0, 200.0, 1.0]},
    ]
    heard = drive(next(recorded.folder.rglob("*.mcap")), tmp_path, steps)
    obeyed = [(e["command"], e["what"]) for e in heard["events"] if e["event"] == "command"]
    assert obeyed == [
        ("SelectScene", "Dark"),
        ("SelectScene", ""),
        ("SaveMap", "half"),
        ("Pause", "on"),
        ("Pause", "off"),
    ]
    assert heard["scenes"] == ["Bright", "Dark", "Bright", "Dark"]
    assert (tmp_path / "run" / "maps" / "half" / "grid.yaml").is_file()
    stamps_ns = np.array([pose[0] for pose in heard["poses"]])
    assert np.diff(stamps_ns).max() > 0.8e9 / RATE
    assert np.linalg.norm(np.array(heard["poses"][-1][2:4]) - (100.0, 200.0)) < 2.0
