import json
import subprocess
import sys

import numpy as np
import pytest

from sceneslam.evaluation.__main__ import main
from sceneslam.evaluation.files import read_poses
from sceneslam.evaluation.relations import Relations, relation_errors
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.trajectory import Trajectory


def four_poses() -> Trajectory:
    poses = [se3.from_xy_yaw(0.1 * k, 0.0, 0.2 * k) for k in range(4)]
    return Trajectory(stamps_ns=np.arange(4) * 10**9, T_world_base=np.array(poses))


def relations_of(lines: list[str], path) -> Relations:
    path.write_text("# t1 t2 x y z roll pitch yaw\n" + "\n".join(lines) + "\n")
    return Relations.read(path)


def test_relations_measure_the_motion_between_two_stamps(tmp_path):
    T_1_2 = se3.inverse(se3.from_xy_yaw(0.1, 0, 0.2)) @ se3.from_xy_yaw(0.2, 0, 0.4)
    x, y = T_1_2[:2, 3]
    relations = relations_of(
        [
            f"1.0004 2.0 {x} {y} 0 0 0 0.2",  # exact, its stamp rounded
            f"2.0 1.0 0 0 0 0 0 {-0.2 - np.radians(2)}",  # backwards in time, 2 degrees off
            "1.0 9.0 0 0 0 0 0 0",  # no pose at 9 s
            "1.0 2.002 0 0 0 0 0 0",  # the scan of that stamp has no pose
        ],
        tmp_path / "x.relations",
    )
    errors = relation_errors(four_poses(), relations)
    assert errors["matched"] == 2
    assert errors["total"] == 4
    assert errors["rot_mean_deg"] == pytest.approx(1.0)
    assert errors["rot_std_deg"] == pytest.approx(1.0)
    assert errors["rot_sq_mean"] == pytest.approx(2.0)
    assert errors["trans_mean_m"] == pytest.approx(0.05)
    assert errors["trans_sq_mean"] == pytest.approx(0.005)


def test_roll_pitch_yaw_turns_about_x_then_y_then_z(tmp_path):
    relations = relations_of([f"0 1 1 2 3 {0.1} {0.2} {0.3}"], tmp_path / "x.relations")
    x, y, z = np.diag([0.1, 0.2, 0.3])
    expected = se3.so3_exp(z) @ se3.so3_exp(y) @ se3.so3_exp(x)
    np.testing.assert_allclose(relations.T_first_second[0, :3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(relations.T_first_second[0, :3, 3], [1, 2, 3])


def test_relations_that_no_pose_matches_are_refused(tmp_path):
    relations = relations_of(["50 60 0 0 0 0 0 0"], tmp_path / "x.relations")
    with pytest.raises(InputError, match="none of the 1 relations"):
        relation_errors(four_poses(), relations)
    with pytest.raises(InputError, match="the trajectory is empty"):
        relation_errors(Trajectory.empty(), relations)


def test_laser_log_of_intel_matches_all_its_relations(shared_data):
    folder = shared_data / "carmen_intel"
    scans = [
        line.split()[-9:]
        for line in (folder / "intel.clf").read_text().splitlines()
        if line.startswith("FLASER")
    ]
    values = np.array([[*row[:3], row[6]] for row in scans], dtype=float)
    values = values[np.argsort(values[:, 3], kind="stable")]
    half_rad = values[:, 2] / 2
    nought = np.zeros(len(values))
    trajectory = Trajectory(
        stamps_ns=np.round(values[:, 3] * 1e9).astype(np.int64),
        T_world_base=se3.from_quat_xyzw(
            np.column_stack([values[:, :2], nought]),
            np.column_stack([nought, nought, np.sin(half_rad), np.cos(half_rad)]),
        ),
    )
    errors = relation_errors(trajectory, Relations.read(folder / "intel.relations"))
    assert (errors["matched"], errors["total"]) == (2984, 2984)


def test_command_line_prints_json(shared_data, capsys):
    folder = shared_data / "trajectories"
    code = main(["ate", f"{folder}/fr2_desk_ORB.txt", f"{folder}/fr2_desk_groundtruth.txt"])
    scores = json.loads(capsys.readouterr().out)
    assert code == 0
    assert scores["ate_rmse_m"] == pytest.approx(0.008119, abs=1e-6)
    assert scores["matched"] == 2174


@pytest.mark.parametrize("gap_s", ["nan", "inf", "-1", "1e300"])
def test_gap_that_is_no_time_is_refused(tmp_path, capsys, gap_s):
    four_poses().write_tum(tmp_path / "poses.tum")
    words = [f"{tmp_path}/poses.tum", f"{tmp_path}/poses.tum", "--max-gap-s", gap_s]
    assert main(["ate", *words]) == 2
    assert capsys.readouterr().err.startswith("error: --max-gap-s: got ")


@pytest.mark.parametrize("order", [("poses.tum", "kitti.txt"), ("kitti.txt", "poses.tum")])
def test_file_with_stamps_is_not_compared_with_one_without(tmp_path, capsys, order):
    four_poses().write_tum(tmp_path / "poses.tum")
    (tmp_path / "kitti.txt").write_text("1 0 0 1 0 1 0 2 0 0 1 3\n" * 4)
    assert main(["ate", *(f"{tmp_path / name}" for name in order)]) == 2
    assert "score against the groundtruth.tum of the run" in capsys.readouterr().err


def test_command_line_prints_relation_errors(tmp_path, capsys):
    four_poses().write_tum(tmp_path / "poses.tum")
    (tmp_path / "x.relations").write_text(" # t1 t2 x y z r p y\n0 1 0.1 0 0 0 0 0.2\n")
    assert main(["relations", f"{tmp_path}/poses.tum", f"{tmp_path}/x.relations"]) == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores["trans_mean_m"] == pytest.approx(0.0, abs=1e-8)
    assert set(scores) >= {
        "trans_std_m",
        "rot_mean_deg",
        "rot_std_deg",
        "trans_sq_mean",
        "rot_sq_mean",
        "matched",
        "total",
    }


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_files_with_a_byte_order_mark_are_read(tmp_path, encoding):
    (tmp_path / "x.relations").write_text("0 1 0.1 0 0 0 0 0.2\n", encoding)
    assert len(Relations.read(tmp_path / "x.relations").first_ns) == 1
    (tmp_path / "tum.txt").write_text("0 1 2 3 0 0 0 1\n", encoding)
    (tmp_path / "kitti.txt").write_text("1 0 0 1 0 1 0 2 0 0 1 3\n", encoding)
    for name in ("tum.txt", "kitti.txt"):
        assert read_poses(tmp_path / name).positions_m.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("poses.tum", "garbage\n"),
        ("poses.tum", ""),
        ("x.relations", "1 2 3\n"),
        ("x.relations", ""),
        ("x.relations", "\x00\x01\n"),
    ],
)
def test_command_line_refuses_bad_files_in_one_sentence(tmp_path, capsys, name, text):
    four_poses().write_tum(tmp_path / "poses.tum")
    (tmp_path / "x.relations").write_text("0 1 0.1 0 0 0 0 0.2\n")
    (tmp_path / name).write_text(text)
    assert main(["relations", f"{tmp_path}/poses.tum", f"{tmp_path}/x.relations"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1


def test_module_is_run_with_python_dash_m():
    done = subprocess.run(
        [sys.executable, "-m", "sceneslam.evaluation", "ate", "/nowhere", "/nowhere"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "error: trajectory file not found: /nowhere\n"
