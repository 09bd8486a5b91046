"""A scenario in a user's own folder: it runs as the guide has it, and mistakes are named by key."""

import json
import re

import pytest
from documentation import ROOT, run_inside, write_files, write_recordings

GUIDE = ROOT / "docs" / "own_scenario.md"
RUN = "python -m sceneslam --config-dir my_robots +scenario=depot"
TABLE = dict(
    re.findall(r"^\| `(.+?)` \| `(error: .+)` \|$", GUIDE.read_text().replace(r"\|", "|"), re.M)
)
MISTAKES = {  # what the table has in the file -> the file, and what it has in the guide
    "treshold: 70.0": ("detector/hall_or_tunnel", "threshold: 70.0"),
    "scenes: [Hall, Tunel]": ("detector/hall_or_tunnel", "scenes: [Hall, Tunnel]"),
    "Hall: [eye, laser]": ("scenario/depot", "Hall: [eyes, laser, wheels]"),
    "handover: worm": ("policy/careful", "handover: warm"),
    "size_wh: [424]": ("source/depot_robot", "size_wh: [424, 240]"),
    "wheels: odometer": ("scenario/depot", "wheels: odometry"),
    "override /source: depot_robo": ("scenario/depot", "override /source: depot_robot"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write_files(GUIDE, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_robot_of_the_guide_is_driven_by_its_three_modules_and_policy(folder, capfd):
    simulated = "source.duration_s=0.5 source.cache_dir=cache run.report=false hydra.run.dir=out"
    assert run_inside(f"{RUN} source=depot_robot {simulated}") == 0, capfd.readouterr()
    events = list(map(json.loads, (folder / "out" / "events.jsonl").read_text().splitlines()))
    assert next(e for e in events if e["event"] == "scene")["scene"] == "Hall"
    assert next(e for e in events if e["event"] == "decision")["to"] == "eyes"
    assert next(e for e in events if e["event"] == "handover")["kind"] == "warm"
    situations = [e for e in events if e["event"] == "situation"]
    assert situations[0]["choices"] == ["eyes", "laser", "wheels"]
    metrics = json.loads((folder / "out" / "metrics.json").read_text())
    assert metrics["observations"] == 7  # half a second at 15 Hz


@pytest.mark.parametrize(
    ("file", "right", "wrong", "told"),
    [
        ("detector/hall_or_tunnel", "- grey_mean", "- gray_mean", "detector/gray_mean"),
        ("scenario/depot", "[laser, wheels]", "laser", "scenes.Tunnel: got 'laser'"),
        ("scenario/depot", "\n  laser:\n", "\n  lasr:\n", "slam.lasr: got {'range_max_m': 6.0}"),
        ("scenario/depot", "range_max_m", "range_max", "slam.laser.range_max: got 6.0"),
        ("scenario/depot", "slam@slam.eyes", "slam@slm.eyes", "did you mean slam?"),
        ("scenario/depot", "\nscenes:", "\nscene:", "did you mean scenes?"),
        ("scenario/depot", "# @package _global_", "# ours", "source@scenario.source"),
        ("policy/careful", "retry_s", "retr_s", "policy.retr_s: got 3.0"),
        ("policy/careful", "3.0", "three", "policy.retry_s: got 'three', allowed: a number"),
        ("source/depot_robot", "  fov_deg: 75", "  fov: 75", "source.camera.fov: got 75.0"),
        ("source/depot_robot", "laser: true", "laser: perhaps", "source.laser: got 'perhaps'"),
        ("source/depot_robot", "  fov_deg: 180", " fov_deg: 180", "depot_robot.yaml"),
    ],
)
def test_mistake_in_a_file_of_the_user_is_one_sentence_that_names_it(
    folder, capfd, file, right, wrong, told
):
    assert told in read(folder, capfd, file, right, wrong)


@pytest.mark.parametrize(("wrong", "told"), TABLE.items())
def test_mistake_in_the_table_of_the_guide_is_answered_as_it_says(folder, capfd, wrong, told):
    assert read(folder, capfd, *MISTAKES[wrong], wrong) == told


def test_every_row_of_the_table_is_tried():
    assert TABLE.keys() == MISTAKES.keys()


def read(folder, capfd, file, right, wrong):
    """Return what is read when a mistake is made in a file of the guide."""
    path = folder / "my_robots" / f"{file}.yaml"
    before = path.read_text()
    assert right in before
    path.write_text(before.replace(right, wrong, 1))
    assert run_inside(f"{RUN} source.cache_dir=cache") == 2
    said, errors = capfd.readouterr()
    assert errors.startswith("error: ") and "Traceback" not in errors
    assert not said and not (folder / "cache").exists()
    return errors.strip()


def test_real_robot_takes_the_place_of_the_simulated_one(folder, capfd):
    write_recordings(folder)
    real = "source=depot_bag source.path=FILE source.base_frame=no_such_frame"
    assert run_inside(f"{RUN} {real}") == 2
    assert "base_frame" in capfd.readouterr().err
