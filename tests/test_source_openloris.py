"""OpenLORIS-Scene's published trajectories as a source, and the rates its authors give them."""

import numpy as np
import pytest
from ros_recordings import make_source

from sceneslam.evaluation.correctness import CorrectLimits, correct_rate
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor
from sceneslam.types.trajectory import Trajectory

POSE = "{} 0 0 0 0 0 0 1\n"


@pytest.fixture
def folder(tmp_path):
    """Give two sequences of odometry in one file, and the truth of the first."""
    (tmp_path / "gt").mkdir()
    (tmp_path / "recorded" / "odom").mkdir(parents=True)
    odometry = "scene: cafe\nframe: base_link\nseq: 1\n" + POSE.format(1.0) + POSE.format(1.05)
    odometry += "seq: 2\n" + POSE.format(9.0)
    (tmp_path / "recorded" / "odom" / "any.txt").write_text(odometry)
    truth = "scene: cafe\nframe: base_link\nseq: 1\n" + POSE.format(1.0)
    (tmp_path / "gt" / "gt_cafe_1.txt").write_text(truth)
    (tmp_path / "gt" / "._gt_cafe_1.txt").write_text("of macOS")
    return tmp_path


def test_a_sequence_is_found_by_the_headers(folder):
    source = make_source("openloris", folder, sequence="cafe-1-1")
    assert [one.stamp_ns for one in source] == [1_000_000_000, 1_050_000_000]
    assert source.length == 2 and source.span.end_ns == 1_050_000_000
    assert source.rig.sensors == {Sensor.ODOMETRY}
    assert len(source.ground_truth().trajectory) == 1


def test_a_sequence_without_truth_has_none(folder):
    assert make_source("openloris", folder, sequence="cafe-1-2").ground_truth() is None


def test_a_mistake_is_named(folder):
    with pytest.raises(ConfigError, match="sequence: got 'cafe'"):
        make_source("openloris", folder, sequence="cafe")
    with pytest.raises(InputError, match="no wheel odometry of cafe-1-3"):
        make_source("openloris", folder, sequence="cafe-1-3")
    with pytest.raises(InputError, match="expected a folder"):
        make_source("openloris", folder / "nowhere", sequence="cafe-1-1")


def test_odometry_of_another_frame_is_refused(folder):
    file = folder / "recorded" / "odom" / "any.txt"
    file.write_text(file.read_text().replace("base_link", "wheel"))
    with pytest.raises(InputError, match="expected poses of base_link, got those of 'wheel'"):
        make_source("openloris", folder, sequence="cafe-1-1")


@pytest.mark.parametrize(("sequence", "rate"), [("home-1-5", 1.0), ("corridor-1-2", 0.969)])
def test_wheel_odometry_has_the_rate_of_the_official_rule(shared_data, sequence, rate):
    source = make_source("openloris", shared_data / "openloris", sequence=sequence)
    truth = source.ground_truth().trajectory
    limit_m = 3.0 if sequence.startswith("home") else 5.0
    odometry = Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in source]),
        T_world_base=np.stack([one.T_odom_base for one in source]),
    )
    found = correct_rate(odometry, truth, CorrectLimits(limit_m=limit_m, limit_rad=np.pi / 6))
    assert found == pytest.approx(rate, abs=0.002)
