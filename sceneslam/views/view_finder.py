"""Find the place of a view among those of a map, and the pose there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform
from sceneslam.types.spread import spread
from sceneslam.views.placed_views import (
    FLOOR,
    MATCHES_MIN,
    SIGMAS,
    PlacedViews,
    Sighting,
    landmark_noise_m,
    matches,
)
from sceneslam.views.view import Landmarks, LandmarkView

_ERROR_PX, _SIGMA_PX = 3.0, 1.0  # of a match's ray, at most and usually
_ITERATIONS, _CONFIDENCE = 300, 0.9999
_DEPTH_LEAST = 0.1  # of the expected noise of a depth
_STEPS = 4  # of Gauss-Newton, from a pose that the rays fit already
_GUIDED_PX = 9.0  # from where a pose by one view of the map expects a landmark of the others
_SAME_BITS = 50  # descriptors that differ in more show two corners (Mur-Artal et al., T-RO 2015)
_FOUND_MIN = 0.15  # of the landmarks in view
_SURFACE_MIN = 0.7  # of the matches with depth, within the tolerance
_SURFACE_M, _SURFACE_RATIO = 0.05, 0.03  # 5 cm and 3 % of the depth: structured light at 5 m
_NEAR_M = 0.1  # nothing nearer is in view
_TOGETHER = 12  # views of a place by which a pose is measured: 5,000 landmarks
_ROUNDS = 2  # of the pose by all views: which matches are right depends on it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Matched:
    """Landmarks of the map, and how a view shows them."""

    points: NDArray[np.float64]  # (N, 3) [m]
    rays: NDArray[np.float64]  # (N, 2)
    depth_m: NDArray[np.float64]  # (N,), 0 = missing

    @classmethod
    def of(
        cls, points: NDArray[np.floating], view: LandmarkView, columns: NDArray[np.int64]
    ) -> _Matched:
        """Return points (N, 3) that are the features `columns` (N,) of a view."""
        return cls(
            points=points.astype(float),
            rays=view.rays[columns].astype(float),
            depth_m=view.depth_m[columns].astype(float),
        )

    def __getitem__(self, rows: NDArray[Any]) -> _Matched:
        return _Matched(points=self.points[rows], rays=self.rays[rows], depth_m=self.depth_m[rows])


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
        found = _Matched.of(landmarks.points_base[rows], view, columns)
        error = _ERROR_PX / self._camera.fx
        is_found, turn, shift, inliers = cv2.solvePnPRansac(
            found.points,
            found.rays,
            np.eye(3),
            None,
            iterationsCount=_ITERATIONS,
            reprojectionError=error,
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not is_found or inliers is None or len(inliers) < MATCHES_MIN:
            return None
        found = found[inliers[:, 0]]
        rough = np.eye(4)
        rough[:3, :3], rough[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        T_cam_seen = self._optimised(rough, found)
        if not self._is_verified(T_cam_seen, landmarks, found):
            return None
        return self._sighting(T_map_seen, T_cam_seen, found, view)

    def _refined(self, view: LandmarkView, rough: Sighting, near: Sequence[int]) -> Sighting:
        """Return the pose by the landmarks of all views `near` it, if these are more."""
        found = self._guided(view, rough.T_map_base, near)
        T_cam_base = se3.inverse(self._camera.T_base_cam)
        for _ in range(_ROUNDS):
            at = se3.apply(T_cam_base, found.points)
            off = np.linalg.norm(at[:, :2] / at[:, 2:] - found.rays, axis=1)
            kept = (at[:, 2] > _NEAR_M) & (off <= _ERROR_PX / self._camera.fx)
            if kept.sum() < rough.matches:
                return rough
            T_cam_base = self._optimised(T_cam_base, found[kept])
        return self._sighting(rough.T_map_base, T_cam_base, found[kept], view)

    def _guided(self, view: LandmarkView, T_map_base: Transform, near: Sequence[int]) -> _Matched:
        """Return the landmarks of views `near`, in base, that a view shows where expected.

        A corner that several landmarks fit is at their mean.
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
        return _Matched.of(points, view, columns)

    def _sighting(
        self, T_map_seen: Transform, T_cam_seen: Transform, found: _Matched, view: LandmarkView
    ) -> Sighting:
        """Return the pose T_cam_seen (4, 4) of the camera, by landmarks, in the map."""
        information, _ = self._equations(T_cam_seen, found)
        covariance = se3.carried(np.linalg.inv(information), self._camera.T_base_cam) + FLOOR
        covariance += view.shear_rad**2 * np.eye(6)  # seen a metre away, a turn is a shift
        T_seen_base = se3.inverse(T_cam_seen) @ se3.inverse(self._camera.T_base_cam)
        return Sighting(
            T_map_base=T_map_seen @ T_seen_base, covariance=covariance, matches=len(found.points)
        )

    def _is_verified(self, T_cam_seen: Transform, landmarks: Landmarks, found: _Matched) -> bool:
        """Tell whether most landmarks in view were found, and at the depths measured."""
        camera, every = self._camera, se3.apply(T_cam_seen, landmarks.points_base.astype(float))
        ahead = every[every[:, 2] > _NEAR_M]
        uv_px = ahead[:, :2] / ahead[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        in_view = ((uv_px >= 0) & (uv_px < camera.size_wh)).all(axis=1)
        if len(found.points) < _FOUND_MIN * in_view.sum():
            return False
        z, seen = se3.apply(T_cam_seen, found.points)[:, 2], found.depth_m > 0
        if not seen.any():
            return False
        off_m = np.abs(z - found.depth_m)[seen]
        return bool((off_m <= _SURFACE_M + _SURFACE_RATIO * z[seen]).mean() >= _SURFACE_MIN)

    def _optimised(self, T_cam_seen: Transform, found: _Matched) -> Transform:
        """Return the pose (4, 4) that best fits the rays and depths of landmarks."""
        for _ in range(_STEPS):
            information, gradient = self._equations(T_cam_seen, found)
            step = np.asarray(-np.linalg.solve(information, gradient), np.float64)
            T_cam_seen = se3.exp(step) @ T_cam_seen
        return T_cam_seen

    def _equations(
        self, T_cam_seen: Transform, found: _Matched
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the information (6, 6) and the gradient (6,) of a pose, in the camera's axes.

        A depth that is far off does not count: corners lie on edges. How noisy the others are, they
        tell themselves: of landmarks in a small patch, depths measure the heading best.
        """
        at = np.asarray(se3.apply(T_cam_seen, found.points), np.float64)
        x, y, z = at.T
        by_point = np.zeros((len(z), 3, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
        by_point[:, 0, 2], by_point[:, 1, 2], by_point[:, 2, 2] = -x / z**2, -y / z**2, 1.0
        by_pose = np.concatenate([np.tile(np.eye(3), (len(z), 1, 1)), -se3.hat(at)], axis=2)
        residual = np.column_stack([at[:, :2] / at[:, 2:] - found.rays, z - found.depth_m])
        sigma_m = landmark_noise_m(z)
        missed = np.abs(residual[:, 2]) / sigma_m
        is_near = (found.depth_m > 0) & (missed <= SIGMAS)
        if is_near.sum() >= MATCHES_MIN:
            sigma_m *= max(spread(missed[is_near]), _DEPTH_LEAST)
        weight = np.full((len(z), 3), (self._camera.fx / _SIGMA_PX) ** 2)
        weight[:, 2] = np.where(is_near, sigma_m**-2, 0.0)
        J = (by_point @ by_pose).reshape(-1, 6)
        weighted = J.T * weight.ravel()
        return weighted @ J + np.eye(6), weighted @ residual.ravel()
