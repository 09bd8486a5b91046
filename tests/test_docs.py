"""The guides work as they are written."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from scenery import RIG, room_observation

from sceneslam.ros.writer import ObservationWriter

GUIDE = Path(__file__).parents[1] / "docs" / "own_module.md"


def block(language):
    return re.search(rf"```{language}\n(.*?)```", GUIDE.read_text(), re.S).group(1)


@pytest.fixture
def workshop(tmp_path):
    """Give a folder that holds what the guide's reader wrote, and a recording."""
    (tmp_path / "my_slam.py").write_text(block("python"))
    (tmp_path / "my_conf" / "slam").mkdir(parents=True)
    (tmp_path / "my_conf" / "slam" / "mine.yaml").write_text(block("yaml"))
    writer = ObservationWriter(tmp_path / "room.mcap", rig=RIG, image_format="png")
    for index in range(12):
        writer.write(room_observation(index))
    writer.close()
    return tmp_path


def test_guide_keeps_its_promise_of_40_lines():
    assert len([line for line in block("python").splitlines() if line.strip()]) <= 40


@pytest.mark.parametrize("command", block("sh").strip().splitlines())
def test_command_of_the_guide_runs_the_module(workshop, command):
    words = shlex.split(command)
    assert words[0] == "python"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(
        [
            sys.executable,
            *words[1:],
            "source=mcap",
            "source.path=room.mcap",
            "hydra.run.dir=out",
            "run.progress=false",
        ],
        cwd=workshop,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "12 poses (coverage 100.0 %)" in done.stdout
