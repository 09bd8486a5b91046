"""KITTI drives."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from ros_recordings import make_source

from sceneslam.sources.survey.preflight import preflight
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor, optical_to_rep103

POINTS = np.random.default_rng(4).normal(size=(50, 4)).astype("<f4")


def make_folder(path: Path, name: str = "velodyne", count: int = 3) -> Path:
    (path / name).mkdir(parents=True)
    for index in range(count):
        (path / name / f"{index:06d}.bin").write_bytes(POINTS.tobytes())
    return path


def write_camera_poses(folder: Path, T_cam_lidar: np.ndarray) -> None:
    """Write what the odometry benchmark has: the camera's poses along its z axis, and `Tr`."""
    rows = np.tile(np.eye(4)[:3], (3, 1, 1))
    rows[:, 2, 3] = [0, 1, 2]
    np.savetxt(folder / "poses.txt", rows.reshape(3, 12))
    numbers = " ".join(map(str, T_cam_lidar[:3].ravel()))
    (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers}\n")


def test_the_drive_is_read_with_its_truth(shared_data: Path) -> None:
    source = make_source("kitti", shared_data / "kitti_raw_2011_09_26_drive_0001")
    found = list(source)
    assert len(found) == source.length == 108
    assert source.rig.sensors == {Sensor.POINTS}
    truth = source.ground_truth().trajectory
    assert len(truth) == 108
    assert truth.stamps_ns[5] == found[5].stamp_ns == source.span.start_ns + 520_000_000
    steps = np.linalg.norm(np.diff(truth.positions_m, axis=0), axis=1)
    assert steps.sum() == pytest.approx(106.9, abs=0.5)


@pytest.mark.parametrize("name", ["velodyne", "velodyne_points/data"])
def test_both_layouts_are_read_at_ten_hertz(tmp_path: Path, name: str) -> None:
    found = list(make_source("kitti", make_folder(tmp_path / "a", name), vertical_offset_deg=0.0))
    assert [one.stamp_ns for one in found] == [0, 100_000_000, 200_000_000]
    np.testing.assert_array_equal(found[0].points_lidar, POINTS[:, :3])


@pytest.mark.parametrize("name", ["velodyne", "velodyne_points/data"])
def test_the_folder_of_the_scans_stands_for_its_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    folder = make_folder(tmp_path / "a", name)
    (folder / "times.txt").write_text("5.0\n5.2\n5.4\n")
    write_camera_poses(folder, np.eye(4))
    monkeypatch.chdir(folder / name)
    for given in (folder / name, "."):
        source = make_source("kitti", given)
        assert [one.stamp_ns for one in source] == [5_000_000_000, 5_200_000_000, 5_400_000_000]
        assert len(source.ground_truth().trajectory) == 3
        assert not source.survey().odd


def test_assumed_stamps_are_a_warning(tmp_path: Path) -> None:
    source = make_source("kitti", make_folder(tmp_path / "a"))
    (warning,) = preflight(source.survey(), source.rig).warnings
    assert warning.startswith("no times.txt: the scans are assumed to come at 10 Hz")
    assert warning.endswith(str(tmp_path / "a"))


def test_the_dates_of_raw_drives_are_stamps(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a", "velodyne_points/data", 1)
    times = "2011-09-26 13:02:25.964389445\n"
    (folder / "velodyne_points" / "timestamps.txt").write_text(times)
    (one,) = make_source("kitti", folder)
    assert one.stamp_ns == 1317042145_964389445


def test_poses_of_twelve_numbers_are_truth(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    rows = np.tile(np.eye(4)[:3].ravel(), (3, 1))
    rows[:, 3] = [0, 1, 2]
    np.savetxt(folder / "poses.txt", rows, encoding="utf-8-sig")  # as Windows' editors write
    truth = make_source("kitti", folder).ground_truth().trajectory
    np.testing.assert_array_equal(truth.positions_m[:, 0], [0, 1, 2])
    np.savetxt(folder / "poses.txt", rows[:2])
    with pytest.raises(InputError, match="expected 3 lines of 12"):
        make_source("kitti", folder).ground_truth()


def test_poses_of_the_camera_become_poses_of_the_lidar(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    T_cam_lidar = se3.inverse(optical_to_rep103())
    T_cam_lidar[:3, 3] = [-0.01, -0.05, -0.29]
    write_camera_poses(folder, T_cam_lidar)
    T_gt_base = make_source("kitti", folder).ground_truth().trajectory.T_world_base
    np.testing.assert_allclose(T_gt_base[:, :3, 3], [[0, 0, 0], [1, 0, 0], [2, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(T_gt_base[:, :3, :3], np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [("1 0 0", "expected 12 numbers, got '1 0 0'"), ("1 " * 12, "expected a rotation")],
)
def test_a_calibration_that_is_no_transform_is_named(tmp_path: Path, wrong: str, says: str) -> None:
    folder = make_folder(tmp_path / "a")
    write_camera_poses(folder, np.eye(4))
    (folder / "calib.txt").write_text(f"Tr: {wrong}\n")
    with pytest.raises(InputError, match=rf"Tr: {says}.*calib\.txt"):
        make_source("kitti", folder).ground_truth()


@pytest.mark.parametrize("wrong", [np.zeros((3, 3)), 1.1 * np.eye(3), np.diag([1.0, 1.0, -1.0])])
def test_a_pose_without_a_rotation_is_named_by_its_line(tmp_path: Path, wrong: np.ndarray) -> None:
    folder = make_folder(tmp_path / "a")
    rows = np.tile(np.eye(4)[:3], (3, 1, 1))
    rows[1, :, :3] = wrong
    np.savetxt(folder / "poses.txt", rows.reshape(3, 12), header="two lines\nof comment")
    with pytest.raises(InputError, match=r"poses: line 4 has no rotation: .*poses\.txt"):
        make_source("kitti", folder).ground_truth()


def test_scans_of_a_drive_with_lost_ones_have_the_lines_of_their_numbers(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a", count=4)
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    rows = np.tile(np.eye(4)[:3].ravel(), (4, 1))
    rows[:, 3] = [0, 1, 2, 3]
    np.savetxt(folder / "poses.txt", rows)
    for lost in ("000000.bin", "000002.bin"):
        (folder / "velodyne" / lost).unlink()
    source = make_source("kitti", folder)
    assert [one.stamp_ns for one in source] == [100_000_000, 300_000_000]
    truth = source.ground_truth().trajectory
    np.testing.assert_array_equal(truth.stamps_ns, [100_000_000, 300_000_000])
    np.testing.assert_array_equal(truth.positions_m[:, 0], [1, 3])
    (folder / "velodyne" / "000003.bin").rename(folder / "velodyne" / "000009.bin")
    with pytest.raises(InputError, match="expected 2 as there are scans, got 4"):
        make_source("kitti", folder)


def test_scans_come_by_the_numbers_in_their_names(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a", count=0)
    for number in range(11):
        (folder / "velodyne" / f"{number}.bin").write_bytes((POINTS + number).tobytes())
        (folder / "velodyne" / f"._{number}.bin").write_bytes(b"of macOS")
    source = make_source("kitti", folder, vertical_offset_deg=0.0)
    for number, one in enumerate(source):
        np.testing.assert_array_equal(one.points_lidar, (POINTS + number)[:, :3])
    assert source.length == 11 and source.faults == []


def test_damaged_scans_are_passed_over_and_named(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a")
    (folder / "velodyne" / "000001.bin").write_bytes(POINTS.tobytes()[:-3])
    (folder / "velodyne" / "000002.bin").write_bytes(b"")
    source = make_source("kitti", folder)
    assert len(list(source)) == 1
    (fault,) = source.faults
    assert "2 times" in fault
    assert "000001.bin" in fault


def test_scans_of_nuscenes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "lidar__1532402927647951.pcd.bin").write_bytes(bytes(20 * 4))
    with pytest.raises(InputError, match="nuScenes', of five numbers a point, expected KITTI's"):
        make_source("kitti", tmp_path)


def test_points_that_are_no_numbers_are_dropped(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "a", count=1)
    broken = POINTS.copy()
    broken[7, 1] = np.nan
    (folder / "velodyne" / "000000.bin").write_bytes(broken.tobytes())
    (one,) = make_source("kitti", folder)
    assert len(one.points_lidar) == 49


def test_points_are_raised_by_the_offset_of_the_lidar(tmp_path: Path) -> None:
    points = np.vstack([[[10, 0, 0, 0], [0, 0, 5, 0], [0, 0, 0, 0]], POINTS]).astype("<f4")
    folder = make_folder(tmp_path / "a", count=1)
    (folder / "velodyne" / "000000.bin").write_bytes(points.tobytes())
    (one,) = make_source("kitti", folder)
    assert one.points_lidar[0, 2] == pytest.approx(10 * np.sin(np.deg2rad(0.205)))
    np.testing.assert_allclose(one.points_lidar[1:3], points[1:3, :3], atol=1e-4)
    axes = np.cross(POINTS[:, :3], [0.0, 0.0, 1.0])
    axes *= np.deg2rad(0.205) / np.linalg.norm(axes, axis=1, keepdims=True)
    pairs = zip(axes, POINTS[:, :3], strict=True)
    due = [cv2.Rodrigues(axis)[0] @ point for axis, point in pairs]
    np.testing.assert_allclose(one.points_lidar[3:], due, atol=1e-5)


def test_wrong_folders_times_and_ranges_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not found"):
        make_source("kitti", tmp_path / "nowhere")
    with pytest.raises(InputError, match="no scans"):
        make_source("kitti", tmp_path)
    folder = make_folder(tmp_path / "a")
    with pytest.raises(ConfigError, match="range_m"):
        make_source("kitti", folder, range_m=[5.0, 1.0])
    with pytest.raises(ConfigError, match="vertical_offset_deg"):
        make_source("kitti", folder, vertical_offset_deg=float("nan"))
    (folder / "times.txt").write_text("0.0\n0.1\n")
    with pytest.raises(InputError, match="expected 3 as there are scans, got 2"):
        make_source("kitti", folder)
    (folder / "times.txt").write_text("0.0\nsoon\n0.2")
    with pytest.raises(InputError, match="'soon'"):
        make_source("kitti", folder)
    (folder / "times.txt").write_text("0.0\n1317384506405226048\n0.2")  # nanoseconds
    with pytest.raises(InputError, match="expected seconds, got '1317384506405226048'"):
        make_source("kitti", folder)
