"""TUM files: read exactly what was written, and name what is wrong."""

import numpy as np
import pytest

from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.trajectory import Trajectory


def test_tum_file_keeps_nanoseconds_and_poses(tmp_path):
    stamps_ns = np.array([-1500000000, -500000000, 1305031229528748001, 1305031229564425999])
    poses = np.stack([se3.exp(k * np.array([1, 2, 3, 0.1, 3.0, 0.2])) for k in range(4)])
    Trajectory(stamps_ns=stamps_ns, T_world_base=poses).write_tum(tmp_path / "t.tum")
    back = Trajectory.read_tum(tmp_path / "t.tum")
    np.testing.assert_array_equal(back.stamps_ns, stamps_ns)
    np.testing.assert_allclose(back.T_world_base, poses, atol=1e-8)


def test_empty_tum_file_is_an_empty_trajectory(tmp_path):
    Trajectory.empty().write_tum(tmp_path / "t.tum")
    assert len(Trajectory.read_tum(tmp_path / "t.tum")) == 0


def test_poses_are_sorted_by_stamp(tmp_path):
    (tmp_path / "t.tum").write_text("2.0 2 0 0 0 0 0 1\n1.0 1 0 0 0 0 0 1\n")
    trajectory = Trajectory.read_tum(tmp_path / "t.tum")
    assert trajectory.positions_m[:, 0].tolist() == [1.0, 2.0]


def test_stamps_in_powers_of_ten_keep_their_nanoseconds(tmp_path):
    (tmp_path / "t.tum").write_text("1.305031102175304001e+09 1 0 0 0 0 0 1\n")  # as of savetxt
    assert Trajectory.read_tum(tmp_path / "t.tum").stamps_ns.tolist() == [1305031102_175304001]


@pytest.mark.parametrize(
    "line",
    [
        "1.0 2 0 0",
        "x 1 2 3 0 0 0 1",
        "1.0 nan 0 0 0 0 0 1",
        "1403636579763555584 1 2 3 0 0 0 1",  # nanoseconds
        "1e400 1 2 3 0 0 0 1",
        "1.0,0.5,1.0,0.5,1.0,0.1,0.2,0.3,0.4",  # a CSV of another layout
    ],
)
def test_bad_line_is_named(tmp_path, line):
    (tmp_path / "t.tum").write_text(f"# fine\n{line}\n")
    with pytest.raises(InputError, match="line 2"):
        Trajectory.read_tum(tmp_path / "t.tum")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"not found: .*nowhere\.tum"):
        Trajectory.read_tum(tmp_path / "nowhere.tum")
