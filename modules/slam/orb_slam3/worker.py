"""The program that runs ORB-SLAM3: the only file that imports pyorbslam3, which is GPL-3.

It is never imported: `module.py` starts it in another process and exchanges messages with it.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import InputError
from sceneslam.types.se3 import Transform, from_quat_xyzw, inverse
from sceneslam.vocabulary import describe, train

from ..process.client import DEGRADED, LOST, TRACKING, pose, poses, serve
from ..process.protocol import Fields, as_text
from ..voxel_cloud import VoxelCloud
from .anchor import Anchor
from .scale import Scale
from .settings import write_settings

_POINTS_EVERY = 10  # images
_POINT_M = 0.02  # edge of the voxels that keep one point each


class OrbSlam3Worker:
    """Tracks with ORB-SLAM3; `orb` is the package, `folder` holds its files."""

    requires = "image depth\nimage odometry"

    def __init__(self, orb: Any, folder: Path, settings: dict[str, Any]) -> None:
        self._orb, self._folder, self._settings = orb, folder, settings
        self._slam: Any = None
        self._anchors: list[Anchor] = []  # of all maps, the current one last
        self._is_new_map = True
        self._scale: Scale | None = None  # of the current map, without depth
        self._T_local_base: Transform = np.eye(4)
        self._T_odom_base: Transform | None = None  # odometry at that pose
        self._revision, self._images = 0, 0
        self._cloud = VoxelCloud(_POINT_M)
        self._stamps_ns: list[int] = []  # of all images

    def activate(self, rig: Fields) -> None:
        """Write the settings; start ORB-SLAM3 if there is a vocabulary."""
        self._T_base_cam = rig["camera.T_base_cam"]
        self._has_depth = "depth" in as_text(rig["sensors"]).split()
        names = ("features", "fast")
        values = {name: self._settings[name] for name in names}
        write_settings(rig, self._folder / "settings.yaml", **values)
        if self._settings["vocabulary"] is not None:
            self._start(Path(self._settings["vocabulary"]))

    def set_scene(self, scene: str) -> None:
        """Do nothing."""

    def track(self, observation: Fields) -> dict[str, Any]:
        """Return the pose; empty without image or depth, then odometry is used."""
        image = observation.get("image_bgr")
        depth = observation.get("depth_m")
        if image is None or (depth is None and self._has_depth):
            return poses([], [])
        stamp_ns = int(observation["stamp_ns"])
        if self._slam is None:
            try:
                self._start(self._trained(image))
            except InputError:  # no features yet
                return pose(stamp_ns, self._T_local_base, LOST)
        self._stamps_ns.append(stamp_ns)
        if self._has_depth:
            found = self._slam.track_rgbd(image, depth, stamp_ns * 1e-9)
        else:
            found = self._slam.track_monocular(image, stamp_ns * 1e-9)
        return self._answer(stamp_ns, found, observation.get("T_odom_base"))

    def trajectory(self) -> dict[str, Any]:
        """Return the poses corrected by loop closures, if there was only one map."""
        if len(self._anchors) != 1 or not self._has_depth:  # no trajectory in monocular mode
            return poses([], [])
        path = self._folder / "trajectory.txt"
        self._slam.save_trajectory_tum(str(path))
        rows = np.loadtxt(path, ndmin=2)
        if not len(rows):
            return poses([], [])
        T_cam_base = inverse(self._T_base_cam)
        T_world_cam = from_quat_xyzw(rows[:, 1:4], rows[:, 4:])
        placed = [self._anchors[0].place(T) @ T_cam_base for T in T_world_cam]
        # The file's stamps are rounded to microseconds; each is that of the nearest image.
        stamps_ns = np.array(self._stamps_ns, np.int64)
        middles_ns = (stamps_ns[1:] + stamps_ns[:-1]) // 2
        nearest = np.searchsorted(middles_ns, np.rint(rows[:, 0] * 1e9))
        return poses(stamps_ns[nearest].tolist(), placed)

    def map(self) -> dict[str, Any]:
        """Return the tracked map points, in local [m]."""
        points = self._cloud.points()
        return {"points.points": points} if len(points) else {}

    def _start(self, vocabulary: Path) -> None:
        settings = self._folder / "settings.yaml"
        sensor = self._orb.Sensor.RGBD if self._has_depth else self._orb.Sensor.MONOCULAR
        self._slam = self._orb.Slam(vocabulary, settings, sensor)

    def _trained(self, image: NDArray[np.uint8]) -> Path:
        """Return the path of a vocabulary of the first image, sufficient for feature matching."""
        path = self._folder / "vocabulary.txt"
        train([describe(image)], seed=0).write(path)
        return path

    def _answer(self, stamp_ns: int, found: Any, T_odom_base: Any) -> dict[str, Any]:
        state = self._orb.TrackingState
        self._images += 1
        is_beginning = found.state in (
            state.NO_IMAGES_YET,
            state.NOT_INITIALIZED,
            state.SYSTEM_NOT_READY,
        )
        if is_beginning:
            self._is_new_map, self._scale = True, None
        is_tracked = found.pose_valid and found.state in (state.OK, state.OK_KLT)
        T_expected_base = self._expected(T_odom_base)
        metres = self._metres(found.pose_wc, T_odom_base) if is_tracked else None
        status = LOST
        if metres is not None:
            self._place(found.pose_wc, T_expected_base @ self._T_base_cam, metres)
            T_local_cam = self._anchors[-1].place(found.pose_wc)
            self._T_local_base = T_local_cam @ inverse(self._T_base_cam)
            self._T_odom_base, status = T_odom_base, TRACKING
            self._keep_points()
        elif not self._has_depth and T_odom_base is not None and (is_tracked or is_beginning):
            # The map has no scale yet; only odometry can provide it.
            self._T_local_base, self._T_odom_base, status = T_expected_base, T_odom_base, DEGRADED
        inliers = int(found.num_tracked_points) if status == TRACKING else 0
        reply = pose(stamp_ns, self._T_local_base, status, inliers=inliers)
        return {**reply, "revision": self._revision}

    def _metres(self, T_world_cam: Transform, T_odom_base: Any) -> float | None:
        """Return the metres per unit of the current map, None if unknown."""
        if self._has_depth:
            return 1.0
        if T_odom_base is not None and self._is_new_map:
            self._scale = self._scale or Scale()
            self._scale.add(T_world_cam, T_odom_base @ self._T_base_cam)
        return None if self._scale is None else self._scale.metres

    def _place(self, T_world_cam: Transform, T_expected_cam: Transform, metres: float) -> None:
        """Find the anchor of the current map; a new map is placed at the expected pose."""
        if self._is_new_map:
            self._anchors.append(Anchor(T_expected_cam, T_world_cam, metres))
            self._is_new_map = False
        elif self._slam.map_changed():
            self._revision += 1
            # After a loop closure or a merge of maps, the pose is in an older map.
            self._anchors.sort(key=lambda one: -_distance(one.place(T_world_cam), T_expected_cam))

    def _expected(self, T_odom_base: Any) -> Transform:
        """Return the last pose moved by odometry, T_local_cam (4, 4) [m]."""
        if T_odom_base is None:
            return self._T_local_base
        if self._T_odom_base is None:
            self._T_odom_base = T_odom_base
        return np.asarray(self._T_local_base @ inverse(self._T_odom_base) @ T_odom_base)

    def _keep_points(self) -> None:
        if self._images % _POINTS_EVERY == 1:  # including the first
            points_world = self._slam.tracked_map_points()
            self._cloud.add(self._anchors[-1].place_points(points_world))


def _distance(T_a: Transform, T_b: Transform) -> float:
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]))


def main(settings: dict[str, Any]) -> None:
    """Serve requests until the input is closed."""
    import pyorbslam3

    with tempfile.TemporaryDirectory(prefix="orb_slam3_") as folder:
        serve(OrbSlam3Worker(pyorbslam3, Path(folder), settings))
    sys.stderr.flush()
    os._exit(0)  # its threads would keep running
