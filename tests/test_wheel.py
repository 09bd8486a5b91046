"""A wheel works from any folder, with a user's own configuration folder, and without a checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from sceneslam.ros.writer import ObservationWriter
from sceneslam.testing.room import RIG, room_observation

ROOT = Path(__file__).parents[1]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "conf", "modules", "experiments", "sceneslam")
MY_SCENARIO = """\
# @package _global_
defaults:
  - bright_to_dark
policy:
  confirm_window_s: 0.25
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Give a folder that holds what the wheel holds."""
    folder = tmp_path_factory.mktemp("wheel")
    checkout = folder / "checkout"
    checkout.mkdir()
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, checkout / name)
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder]
    done = subprocess.run([*build, checkout], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


def test_wheel_leaks_no_other_top_level_package(installed):
    assert {path.name for path in installed.iterdir() if path.suffix != ".dist-info"} == {
        "sceneslam"
    }
    assert (installed / "sceneslam" / "conf" / "scenario" / "bright_to_dark.yaml").exists()
    assert (installed / "sceneslam" / "modules" / "slam" / "rgbd" / "module.py").exists()


def test_wheel_runs_a_users_own_scenario_elsewhere(installed, tmp_path):
    (tmp_path / "mine" / "scenario").mkdir(parents=True)
    (tmp_path / "mine" / "scenario" / "hasty.yaml").write_text(MY_SCENARIO)
    writer = ObservationWriter(tmp_path / "room.mcap", rig=RIG, image_format="png")
    for index in range(12):
        writer.write(room_observation(index))
    writer.close()
    words = "--config-dir mine +scenario=hasty source=mcap source.path=room.mcap hydra.run.dir=out"
    # first on the path: the wheel, not a checkout that may be installed for development
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, "-m", "sceneslam", *words.split()],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "confirm_window_s: 0.25" in (tmp_path / "out" / "config.yaml").read_text()
