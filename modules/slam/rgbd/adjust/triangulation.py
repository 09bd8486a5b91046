"""Triangulate landmarks from two images, without depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.views.rays import closest

from ..locate.matching import Matches, match_pairs
from ..locate.residuals import Sightings, errors
from ..map.keyframes import NO_LANDMARK, Keyframe
from ..map.visual_map import VisualMap
from ..see.features import Features

_NEIGHBOURS = 4  # keyframes that a new one is compared with
_MIN_PARALLAX_RATIO = 0.02  # baseline over distance of the landmarks
_LINE_SIGMAS = 2.0  # from the epipolar line
_LEVEL_TOLERANCE = 1
_RATIO = 0.8
_STEPS = 3
_NEAREST_M = 0.1
_NEAREST_SHARE = 0.05  # quantile of the landmarks' depths in a keyframe;
_NEARER_RATIO = 0.5  # a point nearer than this share of it is a wrong match
_CORRELATED = 10.0  # errors within one pair of images are correlated
_WHEELS_RATIO = 0.03  # of the baseline: 3 mm and 2 % of 0.3 m or more
_MAX_DOUBT_RATIO = 0.3  # of the usual inverse distance: a less certain landmark waits
_FARTHEST_RATIO = 0.2  # of the usual inverse distance: farther points do not measure motion


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Eye:
    """Features of one keyframe without a landmark."""

    keyframe: Keyframe
    rows: NDArray[np.int64]  # (N,)
    T_cam_local: Transform
    rays: NDArray[np.float64]  # (N, 3), in cam, z = 1
    sigma_px: NDArray[np.float64]  # (N,)
    nearest_m: float  # least depth of the points in its view

    @property
    def features(self) -> Features:
        return self.keyframe.features

    @property
    def levels(self) -> NDArray[np.int64]:
        """Return the levels (N,) of the pyramid, ascending."""
        return self.features.levels[self.rows]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    points_local: NDArray[np.float64]  # (N, 3) [m]
    information: NDArray[np.float64]  # (N, 3, 3) [1/m^2]
    doubt_ratio: NDArray[np.float64]  # (N,), deviation over distance
    is_sure: NDArray[np.bool_]  # (N,)


def triangulate(visual_map: VisualMap, keyframe_id: int) -> None:
    """Add landmarks for unmatched features of a keyframe and of covisible keyframes.

    Matches lie on the epipolar line; the point that best fits both pixels is kept if it is in front
    of both cameras, agrees with both, and its distance is certain (Mur-Artal et al. 2015).
    """
    store = visual_map.keyframes
    new = store[keyframe_id]
    known = new.landmark_ids[new.landmark_ids != NO_LANDMARK]
    near = (
        store.covisible(known, limit=_NEIGHBOURS + 1)
        if len(known)
        else store.ids[-_NEIGHBOURS - 1 :]
    )
    for other_id in near:
        if other_id != keyframe_id and _is_apart(visual_map, new, store[other_id], known):
            _triangulate_with(visual_map, keyframe_id, other_id)


def _is_apart(
    visual_map: VisualMap, new: Keyframe, other: Keyframe, known: NDArray[np.int64]
) -> bool:
    if not len(known):
        return True
    points = visual_map.landmarks.points_local[known]
    distance_m = float(np.median(np.linalg.norm(points - new.T_local_base[:3, 3], axis=1)))
    way_m = float(np.linalg.norm(new.T_local_base[:3, 3] - other.T_local_base[:3, 3]))
    return way_m > _MIN_PARALLAX_RATIO * distance_m


def _triangulate_with(visual_map: VisualMap, new_id: int, other_id: int) -> None:
    store = visual_map.keyframes
    new, other = _eye(visual_map, store[new_id]), _eye(visual_map, store[other_id])
    matches = _match(visual_map, new, other)
    if not len(matches):
        return
    found = _intersect(visual_map, new, other, matches)
    matches, sure = matches.only(found.is_sure), found.is_sure
    if not len(matches):
        return
    rows = new.rows[matches.landmark_rows]
    ids = visual_map.landmarks.add(
        points_local=found.points_local[sure],
        information=found.information[sure],
        looks=visual_map.looks(new.keyframe, rows, found.points_local[sure]),
        scale_sigma=_scale_sigma(visual_map, new.keyframe, found),
    )
    store.show(new_id, rows, ids)
    store.show(other_id, other.rows[matches.feature_rows], ids)


def _scale_sigma(visual_map: VisualMap, keyframe: Keyframe, found: _Found) -> float:
    """Return the common scale error of a keyframe's new landmarks, as a share of their distance.

    It is that of the landmarks that placed the keyframe, plus that of the triangulation, as errors
    within a pair of images are correlated. Wheels measure it anew with every keyframe.
    """
    known = keyframe.landmark_ids[keyframe.landmark_ids != NO_LANDMARK]
    before = float(np.mean(visual_map.landmarks.scale_sigma[known] ** 2)) if len(known) else 0.0
    doubts = found.doubt_ratio[found.is_sure]
    more = _CORRELATED * float(np.mean(doubts**2)) / len(doubts)
    variance = before + min(more, _MAX_DOUBT_RATIO**2)
    if keyframe.odometry is not None:
        variance = 1.0 / (1.0 / max(variance, 1e-12) + 1.0 / _WHEELS_RATIO**2)
    return float(np.sqrt(variance))


def _eye(visual_map: VisualMap, keyframe: Keyframe) -> _Eye:
    camera, features = visual_map.camera, keyframe.features
    rows = np.flatnonzero(keyframe.landmark_ids == NO_LANDMARK)
    flat = (features.uv_px[rows] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    T_cam_local = se3.inverse(keyframe.T_local_base @ camera.T_base_cam)
    return _Eye(
        keyframe=keyframe,
        rows=rows,
        T_cam_local=T_cam_local,
        rays=np.column_stack([flat, np.ones(len(rows))]),
        sigma_px=visual_map.sigma_px(features.levels[rows]),
        nearest_m=_nearest_m(visual_map, keyframe, T_cam_local),
    )


def _nearest_m(visual_map: VisualMap, keyframe: Keyframe, T_cam_local: Transform) -> float:
    """Return the least plausible depth [m] of a point in a keyframe, by its landmarks.

    A wrong match that seems to lie right in front of the camera is a large error: as a landmark it
    outweighs hundreds that are some metres away, and a pose that follows it does not contradict it.
    """
    known = keyframe.landmark_ids[keyframe.landmark_ids != NO_LANDMARK]
    if len(known) * _NEAREST_SHARE < 1.0:
        return _NEAREST_M
    ahead_m = se3.apply(T_cam_local, visual_map.landmarks.points_local[known])[:, 2]
    return max(_NEAREST_M, _NEARER_RATIO * float(np.quantile(ahead_m, _NEAREST_SHARE)))


def _match(visual_map: VisualMap, new: _Eye, other: _Eye) -> Matches:
    """Return pairs (row of new, row of other) with similar descriptors on epipolar lines."""
    T_other_new = other.T_cam_local @ se3.inverse(new.T_cam_local)
    essential = se3.hat(T_other_new[:3, 3]) @ T_other_new[:3, :3]
    lines = new.rays @ essential.T  # (N, 3), in the other's image at z = 1
    within = _LINE_SIGMAS * np.sqrt(2.0) * new.sigma_px / visual_map.camera.fx  # of about a level
    lines /= np.maximum(np.hypot(lines[:, 0], lines[:, 1]) * within, 1e-12)[:, None]
    levels, their_levels = new.levels, other.levels  # ascending: pairs of levels are blocks
    lines, rays = lines.astype(np.float32), other.rays.T.astype(np.float32)
    pairs = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for level in np.unique(levels):
        first, end = np.searchsorted(levels, [level, level + 1])
        near = [level - _LEVEL_TOLERANCE, level + _LEVEL_TOLERANCE + 1]
        low, high = np.searchsorted(their_levels, near)
        is_on_line = np.abs(lines[first:end] @ rays[:, low:high]) <= 1.0
        row, candidate = np.divmod(np.flatnonzero(is_on_line), max(high - low, 1))
        pairs.append((row + first, candidate + low))
    rows, candidates = (np.concatenate(each) for each in zip(*pairs, strict=True))
    descriptors = other.features.descriptors[other.rows]
    return match_pairs(
        rows, candidates, new.features.descriptors[new.rows], descriptors, ratio=_RATIO
    )


def _intersect(visual_map: VisualMap, new: _Eye, other: _Eye, matches: Matches) -> _Found:
    """Return the points that each best fit two pixels (midpoint, then Gauss-Newton)."""
    pairs = [
        (eye, _sightings(visual_map, eye, rows))
        for eye, rows in ((new, matches.landmark_rows), (other, matches.feature_rows))
    ]
    points = _midpoints(new, other, matches)
    for _ in range(_STEPS):
        information, slopes = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
        agrees = np.ones(len(points), bool)
        for eye, seen in pairs:
            points_cam = points @ eye.T_cam_local[:3, :3].T + eye.T_cam_local[:3, 3]
            found = errors(visual_map.camera, points_cam.T, seen)
            by_point = np.moveaxis(found.by_point, 2, 0) @ eye.T_cam_local[:3, :3]
            information += np.swapaxes(by_point, 1, 2) @ by_point
            slopes += np.einsum("nri,rn->ni", by_point, found.of)
            agrees &= found.pixels_agree() & (points_cam[:, 2] > eye.nearest_m)
        information += 1e-9 * np.eye(3)
        points = points - np.linalg.solve(information, slopes[:, :, None])[:, :, 0]
    distance_m = np.linalg.norm(points @ new.T_cam_local[:3, :3].T + new.T_cam_local[:3, 3], axis=1)
    doubt_m = np.asarray(np.linalg.eigvalsh(information)[:, 0] ** -0.5, np.float64)
    doubt_ratio = doubt_m / distance_m
    # A nearer corner without depth lies on an edge, or in a shadow, of the depth image.
    range_m = 0.0 if new.keyframe.is_monocular else visual_map.camera.depth_range_m[1]
    is_unmeasured = distance_m > range_m
    return _Found(
        points_local=points,
        information=information,
        doubt_ratio=doubt_ratio,
        is_sure=_are_sure(agrees & is_unmeasured, distance_m, doubt_m),
    )


def _are_sure(
    agrees: NDArray[np.bool_], distance_m: NDArray[np.float64], doubt_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which points (N,) are located well enough, whatever their own error is.

    The error of the inverse distance does not depend on the distance. It is compared with the
    inverse distance that is usual in the two images: compared with a point's own it would favour
    points that were measured too near, and the map's scale would shrink.
    """
    if not agrees.any():
        return agrees
    per_m = 1.0 / distance_m
    usual_per_m = np.median(per_m[agrees])
    is_located = doubt_m * per_m**2 < _MAX_DOUBT_RATIO * usual_per_m
    return np.asarray(agrees & is_located & (per_m > _FARTHEST_RATIO * usual_per_m))


def _midpoints(new: _Eye, other: _Eye, matches: Matches) -> NDArray[np.float64]:
    """Return the points (N, 3) in `local` halfway between two rays where they are closest."""
    T_local_new, T_local_other = se3.inverse(new.T_cam_local), se3.inverse(other.T_cam_local)
    a = new.rays[matches.landmark_rows] @ T_local_new[:3, :3].T
    b = other.rays[matches.feature_rows] @ T_local_other[:3, :3].T
    way = T_local_other[:3, 3] - T_local_new[:3, 3]
    along_a, along_b = closest(a, b, way)
    ends = T_local_new[:3, 3] + along_a[:, None] * a + T_local_other[:3, 3] + along_b[:, None] * b
    return np.asarray(0.5 * ends)


def _sightings(visual_map: VisualMap, eye: _Eye, rows: NDArray[np.int64]) -> Sightings:
    features, rows = eye.features, eye.rows[rows]
    return Sightings(
        uv_px=features.uv_px[rows],
        sigma_px=visual_map.sigma_px(features.levels[rows]),
        depth_m=features.depth_m[rows],
        inverse_depth_sigma_per_m=visual_map.inverse_depth_sigmas_per_m(features)[rows],
    )
