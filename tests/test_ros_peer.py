"""A robot of another vendor's DDS: what a run hears of it, and what it hears of the run.

Needs a Python that has rclpy, with the sensor and navigation messages and mcap, in an environment
of its own: `pip install 'ros-rclpy[fastrtps]<8' 'ros-sensor-msgs<5.4' 'ros-nav-msgs<5.4' mcap`, and
its path in SCENESLAM_ROS_PYTHON. On a machine that is busy, SCENESLAM_ROS_RATE=0.25 has the robot
drive at a quarter of its speed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ros_recordings import make_source

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.script import run
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

PYTHON = os.environ.get("SCENESLAM_ROS_PYTHON")
RATE = os.environ.get("SCENESLAM_ROS_RATE", "1.0")
PEER = Path(__file__).with_name("ros_peer.py")
SCENARIO = "+scenario=bright_to_dark"


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON, reason="SCENESLAM_ROS_PYTHON names no Python with rclpy")
def test_run_over_the_air_is_as_good_as_the_run_over_the_recording(tmp_path):
    pytest.importorskip("cyclonedds")
    assert PYTHON is not None
    exact = ("+sinks@sinks.mcap=mcap", "sinks.mcap.depth_every=1", "run.report=false")
    recorded = run(SCENARIO, *exact, folder=tmp_path / "a")
    recording = next((tmp_path / "a").rglob("*.mcap"))
    domain = str(100 + os.getpid() % 100)
    heard_path = tmp_path / "heard.json"
    words = ["source=ros2", "run=live", "run.end_after_s=15", "run.report=false"]
    live = subprocess.Popen(
        [sys.executable, "-m", "sceneslam", SCENARIO, *words, "+sinks@sinks.ros2=ros2",
         "run.isolation=process", f"hydra.run.dir={tmp_path / 'b'}"],
        env=os.environ | {"ROS_DOMAIN_ID": domain},
    )  # fmt: skip
    subprocess.run(
        [PYTHON, str(PEER), str(recording), str(heard_path), RATE],
        env=os.environ | {"ROS_DOMAIN_ID": domain},
        check=True,
        timeout=600,
    )
    live.wait(60)
    heard = json.loads(heard_path.read_text())
    metrics = json.loads((tmp_path / "b" / "metrics.json").read_text())
    assert metrics["coverage"] >= 0.99
    # What it heard, on the recording's clock, against what the recording knows to be true.
    poses = np.array([pose for pose in heard["poses"] if pose[0] >= heard["began_ns"]])
    since_ns = (poses[:, 0] - heard["began_ns"]) * heard["rate"]
    stamps_ns = since_ns.astype(np.int64) + heard["first_ns"]
    T_map_base = np.stack([se3.from_parts(np.eye(3), at) for at in poses[:, 1:]])
    truth = make_source("mcap", recording).ground_truth().trajectory
    told = Trajectory(stamps_ns=stamps_ns, T_world_base=T_map_base)
    error_m = absolute_errors(told, truth, 0.04).rmse_m
    assert error_m <= 1.5 * max(recorded.metrics["ate_online_m"], 0.01)
    assert heard["scenes"] == ["Bright", "Dark"] and heard["modules"][-1] == "dark"
    assert heard["map"]["occupied"] > 100 and heard["map"]["free"] > 1000
