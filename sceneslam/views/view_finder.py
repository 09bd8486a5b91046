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
_MATCHES_MIN = 25  # right by the pose found; by chance hardly more are than the three it is made of
_FOUND_MIN = 0.15  # of the landmarks in view
_SURFACE_MIN = 0.7  # of the matches with depth, within the tolerance
_SURFACE_M, _SURFACE_RATIO = 0.05, 0.03  # 5 cm and 3 % of the depth: structured light at 5 m
_DEVIATION_MAX_M = 0.03  # of the pose: what agrees within 0.1 m is then no chance
_NEAR_M = 0.1  # nothing nearer is in view
_ALIKE = 0.6  # another place with so many of the best one's matches, and nothing is recognized
_SAME_M, _SAME_RAD = 0.3, 0.15
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
            near = [
                number
                for number, (T_map_seen, _) in enumerate(self._placed)
                if np.linalg.norm(T_map_seen[:3, 3] - around[:3, 3]) < _PLACE_M
            ]
        found = [
            one for k in self._candidates(view, near) if (one := self._at(k, view)) is not None
        ]
        if not found:
            return None
        best = max(found, key=lambda one: one.matches)
        for other in found:
            if other.matches >= _ALIKE * best.matches and not _is_same(best, other):
                return None
        return best

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
        turn, shift = cv2.solvePnPRefineLM(points[kept], rays[kept], np.eye(3), None, turn, shift)
        T_cam_seen = se3.identity()
        T_cam_seen[:3, :3], T_cam_seen[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        if not self._is_verified(T_cam_seen, landmarks, points[kept], view.depth_m[columns[kept]]):
            return None
        covariance = self._covariance(np.asarray(se3.apply(T_cam_seen, points[kept]), np.float64))
        covariance += view.shear_rad**2 * np.eye(6)  # seen a metre away, a turn is a shift
        if np.linalg.eigvalsh(covariance[:3, :3])[-1] > _DEVIATION_MAX_M**2:
            return None
        T_seen_base = se3.inverse(T_cam_seen) @ se3.inverse(self._camera.T_base_cam)
        return Sighting(
            T_map_base=T_map_seen @ T_seen_base, covariance=covariance, matches=len(kept)
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
