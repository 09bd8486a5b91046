"""ORB-SLAM3 as a module: its vocabulary, its maps, and that it stays out of our process."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from isolation import limits

from sceneslam.modules.slam.orb_slam3.anchor import Anchor
from sceneslam.modules.slam.orb_slam3.module import OrbSlam3
from sceneslam.modules.slam.orb_slam3.scale import Scale
from sceneslam.modules.slam.orb_slam3.worker import OrbSlam3Worker
from sceneslam.modules.slam.process.fields import observation_fields, rig_fields
from sceneslam.testing import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import TrackingStatus
from sceneslam.vocabulary import BRANCHES, LEVELS, describe, train

ROOT = Path(__file__).parents[1]
IS_MISSING = importlib.util.find_spec("pyorbslam3") is None
needs_orb_slam3 = pytest.mark.skipif(IS_MISSING, reason="pyorbslam3 is not installed")


def module(**changes):
    values = {
        "vocabulary": None,
        "feature_count": 1000,
        "fast_threshold": 20,
        "late_max_s": 1.0,
        "limits": limits(),
    }
    return OrbSlam3(**(values | changes))


@pytest.fixture(scope="module")
def images():
    return [describe(room_observation(index).image_bgr)[:300] for index in (0, 30, 60)]


def test_pyorbslam3_is_imported_by_the_program_alone():
    for top in ("sceneslam", "modules", "experiments"):
        for path in (ROOT / top).rglob("*.py"):
            names = {
                name.name
                for node in ast.walk(ast.parse(path.read_text()))
                if isinstance(node, ast.Import)
                for name in node.names
            }
            assert "pyorbslam3" not in names or path.name == "worker.py", path


def test_vocabulary_is_a_tree_whose_words_all_count(images):
    found = train(images, seed=0)
    assert (found.parents <= np.arange(len(found.parents))).all()  # a parent comes before
    assert np.bincount(found.parents).max() <= BRANCHES
    assert (found.weights[found.is_word] > 0).all() and (found.weights[~found.is_word] == 0).all()
    inner = np.flatnonzero(~found.is_word) + 1
    assert set(inner) | {0} == set(found.parents)  # what is no word has children
    depth = np.zeros(len(found.parents) + 1, int)
    for row, parent in enumerate(found.parents):
        depth[row + 1] = depth[parent] + 1
    assert depth.max() <= LEVELS


def test_descriptors_find_a_word_that_is_like_them(images):
    found = train(images, seed=0)
    words = np.unpackbits(found.descriptors[found.is_word], axis=1).astype(int)
    some = np.unpackbits(images[0][::10], axis=1).astype(int)
    nearest = np.abs(some[:, None] - words[None]).sum(axis=2).min(axis=1)
    assert np.median(nearest) < 10  # of 256 bits


def test_command_writes_what_dbow2_reads(tmp_path):
    for index in (0, 30):
        cv2.imwrite(str(tmp_path / f"{index}.png"), room_observation(index).image_bgr)
    command = [sys.executable, "-m", "sceneslam.vocabulary", str(tmp_path), str(tmp_path / "v.txt")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    head, *lines = (tmp_path / "v.txt").read_text().splitlines()
    assert head == f"{BRANCHES} {LEVELS} 0 0"
    assert {len(line.split()) for line in lines} == {1 + 1 + 32 + 1}
    assert f"in {len(lines)} nodes" in done.stdout


def test_a_folder_without_images_is_one_sentence(tmp_path):
    command = [sys.executable, "-m", "sceneslam.vocabulary", str(tmp_path), str(tmp_path / "v.txt")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "IMAGES: got" in done.stderr
    with pytest.raises(InputError, match="0 features"):
        train([], seed=0)


def test_a_new_map_goes_on_where_the_robot_is():
    T_local_cam, T_world_cam = se3.from_xy_yaw(3.0, 1.0, 0.5), se3.from_xy_yaw(0.2, 0.1, 0.1)
    anchor = Anchor(T_local_cam, T_world_cam)
    np.testing.assert_allclose(anchor.place(T_world_cam), T_local_cam, atol=1e-12)
    T_world_next = T_world_cam @ se3.from_xy_yaw(0.5, 0.0, 0.0)
    moved = se3.inverse(T_local_cam) @ anchor.place(T_world_next)
    np.testing.assert_allclose(moved, se3.from_xy_yaw(0.5, 0.0, 0.0), atol=1e-12)


def test_a_monocular_map_is_as_large_as_odometry_says():
    scale, anchor = Scale(), None
    for index in range(30):
        T_odom_cam = se3.from_xy_yaw(0.05 * index, 0.01 * index, 0.02 * index)
        T_world_cam = se3.from_xy_yaw(1.0, 2.0, 0.3) @ T_odom_cam
        T_world_cam[:3, 3] /= 2.5
        scale.add(T_world_cam, T_odom_cam)
        is_short = bool(np.linalg.norm(T_odom_cam[:3, 3]) < 0.5)
        assert (scale.metres is None) is is_short
        if anchor is None and scale.metres is not None:
            anchor = Anchor(T_odom_cam, T_world_cam, scale.metres)
        if anchor is not None:
            np.testing.assert_allclose(anchor.place(T_world_cam), T_odom_cam, atol=1e-9)


def test_a_map_of_another_motion_gets_no_scale():
    scale = Scale()
    for index in range(30):
        scale.add(se3.from_xy_yaw(0.0, 0.3 * index, 0.0), se3.from_xy_yaw(0.05 * index, 0.0, 0.0))
    assert scale.metres is None


class FakeOrbSlam3:
    """Stands still at the origin; writes its trajectory as `System::SaveTrajectoryTUM` does."""

    Sensor = SimpleNamespace(RGBD=0, MONOCULAR=1)
    TrackingState = SimpleNamespace(
        OK=0, OK_KLT=1, NO_IMAGES_YET=2, NOT_INITIALIZED=3, SYSTEM_NOT_READY=4
    )

    def Slam(self, vocabulary, settings, sensor):
        self.stamps_s = []
        return self

    def track_rgbd(self, image, depth, stamp_s):
        self.stamps_s.append(stamp_s)
        return SimpleNamespace(state=0, pose_valid=True, pose_wc=np.eye(4), num_tracked_points=100)

    def map_changed(self):
        return False

    def tracked_map_points(self):
        return np.random.default_rng(0).uniform(-1.0, 1.0, (100, 3))

    def save_trajectory_tum(self, path):
        Path(path).write_text("".join(f"{s:.6f} 0 0 0 0 0 0 1\n" for s in self.stamps_s))


def working(tmp_path):
    settings = {"vocabulary": str(tmp_path / "words.txt"), "features": 1000, "fast": 20}
    worker = OrbSlam3Worker(FakeOrbSlam3(), tmp_path, settings)
    worker.activate(rig_fields(RIG))
    return worker


def test_revised_poses_have_the_stamps_of_their_images(tmp_path):
    worker = working(tmp_path)
    observation = observation_fields(room_observation(0))
    stamps_ns = [1_700_000_000_123_456_789 + 33_333_333 * index for index in range(50)]
    for stamp_ns in stamps_ns:
        worker.track({**observation, "stamp_ns": np.int64(stamp_ns)})
    assert worker.trajectory()["stamps_ns"].tolist() == stamps_ns


@needs_orb_slam3
def test_a_vocabulary_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"vocabulary: got .*sceneslam\.vocabulary"):
        module(vocabulary=tmp_path / "no.txt")


@needs_orb_slam3
def test_it_tracks_through_a_gap_of_images_and_hands_over_its_map():
    slam = module()
    slam.activate(RIG)
    statuses = [
        slam.track(replace(room_observation(index), **({"depth_m": None} if index == 5 else {})))
        for index in range(10)
    ]
    assert statuses[5].status is TrackingStatus.DEGRADED  # carried on by the wheels
    assert statuses[9].status is TrackingStatus.TRACKING
    assert len(slam.get_trajectory().stamps_ns) == 9
    points = slam.get_map().points.points
    slam.shutdown()
    slam.note_failure()
    assert len(points) > 100 and np.abs(points).max() < 6.0  # it lies in the room
