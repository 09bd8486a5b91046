"""Replaying what another system put out."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from sceneslam.interfaces import SlamModule
from sceneslam.modules.slam.recorded import Recorded
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.recorded import read_recorded
from sceneslam.types.rig import Rig, Sensor

SETTINGS = yaml.safe_load((Path(__file__).parents[1] / "conf/slam/recorded.yaml").read_text())
SETTINGS.pop("_target_")
LOST, TRACKING = TrackingStatus.LOST, TrackingStatus.TRACKING
HEADER = "scene: home\nslam:vins_mono\nframe:base_link\ntopics:/d400/color,/d400/depth\n"
# Along x at 1 m/s and 10 Hz, nothing between 0.5 s and 2.0 s.
POSES = [(0.1 * step, 0.1 * step) for step in [0, 1, 2, 3, 4, 5, 20, 21, 22]]


def lines(poses=POSES):
    return "".join(f"{t_s:.6f} {x_m} 0 0 0 0 0 1\n" for t_s, x_m in poses)


@pytest.fixture
def write(tmp_path):
    def to_file(text):
        path = tmp_path / "out.txt"
        path.write_text(text)
        return path

    return to_file


def active(path, **settings):
    module = Recorded(**{**SETTINGS, "path": str(path), **settings})
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    return module


def track(module, t_s):
    return module.track(Observation(stamp_ns=round(t_s * 1e9), T_odom_base=np.eye(4)))


def x_m(tracking):
    return pytest.approx(float(tracking.T_local_base[0, 3]), abs=1e-9)


def test_it_is_fed_at_every_observation_of_any_source(write):
    module = active(write(lines()))
    assert isinstance(module, SlamModule)
    assert set(module.requires) == {frozenset({sensor}) for sensor in Sensor}


def test_poses_between_two_stamps_are_interpolated(write):
    module = active(write(lines()))
    assert track(module, 0.0).status is TRACKING
    assert x_m(track(module, 0.24)) == 0.24
    assert track(module, 0.5).stamp_ns == 500_000_000


def test_a_gap_is_lost_and_holds_the_last_pose(write):
    module = active(write(lines()))
    assert x_m(track(module, 0.45)) == 0.0  # the first it was asked for is `local`
    assert x_m(track(module, 0.5)) == 0.05
    gone = track(module, 1.2)
    assert gone.status is LOST and x_m(gone) == 0.05
    assert track(module, 2.05).status is TRACKING


def test_before_and_after_the_recording_it_is_lost(write):
    module = active(write(lines([(5.0, 0.0), (5.1, 0.1), (5.2, 0.2)])))
    assert [track(module, t_s).status for t_s in (4.9, 5.0, 5.2, 5.3)] == [
        LOST,
        TRACKING,
        TRACKING,
        LOST,
    ]


def test_startup_time_counts_from_every_activation(write):
    module = active(write(lines()), startup_s=0.2)
    assert [track(module, t_s).status for t_s in (0.0, 0.1, 0.2)] == [LOST, LOST, TRACKING]
    module.activate(Rig(sensors=frozenset({Sensor.ODOMETRY})))
    assert [track(module, t_s).status for t_s in (0.3, 0.4, 0.5)] == [LOST, LOST, TRACKING]


def test_poses_of_another_frame_are_brought_to_base(write):
    T_base_imu = se3.from_xy_yaw(0.2, 0.1, np.pi / 2)
    quat = se3.to_quat_xyzw(T_base_imu)
    rows = ""
    for step in range(4):  # the robot turns on the spot, so that its imu runs in a circle
        T_world_imu = se3.from_xy_yaw(0.0, 0.0, 0.1 * step) @ T_base_imu
        numbers = [*T_world_imu[:3, 3], *se3.to_quat_xyzw(T_world_imu)]
        rows += f"{0.1 * step:.1f} {' '.join(map(str, numbers))}\n"
    path = write("frame: imu\nseq: 1\n" + rows)
    module = active(path, T_base_frame=[0.2, 0.1, 0.0, *map(float, quat)])
    for step in range(4):
        turned = track(module, 0.1 * step).T_local_base
        np.testing.assert_allclose(turned, se3.from_xy_yaw(0, 0, 0.1 * step), atol=1e-9)


@pytest.mark.parametrize("values", [None, [1.0, 2.0], [0.0] * 7])
def test_a_frame_off_base_needs_its_extrinsics(write, values):
    path = write("frame: imu\nseq: 1\n" + lines())
    with pytest.raises(ConfigError, match=r"T_base_frame: .* where imu sits on base"):
        active(path, T_base_frame=values)


def test_a_sequence_of_several_is_chosen_by_its_number(write):
    path = write(HEADER + "seq:1\n" + lines() + "seq: 2\n" + lines([(0.0, 0.0), (0.1, 7.0)]))
    module = active(path, sequence=2)
    track(module, 0.0)
    assert x_m(track(module, 0.1)) == 7.0
    with pytest.raises(ConfigError, match=r"sequence: got None, .* it holds: 1, 2"):
        active(path)


def test_a_system_that_failed_is_lost_throughout(write):
    module = active(write("frame: base_link\nseq: 2\nseq: 3\n"), sequence=3)
    assert track(module, 0.0).status is LOST


@pytest.mark.parametrize("name", ["startup_s", "gap_periods"])
def test_impossible_setting_is_named(write, name):
    with pytest.raises(ConfigError, match=f"{name}: got -1"):
        active(write(lines()), **{name: -1})


def test_headers_apply_to_the_sequences_after_them(write):
    one, two = read_recorded(write(HEADER + "\nseq: 4\n#stamp x\n" + lines() + "seq: 5\n"))
    assert (one.scene, one.frame, one.sequence, len(one.trajectory)) == ("home", "base_link", 4, 9)
    assert two.sequence == 5 and not len(two.trajectory)


def test_an_output_stamp_is_passed_over_and_bad_poses_are_left_out(write):
    text = "1.5 1.6 1 2 3 0 0 0 1\n1.6 nan 0 0 0 0 0 1\n1.7 0 0 0 0 0 0 0\n1.5 4 2 3 0 0 0 1\n"
    (one,) = read_recorded(write(text))
    assert one.trajectory.stamps_ns.tolist() == [1_500_000_000]
    np.testing.assert_array_equal(one.trajectory.positions_m, [[4, 2, 3]])  # the last of a repeat


@pytest.mark.parametrize(
    "bad", ["1.0 2.0\n", "1.0 a 0 0 0 0 0 1\n", "seq: one\n", "1e30 0 0 0 0 0 0 1\n"]
)
def test_a_line_that_makes_no_sense_is_named(write, bad):
    with pytest.raises(InputError, match="line 10: expected"):
        read_recorded(write(lines() + bad))
