"""What is wrong with a source before it is run, for which module, and how to run it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from ros_recordings import STAMP_NS, Recorder
from test_source_ros2 import ALL, IMAGE, Robot, talking

from sceneslam import doctor
from sceneslam.doctor import examine
from sceneslam.script import composed
from sceneslam.sources.ros2 import source as ros2
from sceneslam.types.errors import ConfigError, InputError

ROBOT = ("source=ros2", "source.listen_s=0.05", "source.wait_s=1.0")


def listen(monkeypatch, *topics, without=()):
    robot = Robot(*topics)
    robot.mounts = {frame: T for frame, T in robot.mounts.items() if frame not in without}
    monkeypatch.setattr(ros2, "open_transport", lambda network: robot)
    with talking(robot):
        lines = examine(ROBOT)
    assert robot.is_closed
    return "\n".join(lines)


def test_robot_with_all_is_proposed_the_scenario(monkeypatch):
    said = listen(monkeypatch, *ALL, without=("camera_color_optical_frame",))
    assert f"image    {IMAGE}:" in said and "laser    at (0.20, 0.00, 0.30) m" in said
    assert "rgbd         can run" in said and "laser        can run" in said
    assert "kiss_icp     can run" in said  # on depth
    assert "no transform connects frame 'camera_color_optical_frame'" in said
    command = "python -m sceneslam +scenario=bright_to_dark source=ros2"
    assert said.splitlines()[-1].strip().startswith(command)
    assert said.endswith("run=live +sinks@sinks.ros2=ros2")


def test_robot_with_a_laser_alone_is_told_what_others_lack(monkeypatch):
    said = listen(monkeypatch, "/scan", "/odom")
    assert "rgbd         lacks image and depth" in said and "laser        can run" in said
    assert "+scenario=single slam@slam.only=laser" in said


@pytest.mark.parametrize(("name", "sinks"), [("ros2", ["+sinks@sinks.ros2=ros2"]), ("camera", [])])
def test_only_a_robot_with_ros_is_proposed_a_sink_for_it(monkeypatch, name, sinks):
    robot = Robot(*ALL)
    monkeypatch.setattr(ros2, "open_transport", lambda network: robot)
    other = composed(ROBOT, None)  # a camera that is live, without ROS
    monkeypatch.setattr(doctor, "composed", lambda words, folder: other)
    with talking(robot):
        command = examine((f"source={name}",))[-1].split()
    assert command[3:] == ["+scenario=bright_to_dark", f"source={name}", "run=live", *sinks]


def test_recording_is_examined_alike(tmp_path):
    path = tmp_path / "scans.mcap"
    with Recorder(path) as recorder:
        for index in range(30):
            recorder.scan("/scan", STAMP_NS + index * 100_000_000, [1.0] * 21)
    said = "\n".join(examine(("source=rosbag", f"source.path={path}")))
    assert "10 Hz" in said and "laser        can run" in said and "run=live" not in said


def test_doctor_wants_a_source():
    with pytest.raises(ConfigError, match="source=NAME"):
        examine(("seed=1",))


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("sorce.path=scans.mcap", r"got 'sorce.path=scans.mcap', .* \(did you mean source\?\)"),
        ("efects=lights_out", r"did you mean effects\?"),
        ("--hlep", "got '--hlep', allowed: source=NAME"),
        ("+source.pth=scans.mcap", r"source\.pth"),
        ("source", "got 'source', allowed: source=NAME"),
    ],
)
def test_a_misspelt_word_is_refused_with_the_nearest_known_one(tmp_path, word, said):
    with pytest.raises(ConfigError, match=said):
        examine(("source=rosbag", f"source.path={tmp_path}", word))


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("source=rosbag",), "source.path"),
        (("source=two_rooms", "effects=exposure_times"), "effects.path"),
    ],
)
def test_value_that_is_not_given_is_named_as_by_a_run(words, key):
    with pytest.raises(ConfigError, match=f"{key}: got nothing, allowed: a value, as in {key}="):
        examine(words)


def test_nobody_there_is_an_input_error(monkeypatch):
    monkeypatch.setattr(ros2, "open_transport", lambda network: Robot())
    with pytest.raises(InputError, match="nobody publishes a sensor there"):
        examine(ROBOT)


def test_doctor_leaves_no_folder_and_says_in_one_line_what_is_wrong(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "sceneslam", "doctor", "source=rosbag", "source.path=no.bag"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(Path(__file__).parents[1]), "PATH": "/usr/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2 and done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1 and not any(tmp_path.iterdir())
