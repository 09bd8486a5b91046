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
from sceneslam.views.matching import matches
from sceneslam.views.placed_views import (
    FLOOR,
    MATCHES_MIN,
    SIGMAS,
    PlacedViews,
    Sighting,
)
from sceneslam.views.view import NEAR_M, SIGMA_PX, Landmarks, LandmarkView, depth_noise_m

_ERROR_PX = 3.0  # of a match's ray, at most
_ITERATIONS, _CONFIDENCE = 300, 0.9999
_DEPTH_LEAST = 0.1  # of the expected noise of a depth
_MEASURED = 1.5  # times that noise, at most: a depth camera located it, from a little farther away
_STEPS = 4  # of Gauss-Newton, from a pose that the rays fit already
_GUIDED_PX = 9.0  # from where a pose by one view of the map expects a landmark of the others
_SAME_BITS = 50  # descriptors that differ in more show two corners (Mur-Artal et al., T-RO 2015)
_FOUND_MIN = 0.15  # of the landmarks in view
_SURFACE_MIN = 0.7  # of the matches with depth
_TOGETHER = 12  # views of a place by which a pose is measured: 5,000 landmarks
_ROUNDS = 2  # of the pose by all views: which matches are right depends on it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """Landmarks of the map, in one frame."""

    points: NDArray[np.float64]  # (N, 3) [m]
    deviation_m: NDArray[np.float64]  # (N,), of their distances from where they were seen
    cameras: NDArray[np.float64]  # (N, 3) [m]: that place

    @classmethod
    def of(cls, views: Sequence[tuple[Transform, Landmarks]]) -> _Seen:
        """Return the landmarks of one view or more, with their cameras' poses (4, 4)."""
        points = [se3.apply(T, one.points_cam.astype(float)) for T, one in views]
        cameras = [np.tile(T[:3, 3], (len(one), 1)) for T, one in views]
        return cls(
            points=np.concatenate(points),
            deviation_m=np.concatenate([one.deviation_m for _, one in views]).astype(float),
            cameras=np.concatenate(cameras),
        )

    def ray_variance(self, camera: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
        """Return the variances (N,) of the rays to them, from a camera at (3,).

        Beside the deviation `sigma` of a ray, errors of the distances move them aside.
        """
        then, now = self.points - self.cameras, self.points - camera
        lengths = np.linalg.norm(then, axis=1) * (now**2).sum(axis=1)
        crossed = np.linalg.norm(np.cross(then, now), axis=1)
        aside = self.deviation_m * crossed / np.maximum(lengths, 1e-9)
        return np.asarray(sigma**2 + aside**2)

    def __getitem__(self, rows: NDArray[Any]) -> _Seen:
        return _Seen(
            points=self.points[rows],
            deviation_m=self.deviation_m[rows],
            cameras=self.cameras[rows],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Matched:
    """Landmarks of the map, and how a view shows them."""

    seen: _Seen
    rays: NDArray[np.float64]  # (N, 2)
    depth_m: NDArray[np.float64]  # (N,), 0 = missing

    @classmethod
    def of(cls, seen: _Seen, view: LandmarkView, columns: NDArray[np.int64]) -> _Matched:
        """Return landmarks that are the features `columns` (N,) of a view."""
        return cls(
            seen=seen,
            rays=view.rays[columns].astype(float),
            depth_m=view.depth_m[columns].astype(float),
        )

    def __len__(self) -> int:
        return len(self.rays)

    def depth_deviation_m(self, z: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the standard deviations (N,) of depths measured against expected ones `z`."""
        return np.asarray(np.hypot(self.seen.deviation_m, depth_noise_m(z)))

    def __getitem__(self, rows: NDArray[Any]) -> _Matched:
        return _Matched(seen=self.seen[rows], rays=self.rays[rows], depth_m=self.depth_m[rows])


class ViewFinder:
    """Recognizes views by the landmarks of a map, at any pose.

    Places that look alike are not recognized where the map has both of them.
    """

    def __init__(self, camera: Camera, placed: Sequence[tuple[Transform, Landmarks]]) -> None:
        """Take the camera that looks for them, and views with their poses T_map_cam (4, 4)."""
        self.camera, self._map = camera, PlacedViews(placed)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def recognize(self, view: LandmarkView, around: Transform | None = None) -> Sighting | None:
        """Return the pose of a view, None if it shows no place of the map, or two alike.

        With `around` (4, 4), T_map_cam as it is expected, only what was seen near it counts.
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

    def find(
        self, view: LandmarkView, expected: Transform, *, half_m: float, half_rad: float
    ) -> Sighting | None:
        """Return the pose of a view that is at most so far from the one expected, T_map_cam.

        Landmarks are looked for where they are expected, so that more are found than anywhere in
        the map. They need not be most of those in view, but the pose has to be more certain than
        what is expected.
        """
        near = self._map.near(expected)[:_TOGETHER]
        if not near:
            return None
        found = self._guided(view, expected, near, half_m, half_rad)
        fitted = self._fitted(found)
        if fitted is None or not self._is_on_surfaces(*fitted):
            return None
        best = self._refined(view, self._sighting(expected, *fitted, view), near)
        return best if best.is_within(half_m / SIGMAS, half_rad / SIGMAS) else None

    def _at(self, number: int, view: LandmarkView) -> Sighting | None:
        """Return the pose by the landmarks of one view of the map."""
        T_map_seen, landmarks = self._map[number]
        rows, columns = matches(landmarks.descriptors, view.descriptors)
        seen = _Seen.of([(se3.identity(), landmarks)])
        fitted = self._fitted(_Matched.of(seen[rows], view, columns))
        if fitted is None or not self._is_verified(landmarks, *fitted):
            return None
        return self._sighting(T_map_seen, *fitted, view)

    def _fitted(self, found: _Matched) -> tuple[Transform, _Matched] | None:
        """Return the pose that most matches agree on, with these; None if too few do."""
        if len(found) < MATCHES_MIN:
            return None
        is_found, turn, shift, inliers = cv2.solvePnPRansac(
            found.seen.points,
            found.rays,
            np.eye(3),
            None,
            iterationsCount=_ITERATIONS,
            reprojectionError=_ERROR_PX / self.camera.fx,
            confidence=_CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not is_found or inliers is None or len(inliers) < MATCHES_MIN:
            return None
        found = found[inliers[:, 0]]
        T_cam_seen = np.eye(4)
        T_cam_seen[:3, :3], T_cam_seen[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return self._optimised(T_cam_seen, found), found

    def _refined(self, view: LandmarkView, rough: Sighting, near: Sequence[int]) -> Sighting:
        """Return the pose by the landmarks of all views `near` it, if these are more."""
        found = self._guided(view, rough.T_map_cam, near, 0.0, _GUIDED_PX / self.camera.fx)
        T_cam_rough = se3.identity()
        for _ in range(_ROUNDS):
            at = se3.apply(T_cam_rough, found.seen.points)
            off = np.linalg.norm(at[:, :2] / at[:, 2:] - found.rays, axis=1)
            kept = (at[:, 2] > NEAR_M) & (off <= _ERROR_PX / self.camera.fx)
            if kept.sum() < rough.matches:
                return rough
            T_cam_rough = self._optimised(T_cam_rough, found[kept])
        return self._sighting(rough.T_map_cam, T_cam_rough, found[kept], view)

    def _guided(
        self,
        view: LandmarkView,
        T_map_cam: Transform,
        near: Sequence[int],
        half_m: float,
        half_rad: float,
    ) -> _Matched:
        """Return the landmarks of views `near`, from T_map_cam, that a view shows as expected.

        The pose is off by `half_m` and `half_rad` at most. A corner that several landmarks fit is
        at their mean, weighted by what is known of where they are seen from there.
        """
        views = [(se3.inverse(T_map_cam) @ T, one) for T, one in (self._map[n] for n in near)]
        every = _Seen.of(views)
        ahead = np.flatnonzero(every.points[:, 2] > NEAR_M)
        z = every.points[ahead, 2:]
        due = (every.points[ahead, :2] / z).astype(np.float32)
        reach = half_rad + half_m / z
        is_near = np.abs(due[:, None] - view.rays).max(axis=2) <= reach
        descriptors = np.concatenate([one.descriptors for _, one in views])
        guided = self._matcher.match(descriptors[ahead], view.descriptors, is_near.astype(np.uint8))
        good = [match for match in guided if match.distance <= _SAME_BITS]
        found = every[ahead[np.array([match.queryIdx for match in good], np.int64)]]
        seen_as = np.array([match.trainIdx for match in good], np.int64)
        columns, owner = np.unique(seen_as, return_inverse=True)
        weight = 1.0 / found.ray_variance(np.zeros(3), SIGMA_PX / self.camera.fx)
        total = np.bincount(owner, weight, minlength=len(columns))
        each = np.column_stack([found.points, found.deviation_m, found.cameras])
        mean = np.stack([np.bincount(owner, weight * one) / total for one in each.T], axis=1)
        seen = _Seen(points=mean[:, :3], deviation_m=mean[:, 3], cameras=mean[:, 4:])
        return _Matched.of(seen, view, columns)

    def _sighting(
        self, T_map_seen: Transform, T_cam_seen: Transform, found: _Matched, view: LandmarkView
    ) -> Sighting:
        """Return the pose T_cam_seen (4, 4) of the camera, by landmarks, in the map."""
        information, _ = self._equations(T_cam_seen, found)
        shear = view.shear_rad**2 * np.eye(6)  # seen a metre away, a turn is a shift
        covariance = np.asarray(np.linalg.inv(information) + FLOOR + shear)
        T_map_cam = T_map_seen @ se3.inverse(T_cam_seen)
        return Sighting(T_map_cam=T_map_cam, covariance=covariance, matches=len(found))

    def _is_verified(self, landmarks: Landmarks, T_cam_seen: Transform, found: _Matched) -> bool:
        """Tell whether enough landmarks in view were found, and at the depths measured."""
        camera, every = self.camera, se3.apply(T_cam_seen, landmarks.points_cam.astype(float))
        ahead = every[every[:, 2] > NEAR_M]
        uv_px = ahead[:, :2] / ahead[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        in_view = ((uv_px >= 0) & (uv_px < camera.size_wh)).all(axis=1)
        is_enough = len(found) >= _FOUND_MIN * in_view.sum()
        return bool(is_enough and self._is_on_surfaces(T_cam_seen, found))

    def _is_on_surfaces(self, T_cam_seen: Transform, found: _Matched) -> bool:
        """Tell whether landmarks are at the depths measured, as far as there are any."""
        z, seen = se3.apply(T_cam_seen, found.seen.points)[:, 2], found.depth_m > 0
        off = (np.abs(z - found.depth_m) / found.depth_deviation_m(z))[seen]
        return not len(off) or bool((off <= SIGMAS).mean() >= _SURFACE_MIN)

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
        at = np.asarray(se3.apply(T_cam_seen, found.seen.points), np.float64)
        x, y, z = at.T
        by_point = np.zeros((len(z), 3, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
        by_point[:, 0, 2], by_point[:, 1, 2], by_point[:, 2, 2] = -x / z**2, -y / z**2, 1.0
        by_pose = np.concatenate([np.tile(np.eye(3), (len(z), 1, 1)), -se3.hat(at)], axis=2)
        residual = np.column_stack([at[:, :2] / at[:, 2:] - found.rays, z - found.depth_m])
        sigma_m = found.depth_deviation_m(z)
        missed = np.abs(residual[:, 2]) / sigma_m
        is_near = (found.depth_m > 0) & (missed <= SIGMAS)
        is_measured = is_near & (found.seen.deviation_m <= _MEASURED * depth_noise_m(z))
        if is_measured.sum() >= MATCHES_MIN:
            sigma_m[is_measured] *= max(spread(missed[is_measured]), _DEPTH_LEAST)
        camera = se3.inverse(T_cam_seen)[:3, 3]
        variance = found.seen.ray_variance(camera, SIGMA_PX / self.camera.fx)
        weight = np.tile(1.0 / variance[:, None], 3)
        weight[:, 2] = np.where(is_near, sigma_m**-2, 0.0)
        J = (by_point @ by_pose).reshape(-1, 6)
        weighted = J.T * weight.ravel()
        return weighted @ J + np.eye(6), weighted @ residual.ravel()
