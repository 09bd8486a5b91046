"""A coloured mesh of the depth images of a run."""

from contextlib import closing

import numpy as np
import pytest

from sceneslam.evaluation.association import select
from sceneslam.mesh.__main__ import main
from sceneslam.mesh.mesh import Volume, views
from sceneslam.storage.folder import RunFolder
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig
from sceneslam.types.trajectory import Trajectory

CAMERA = Camera(size_wh=(80, 60), fx=70.0, fy=70.0, cx=39.5, cy=29.5)
WALL_M = 2.0  # from where the camera begins, along base x


def drive(count: int = 5, step_m: float = 0.15) -> tuple[list[Observation], Trajectory]:
    """Return images of a red wall, ever nearer, and the true poses."""
    T_map_base = np.tile(np.eye(4), (count, 1, 1))
    T_map_base[:, 0, 3] = step_m * np.arange(count)
    stamps_ns = 10**9 + np.arange(count, dtype=np.int64) * 10**8
    image_bgr = np.zeros((60, 80, 3), np.uint8)
    image_bgr[..., 2] = 200
    observations = [
        Observation(
            stamp_ns=stamp_ns,
            image_bgr=image_bgr,
            depth_m=np.full((60, 80), WALL_M - x_m, np.float32),
        )
        for stamp_ns, x_m in zip(stamps_ns.tolist(), T_map_base[:, 0, 3].tolist(), strict=True)
    ]
    return observations, Trajectory(stamps_ns=stamps_ns, T_world_base=T_map_base)


def test_a_wall_lies_where_all_images_see_it_in_its_colour(tmp_path):
    import open3d

    volume = Volume(CAMERA, 0.05)
    for view in views(*drive(), CAMERA):
        volume.add(view)
    triangles = volume.write(tmp_path / "map" / "mesh.ply")
    mesh = open3d.t.io.read_triangle_mesh(str(tmp_path / "map" / "mesh.ply"))
    points, colors = mesh.vertex.positions.numpy(), mesh.vertex.colors.numpy()
    assert triangles > 100 and len(points) > 100
    assert np.abs(points[:, 0] - WALL_M).max() < 0.02
    assert colors.mean(axis=0) == pytest.approx([200 / 255, 0.0, 0.0], abs=0.02)
    assert not (tmp_path / "map" / "mesh.part.ply").exists()


def test_images_are_taken_a_step_apart_and_only_where_there_is_a_pose():
    observations, trajectory = drive(count=10, step_m=0.04)
    assert len(list(views(observations, trajectory, CAMERA))) == 4
    late = [Observation(stamp_ns=10**12, depth_m=observations[0].depth_m)]
    empty = [Observation(stamp_ns=10**9, depth_m=np.zeros((60, 80), np.float32))]
    assert not list(views(late, trajectory, CAMERA)) and not list(views(empty, trajectory, CAMERA))


def test_images_are_left_out_where_poses_are_missing_for_long():
    observations, trajectory = drive(count=17, step_m=0.105)
    poses = select(trajectory, np.r_[0:2, 4, 15:17])  # 0.3 s are interpolated, 1.1 s are not
    x_m = [view.T_map_cam[0, 3] for view in views(observations, poses, CAMERA)]
    np.testing.assert_allclose(x_m, trajectory.positions_m[np.r_[0:5, 15:17], 0], atol=1e-9)


class RecordedWall:
    """A source of the images of the wall."""

    rig = Rig(sensors=frozenset(), camera=CAMERA)
    __iter__ = drive()[0].__iter__


def test_the_next_run_into_the_folder_removes_the_mesh(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sceneslam.mesh.mesh._source", lambda *_: RecordedWall())
    with closing(RunFolder.claim(tmp_path)) as claimed:
        drive()[1].write_tum(tmp_path / "trajectory.tum")
        for _ in range(2):  # its own mesh is replaced
            assert main([str(tmp_path), "--voxel-m", "0.05"]) == 0
        assert (tmp_path / "map" / "mesh.ply").is_file()
        claimed.clear()
        assert not (tmp_path / "map" / "mesh.ply").exists()
        drive()[1].write_tum(tmp_path / "trajectory.tum")
        (tmp_path / "map" / "mesh.ply").write_text("mine")
        assert main([str(tmp_path), "--voxel-m", "0.05"]) == 2
    assert (tmp_path / "map" / "mesh.ply").read_text() == "mine"
    assert "there is a file that no run wrote" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"{: [", "config.yaml cannot be read"),
        (b"\xff\xfe\xff", "config.yaml cannot be read"),
        (b"[]", "config.yaml is not a table"),
    ],
)
def test_a_damaged_configuration_is_one_sentence(tmp_path, capsys, data, said):
    (tmp_path / "config.yaml").write_bytes(data)
    (tmp_path / "trajectory.tum").write_text("")
    assert main([str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: mesh: {said}") and str(tmp_path) in error


def test_a_shared_run_cannot_allow_its_own_code(tmp_path, capsys):
    text = "source: {_target_: fakes.FakeSource, steps: 5, dark_from: 9}\nallow_targets: [fakes]\n"
    (tmp_path / "config.yaml").write_text(text)
    (tmp_path / "trajectory.tum").write_text("")
    assert main([str(tmp_path)]) == 2
    assert "source._target_: got 'fakes.FakeSource'" in capsys.readouterr().err
    assert main([str(tmp_path), "allow_targets=[fakes]"]) == 2
    assert "the run's source has no depth camera" in capsys.readouterr().err
    assert main([str(tmp_path), "allow=[fakes]"]) == 2
    assert "allowed: RUN, --voxel-m, allow_targets=[NAME]" in capsys.readouterr().err


def test_what_is_no_run_is_one_sentence(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "config.yaml is missing" in capsys.readouterr().err
    assert main([str(tmp_path), "--voxel-m", "0"]) == 2
    said = capsys.readouterr().err
    assert said == "error: --voxel-m: got 0.0, allowed: 0.002 to 1 m\n"
