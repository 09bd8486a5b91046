"""The map that the camera is tracked against: landmarks and keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from ..see.corners import LEVELS, SCALE
from ..see.features import Features
from ..see.lens import undistorted_bounds
from ..settings import RgbdSettings
from .keyframes import NO_LANDMARK, Keyframe, KeyframeStore
from .landmarks import LandmarkTable, Looks
from .shifts import learn_shifts

_SCALES = SCALE ** np.arange(LEVELS)
_COVISIBLE = 12
_MIN_COS_VIEW = 0.5  # a landmark is recognizable within 60 degrees of its viewing direction
_MIN_FOUND_RATIO = 0.25
_PROBATION = 8  # images that should contain a landmark before it may be removed
_NEAREST_M = 0.1
_FEWEST_KEYFRAMES = 3
_SHIFT_PX = 2.0  # of the depth image relative to the colours, by calibration and time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExpectedLandmarks:
    """Landmarks that the image should contain, with their predicted pixels."""

    ids: NDArray[np.int64]  # (N,)
    uv_px: NDArray[np.float64]  # (N, 2)
    levels: NDArray[np.int64]  # (N,), of the pyramid
    descriptors: NDArray[np.uint8]  # (N, 32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Doubts:
    """Standard deviations by the landmarks' positions, in addition to the measurements'."""

    across_px: NDArray[np.float64]  # (N,)
    inverse_depth_per_m: NDArray[np.float64]  # (N,)


class VisualMap:
    """Landmarks and keyframes in `local`, kept within limits by `keep_limits`."""

    def __init__(self, camera: Camera, depth_camera: Camera, *, settings: RgbdSettings) -> None:
        self.landmarks, self.keyframes = LandmarkTable(), KeyframeStore()
        self.camera, self.depth_camera = camera, depth_camera
        self._bounds_px = undistorted_bounds(camera)
        self._settings = settings
        self.inverse_depth_sigma_per_m = settings.inverse_depth_sigma_per_m
        self.corrections = 0  # how often keyframes were moved

    def sigma_px(self, levels: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the standard deviations (N,) [px] of features of these pyramid levels (N,)."""
        return np.asarray(self._settings.sigma_px * _SCALES.take(levels))

    def inverse_depth_sigmas_per_m(self, features: Features) -> NDArray[np.float64]:
        """Return the standard deviations (N,) [1/m] of the features' inverse depths.

        They include the sensor's noise and, on a slope, a shift of the depth image.
        """
        z = np.where(features.depth_m > 0, features.depth_m, 1.0)
        by_shift = _SHIFT_PX * features.depth_slope_m_per_px / z**2
        return np.asarray(np.hypot(self.inverse_depth_sigma_per_m, by_shift))

    def doubts(self, T_local_base: Transform, landmark_ids: NDArray[np.int64]) -> Doubts:
        """Return the uncertainty of landmarks (N,) in the camera at T_local_base (4, 4) [m]."""
        T_cam_local = se3.inverse(T_local_base @ self.camera.T_base_cam)
        points_local = self.landmarks.points_local.take(landmark_ids, axis=0)
        x, y, z = T_cam_local[:3, :3] @ points_local.T + T_cam_local[:3, 3:]
        z = np.maximum(z, _NEAREST_M)
        x, y = x / z, y / z
        right, down, ahead = T_cam_local[:3, :3]
        # The motion across the ray is the sideways motion minus the ray's slope times the motion
        # ahead, in both axes; each product is one entry of the covariance in cam.
        pairs = ((right, right), (down, down), (right, ahead), (down, ahead), (ahead, ahead))
        entries = np.stack([np.outer(one, other).ravel() for one, other in pairs])
        covariance = self.landmarks.covariance.take(landmark_ids, axis=0).reshape(-1, 9)
        xx, yy, xz, yz, zz = entries @ covariance.T
        across = xx + yy - 2.0 * (x * xz + y * yz) + (x * x + y * y) * zz
        return Doubts(
            across_px=self.camera.fx * np.sqrt(0.5 * np.maximum(across, 0.0)) / z,
            inverse_depth_per_m=np.sqrt(zz) / z**2,
        )

    def around(self, landmark_ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the local map (M,): all landmarks of the keyframes that saw the landmarks (N,)."""
        return self.keyframes.landmarks_of(self.keyframes.covisible(landmark_ids, limit=_COVISIBLE))

    def predict(
        self, T_local_base: Transform, landmark_ids: NDArray[np.int64]
    ) -> ExpectedLandmarks:
        """Return which of the landmarks (N,) are in view at a pose (4, 4), and their pixels."""
        camera, table = self.camera, self.landmarks
        T_local_cam = T_local_base @ camera.T_base_cam
        # Component by component: NumPy is slow along axes of two or three.
        away = _rows(table.points_local.take(landmark_ids, axis=0)) - T_local_cam[:3, 3:]
        normals = _rows(table.normals_local.take(landmark_ids, axis=0))
        x, y, z = T_local_cam[:3, :3].T @ away
        distance_m = np.maximum(np.sqrt(x * x + y * y + z * z), _NEAREST_M)
        inverse_z = 1.0 / np.maximum(z, _NEAREST_M)
        u, v = camera.fx * x * inverse_z + camera.cx, camera.fy * y * inverse_z + camera.cy
        turned_away = (away * normals).sum(axis=0)  # minus the cosine, times the distance
        levels = np.log(table.reach_m.take(landmark_ids) / distance_m) / np.log(SCALE)
        least_px, most_px = self._bounds_px
        visible = np.flatnonzero(
            (z > _NEAREST_M)
            & (turned_away < -_MIN_COS_VIEW * distance_m)
            & (u >= least_px[0])
            & (u <= most_px[0])
            & (v >= least_px[1])
            & (v <= most_px[1])
            & (levels > -1.5)
            & (levels < LEVELS + 0.5)
        )
        ids = landmark_ids.take(visible)
        return ExpectedLandmarks(
            ids=ids,
            uv_px=np.stack([u.take(visible), v.take(visible)], axis=1),
            levels=np.clip(np.rint(levels.take(visible)), 0, LEVELS - 1).astype(np.int64),
            descriptors=table.descriptors.take(ids, axis=0),
        )

    def count_sightings(
        self, expected_ids: NDArray[np.int64], found_ids: NDArray[np.int64]
    ) -> None:
        """Count the images that should contain landmarks (N,), and those that did."""
        self.landmarks.expected[expected_ids] += 1
        self.landmarks.found[found_ids] += 1

    def insert(self, keyframe: Keyframe, *, deep_rows: NDArray[np.int64]) -> int:
        """Add a keyframe: fuse its landmarks, and make new ones of its other features.

        Returns its id, and drops landmarks that are seldom found again. `deep_rows` (N,) are the
        features whose depth agrees with their landmark.
        """
        features, ids = keyframe.features, keyframe.landmark_ids
        known = np.flatnonzero(ids != NO_LANDMARK)
        fresh = np.flatnonzero((ids == NO_LANDMARK) & (features.depth_m > 0))
        points_local, information = self._locate(keyframe, deep_rows)
        self.landmarks.fuse(ids[deep_rows], points_local=points_local, information=information)
        points_local = self.landmarks.points_local[ids[known]]
        self.landmarks.describe(ids[known], self.looks(keyframe, known, points_local))
        points_local, information = self._locate(keyframe, fresh)
        looks = self.looks(keyframe, fresh, points_local)
        ids[fresh] = self.landmarks.add(
            points_local=points_local, information=information, looks=looks
        )
        learn_shifts(self.landmarks, self.camera, keyframe)
        keyframe_id = self.keyframes.insert(keyframe)
        table = self.landmarks
        judged = table.alive & (table.expected >= _PROBATION)
        self.drop(np.flatnonzero(judged & (table.found < _MIN_FOUND_RATIO * table.expected)))
        return keyframe_id

    def correct(self, T_local_base: Mapping[int, Transform]) -> None:
        """Give keyframes, by id, new poses; each landmark moves along with its first keyframe.

        Rotations are orthonormalized: poses are often products of those that they replace, so that
        rounding errors would double with every correction.
        """
        T_local_base = {k: se3.orthonormal(T_new) for k, T_new in T_local_base.items()}
        T_new_old = {
            keyframe_id: T_new @ se3.inverse(self.keyframes[keyframe_id].T_local_base)
            for keyframe_id, T_new in T_local_base.items()
        }
        for keyframe_id, landmark_ids in self.keyframes.owned_landmarks().items():
            if keyframe_id in T_new_old:
                self.landmarks.move(landmark_ids, T_new_old[keyframe_id])
        for keyframe_id, T_new in T_local_base.items():
            self.keyframes[keyframe_id].T_local_base = T_new
        self.corrections += 1

    def straighten(self, readout_s: float) -> None:
        """Correct all keyframes and landmarks for a readout that is longer by `readout_s`."""
        for keyframe in self.keyframes.all():
            keyframe.straighten(self.camera, readout_s)
        self.landmarks.points_local += readout_s * self.landmarks.shift_local
        self.corrections += 1

    def _locate(
        self, keyframe: Keyframe, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (N, 3) of features in `local` and their information (N, 3, 3)."""
        camera, features = self.camera, keyframe.features
        z = features.depth_m[rows]
        rays = (features.uv_px[rows] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        points_cam = np.column_stack([rays, np.ones(len(rows))]) * z[:, None]
        T_local_cam = keyframe.T_local_base @ camera.T_base_cam
        across_m = self.sigma_px(features.levels[rows]) * z / camera.fx
        along_m = self.inverse_depth_sigmas_per_m(features)[rows] * z**2
        weights = np.stack([across_m, across_m, np.maximum(along_m, across_m)], axis=1) ** -2.0
        rotation = T_local_cam[:3, :3]
        information = np.einsum("ik,nk,jk->nij", rotation, weights, rotation)
        return points_cam @ rotation.T + T_local_cam[:3, 3], information

    def looks(
        self, keyframe: Keyframe, rows: NDArray[np.int64], points_local: NDArray[np.float64]
    ) -> Looks:
        """Return the appearance of landmarks (N, 3) [m] in a keyframe's features `rows`."""
        viewer_local = (keyframe.T_local_base @ self.camera.T_base_cam)[:3, 3]
        to_viewer = viewer_local - points_local
        distance_m = np.maximum(np.linalg.norm(to_viewer, axis=1), _NEAREST_M)
        return Looks(
            descriptors=keyframe.features.descriptors[rows],
            normals_local=to_viewer / distance_m[:, None],
            reach_m=distance_m * _SCALES.take(keyframe.features.levels[rows]),
        )

    def keep_limits(self) -> None:
        """Remove keyframes beyond the limits, and the landmarks that no other one shows."""
        limits = self._settings
        while len(self.keyframes) > limits.keyframe_limit or (
            len(self.landmarks) > limits.landmark_limit and len(self.keyframes) > _FEWEST_KEYFRAMES
        ):
            self.keyframes.remove(self.keyframes.most_redundant())
            orphans = self.landmarks.alive.copy()
            orphans[self.keyframes.landmarks_of(self.keyframes.ids)] = False
            self.drop(np.flatnonzero(orphans))

    def join(self, kept_ids: NDArray[np.int64], gone_ids: NDArray[np.int64]) -> None:
        """Replace landmarks `gone_ids` (N,) by `kept_ids` (N,)."""
        self.keyframes.rename_landmarks(gone_ids, kept_ids)
        self.landmarks.remove(gone_ids)

    def drop(self, landmark_ids: NDArray[np.int64]) -> None:
        """Remove the landmarks (N,)."""
        self.keyframes.forget_landmarks(landmark_ids)
        self.landmarks.remove(landmark_ids)


def _rows(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors (N, 3) as rows of their components (3, N)."""
    return np.ascontiguousarray(vectors.T)
