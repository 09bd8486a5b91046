"""Find the place of a view among those of a map, and the pose there."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform
from sceneslam.views.placed_views import FLOOR, MATCHES_MIN, PlacedViews, Sighting, matches
from sceneslam.views.view import Landmarks, LandmarkView

_ERROR_PX, _SIGMA_PX = 3.0, 1.0  # of a match's ray, at most and usually
_ITERATIONS, _CONFIDENCE = 300, 0.9999
_GUIDED_PX = 9.0  # from where a pose by one view of the map expects a landmark of the others
_SAME_BITS = 50  # descriptors that differ in more show two corners (Mur-Artal et al., T-RO 2015)
_FOUND_MIN = 0.15  # of the landmarks in view
_SURFACE_MIN = 0.7  # of the matches with depth, within the tolerance
_SURFACE_M, _SURFACE_RATIO = 0.05, 0.03  # 5 cm and 3 % of the depth: structured light at 5 m
_NEAR_M = 0.1  # nothing nearer is in view
_TOGETHER = 12  # views of a place by which a pose is measured: 5,000 landmarks
_ROUNDS = 2  # of the pose by all views: which matches are right depends on it


class ViewFinder:
    """Recognizes views by the landmarks of a map, at any pose.

    Places that look alike are not recognized where the map has both of them.
    """

    def __init__(self, camera: Camera, placed: Sequence[tuple[Transform, Landmarks]]) -> None:
        """Take views with their poses T_map_base (4, 4)."""
        self._camera, self._map = camera, PlacedViews(placed)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def recognize(self, view: LandmarkView, around: Transform | None = None) -> Sighting | None:
        """Return the pose of a view, None if it shows no place of the map, or two alike.

        With `around` (4, 4), T_map_base as it is expected, only what was seen near it counts.
        """
        near = None if around is None else self._map.near(around)
        found = self._map.recognize(
            view.descriptors, lambda number: self._at(number, view), among=near
        )
        if found is None:
            return None
        number, rough = found
        together = self._map.near(self._map[number][0])[:_TOGETHER]
        best = self._refined(view, rough, together)
        return best if best.is_certain else None

    def _at(self, number: int, view: LandmarkView) -> Sighting | None:
        """Return the pose by the landmarks of one view of the map."""
        T_map_seen, landmarks = self._map[number]
        rows, columns = matches(landmarks.descriptors, view.descriptors)
        if len(rows) < MATCHES_MIN:
            return None
        points, rays = landmarks.points_base[rows].astype(float), view.rays[columns].astype(float)
        error = _ERROR_PX / self._camera.fx
        is_found, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            rays,
            np.eye(3),
            None,
            iterationsCount=_ITERATIONS,
            reprojectionError=error,
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not is_found or inliers is None or len(inliers) < MATCHES_MIN:
            return None
        kept = inliers[:, 0]
        T_cam_seen = _optimised(points[kept], rays[kept], turn, shift)
        if not self._is_verified(T_cam_seen, landmarks, points[kept], view.depth_m[columns[kept]]):
            return None
        return self._sighting(T_map_seen, T_cam_seen, points[kept], view)

    def _refined(self, view: LandmarkView, rough: Sighting, near: Sequence[int]) -> Sighting:
        """Return the pose by the landmarks of all views `near` it, if these are more."""
        points, rays = self._guided(view, rough.T_map_base, near)
        T_cam_base = se3.inverse(self._camera.T_base_cam)
        for _ in range(_ROUNDS):
            at = se3.apply(T_cam_base, points)
            off = np.linalg.norm(at[:, :2] / at[:, 2:] - rays, axis=1)
            kept = (at[:, 2] > _NEAR_M) & (off <= _ERROR_PX / self._camera.fx)
            if kept.sum() < rough.matches:
                return rough
            turn, shift = cv2.Rodrigues(T_cam_base[:3, :3])[0], T_cam_base[:3, 3:]
            T_cam_base = _optimised(points[kept], rays[kept], turn, shift)
        return self._sighting(rough.T_map_base, T_cam_base, points[kept], view)

    def _guided(
        self, view: LandmarkView, T_map_base: Transform, near: Sequence[int]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the landmarks (N, 3) of views `near`, in base, that a view shows where expected.

        And their rays (N, 2) there; a corner that several landmarks fit is at their mean.
        """
        camera = self._camera
        T_base_seen = [se3.inverse(T_map_base) @ self._map[number][0] for number in near]
        seen = [self._map[number][1] for number in near]
        every = np.concatenate(
            [
                se3.apply(T, landmarks.points_base.astype(float))
                for T, landmarks in zip(T_base_seen, seen, strict=True)
            ]
        )
        points_cam = se3.apply(se3.inverse(camera.T_base_cam), every)
        ahead = np.flatnonzero(points_cam[:, 2] > _NEAR_M)
        due = (points_cam[ahead, :2] / points_cam[ahead, 2:]).astype(np.float32)
        is_near = np.abs(due[:, None] - view.rays).max(axis=2) <= _GUIDED_PX / camera.fx
        guided = self._matcher.match(
            np.concatenate([landmarks.descriptors for landmarks in seen])[ahead],
            view.descriptors,
            is_near.astype(np.uint8),
        )
        good = [match for match in guided if match.distance <= _SAME_BITS]
        rows = ahead[np.array([match.queryIdx for match in good], np.int64)]
        seen_as = np.array([match.trainIdx for match in good], np.int64)
        columns, owner = np.unique(seen_as, return_inverse=True)
        counts = np.bincount(owner, minlength=len(columns))
        points = np.stack(
            [np.bincount(owner, every[rows, axis]) / counts for axis in range(3)], axis=1
        )
        return points, view.rays[columns].astype(float)

    def _sighting(
        self,
        T_map_seen: Transform,
        T_cam_seen: Transform,
        points: NDArray[np.float64],
        view: LandmarkView,
    ) -> Sighting:
        """Return the pose T_cam_seen (4, 4) of the camera, by points (N, 3), in the map."""
        covariance = self._covariance(np.asarray(se3.apply(T_cam_seen, points), np.float64))
        covariance += view.shear_rad**2 * np.eye(6)  # seen a metre away, a turn is a shift
        T_seen_base = se3.inverse(T_cam_seen) @ se3.inverse(self._camera.T_base_cam)
        return Sighting(
            T_map_base=T_map_seen @ T_seen_base, covariance=covariance, matches=len(points)
        )

    def _is_verified(
        self,
        T_cam_seen: Transform,
        landmarks: Landmarks,
        matched: NDArray[np.float64],
        depth_m: NDArray[np.float32],
    ) -> bool:
        """Tell whether most landmarks in view were found, and at the depths (N,) [m] measured."""
        camera, every = self._camera, se3.apply(T_cam_seen, landmarks.points_base.astype(float))
        ahead = every[every[:, 2] > _NEAR_M]
        uv_px = ahead[:, :2] / ahead[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        in_view = ((uv_px >= 0) & (uv_px < camera.size_wh)).all(axis=1)
        if len(matched) < _FOUND_MIN * in_view.sum():
            return False
        z, seen = se3.apply(T_cam_seen, matched)[:, 2], depth_m > 0
        if not seen.any():
            return False
        off_m = np.abs(z - depth_m)[seen]
        return bool((off_m <= _SURFACE_M + _SURFACE_RATIO * z[seen]).mean() >= _SURFACE_MIN)

    def _covariance(self, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of base from matches at points (N, 3) in the camera."""
        x, y, z = points_cam.T
        rays = np.zeros((len(z), 2, 3))
        rays[:, 0, 0] = rays[:, 1, 1] = 1.0 / z
        rays[:, 0, 2], rays[:, 1, 2] = -x / z**2, -y / z**2
        by_pose = np.concatenate([np.tile(-np.eye(3), (len(z), 1, 1)), se3.hat(points_cam)], axis=2)
        J = (rays @ by_pose).reshape(-1, 6)
        information = J.T @ J / (_SIGMA_PX / self._camera.fx) ** 2 + np.eye(6)
        T_base_cam = self._camera.T_base_cam
        return se3.carried(np.linalg.inv(information), T_base_cam) + FLOOR


def _optimised(
    points: NDArray[np.float64],
    rays: NDArray[np.float64],
    turn: cv2.typing.MatLike,
    shift: cv2.typing.MatLike,
) -> Transform:
    """Return the pose (4, 4) of points (N, 3) in a camera that best fits their rays (N, 2)."""
    turn, shift = cv2.solvePnPRefineLM(points, rays, np.eye(3), None, turn, shift)
    T = se3.identity()
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return T
