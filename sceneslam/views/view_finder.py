"""Find the place of a view among those of a map, and the pose there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform
from sceneslam.views.place_index import PlaceIndex
from sceneslam.views.view import Landmarks, LandmarkView

_LIKE = 40  # most similar views that candidates are taken from
_PLACES, _PER_PLACE = 4, 2  # that are looked at, and views of each
_PLACE_M = 2.0  # views this near show one place
_RATIO = 0.8  # of the best match's distance to the second's (Lowe, IJCV 2004)
_ERROR_PX, _SIGMA_PX = 3.0, 1.0  # of a match's ray, at most and usually
_ITERATIONS, _CONFIDENCE = 300, 0.9999
_GUIDED_PX = 9.0  # from where a pose by one view of the map expects a landmark of the others
_SAME_BITS = 50  # descriptors that differ in more show two corners (Mur-Artal et al., T-RO 2015)
_MATCHES_MIN = 25  # right by the pose found; by chance hardly more are than the three it is made of
_FOUND_MIN = 0.15  # of the landmarks in view
_SURFACE_MIN = 0.7  # of the matches with depth, within the tolerance
_SURFACE_M, _SURFACE_RATIO = 0.05, 0.03  # 5 cm and 3 % of the depth: structured light at 5 m
_DEVIATION_MAX_M, _DEVIATION_MAX_RAD = 0.03, 0.015  # of the pose: what agrees within 0.1 m ...
_NEAR_M = 0.1  # nothing nearer is in view
_ALIKE = 0.6  # another place with so many of the best one's matches, and nothing is recognized
_SAME_M, _SAME_RAD = 0.3, 0.15
_ROUNDS = 2  # of the pose by all views: which matches are right depends on it
_FLOOR = np.repeat([0.01, 0.004], 3) ** 2  # m, rad: of the map's landmarks among each other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """The pose of a view in the map."""

    T_map_base: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order, base frame
    matches: int


class ViewFinder:
    """Recognizes views by the landmarks of a map, at any pose.

    Places that look alike are not recognized where the map has both of them.
    """

    def __init__(self, camera: Camera, placed: Sequence[tuple[Transform, Landmarks]]) -> None:
        """Take views with their poses T_map_base (4, 4)."""
        self._camera, self._placed = camera, list(placed)
        self._index = PlaceIndex()
        for number, (_, landmarks) in enumerate(self._placed):
            self._index.insert(number, landmarks.descriptors)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def recognize(self, view: LandmarkView, around: Transform | None = None) -> Sighting | None:
        """Return the pose of a view, None if it shows no place of the map, or two alike.

        With `around` (4, 4), T_map_base as it is expected, only what was seen near it counts.
        """
        near = None
        if around is not None:
            near = self._near(around)
        found = {
            k: one for k in self._candidates(view, near) if (one := self._at(k, view)) is not None
        }
        if not found:
            return None
        number = max(found, key=lambda k: found[k].matches)
        best = found[number]
        for other in found.values():
            if other.matches >= _ALIKE * best.matches and not _is_same(best, other):
                return None
        return self._refined(view, best, self._near(self._placed[number][0]))

    def _candidates(self, view: LandmarkView, near: list[int] | None) -> list[int]:
        """Return the most similar views, a few of each of the most similar places."""
        places: list[list[int]] = []
        for likeness in self._index.alike(view.descriptors, near)[:_LIKE]:
            number = likeness.place_id
            same = next((one for one in places if self._is_near(one[0], number)), None)
            if same is None and len(places) < _PLACES:
                places.append([number])
            elif same is not None and len(same) < _PER_PLACE:
                same.append(number)
        return [number for place in places for number in place]

    def _is_near(self, one: int, other: int) -> bool:
        """Tell whether two views of the map show one place."""
        at, there = (self._placed[number][0][:3, 3] for number in (one, other))
        return bool(np.linalg.norm(at - there) < _PLACE_M)

    def _at(self, number: int, view: LandmarkView) -> Sighting | None:
        """Return the pose by the landmarks of one view of the map."""
        T_map_seen, landmarks = self._placed[number]
        pairs = self._matcher.knnMatch(landmarks.descriptors, view.descriptors, k=2)
        good = [pair[0] for pair in pairs if pair[0].distance < _RATIO * pair[-1].distance]
        best = {match.trainIdx: match for match in sorted(good, key=lambda one: -one.distance)}
        if len(best) < _MATCHES_MIN:
            return None
        rows = np.array([match.queryIdx for match in best.values()])
        columns = np.array(list(best))
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
        if not is_found or inliers is None or len(inliers) < _MATCHES_MIN:
            return None
        kept = inliers[:, 0]
        T_cam_seen = _optimised(points[kept], rays[kept], turn, shift)
        if not self._is_verified(T_cam_seen, landmarks, points[kept], view.depth_m[columns[kept]]):
            return None
        return self._sighting(T_map_seen, T_cam_seen, points[kept], view)

    def _refined(self, view: LandmarkView, rough: Sighting, near: Sequence[int]) -> Sighting | None:
        """Return the pose by the landmarks of all views `near` it; None if it is uncertain."""
        T_map_base, camera = rough.T_map_base, self._camera
        T_base_seen = [se3.inverse(T_map_base) @ self._placed[number][0] for number in near]
        seen = [self._placed[number][1] for number in near]
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
        matches = self._matcher.match(
            np.concatenate([landmarks.descriptors for landmarks in seen])[ahead],
            view.descriptors,
            is_near.astype(np.uint8),
        )
        good = [match for match in matches if match.distance <= _SAME_BITS]
        rows = ahead[[match.queryIdx for match in good]]
        columns, owner = np.unique([match.trainIdx for match in good], return_inverse=True)
        counts = np.bincount(owner, minlength=len(columns))
        points = np.stack(
            [np.bincount(owner, every[rows, axis]) / counts for axis in range(3)], axis=1
        )
        rays = view.rays[columns].astype(float)
        T_cam_base = se3.inverse(camera.T_base_cam)
        for _ in range(_ROUNDS):
            at = se3.apply(T_cam_base, points)
            off = np.linalg.norm(at[:, :2] / at[:, 2:] - rays, axis=1)
            kept = (at[:, 2] > _NEAR_M) & (off <= _ERROR_PX / camera.fx)
            if kept.sum() < _MATCHES_MIN:
                return None
            turn, shift = cv2.Rodrigues(T_cam_base[:3, :3])[0], T_cam_base[:3, 3:]
            T_cam_base = _optimised(points[kept], rays[kept], turn, shift)
        found = self._sighting(T_map_base, T_cam_base, points[kept], view)
        deviations = np.sqrt(
            [
                np.linalg.eigvalsh(block)[-1]
                for block in (found.covariance[:3, :3], found.covariance[3:, 3:])
            ]
        )
        is_certain = (deviations <= [_DEVIATION_MAX_M, _DEVIATION_MAX_RAD]).all()
        return found if is_certain else None

    def _near(self, T_map_base: Transform) -> list[int]:
        """Return the views of the map that were taken near a pose (4, 4)."""
        return [
            number
            for number, (T_map_seen, _) in enumerate(self._placed)
            if np.linalg.norm(T_map_seen[:3, 3] - T_map_base[:3, 3]) < _PLACE_M
        ]

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
        return se3.carried(np.linalg.inv(information), T_base_cam) + np.diag(_FLOOR)


def _is_same(one: Sighting, other: Sighting) -> bool:
    return se3.is_within(se3.inverse(one.T_map_base) @ other.T_map_base, _SAME_M, _SAME_RAD)


def _deviation(covariance: NDArray[np.float64]) -> float:
    """Return the standard deviation in the least certain direction of a covariance (3, 3)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


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
