"""Detect whether depth is registered to the colours, by comparing the motion that both show.

Surfaces give the depth camera's motion without the colours (see `pose_constraints`). The pixel of a
corner in another image then depends on the colour camera's focal length and position alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .alignment import Alignment, look_up
from .corners import SCALE
from .features import Features

_STARTS = (Alignment(), Alignment(focal_ratio=0.9, baseline_m=0.025))  # registered; a raw Kinect
_ASKED_AT = (6, 9, 14, 20)  # pairs of keyframes; not unregistered at any: registered
_CORNERS = 200  # of a pair
_MAX_HAMMING = 40
_STEPS = 10
_WIDTHS = np.array([0.004, 0.004])  # steps of the numerical derivatives
_LONGEST = np.array([0.03, 0.02])  # largest step of an iteration
_HUBER, _WORST = 2.0, 3.0  # [sigma] of a corner, [its root cost]
_MIN_CHANGE = 0.03  # of the focal length: 10 px at the edge of the image
_SAME = 0.02  # largest difference of two results that agree
_MIN_GAIN = 0.4  # least share by which the cost must fall


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """Two keyframes: corners that both show, and the depth camera's motion between them."""

    one_px: NDArray[np.float64]  # (N, 2), without distortion
    other_px: NDArray[np.float64]  # (N, 2)
    sigma_px: NDArray[np.float64]  # (N,)
    one_depth_m: NDArray[np.float32]  # (H, W)
    T_other_one: Transform  # of the depth camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shown:
    """Features and depth image of one keyframe."""

    features: Features
    depth_m: NDArray[np.float32]  # (H, W)


def pair_of(one: Shown, other: Shown, T_other_one: Transform) -> Pair:
    """Return the corners matched by descriptors alone, independent of any pose."""
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(one.features.descriptors, other.features.descriptors)
    alike = [(m.queryIdx, m.trainIdx) for m in matches if m.distance < _MAX_HAMMING]
    here, there = np.array(alike, np.int64).reshape(-1, 2).T
    return Pair(
        one_px=one.features.uv_px[here],
        other_px=other.features.uv_px[there],
        sigma_px=SCALE ** one.features.levels[here].astype(np.float64),
        one_depth_m=one.depth_m,
        T_other_one=T_other_one,
    )


class AlignmentSearch:
    """Collects pairs of keyframes until the alignment is decided."""

    def __init__(self, camera: Camera, *, is_over: bool) -> None:
        self._camera, self.is_over = camera, is_over
        self._pairs: list[Pair] = []
        self._guess = Alignment()  # the last result

    def add(self, pair: Pair) -> Alignment | None:
        """Add a pair; return the alignment once it shows that there are two cameras."""
        self._pairs.append(pair)
        count = len(self._pairs)
        if self.is_over or count not in _ASKED_AT:
            return None
        before, self._guess = self._guess, self._find()
        is_sure = abs(before.focal_ratio - self._guess.focal_ratio) < _SAME
        found = self._guess if is_sure and not self._guess.is_registered else None
        self.is_over = found is not None or count == _ASKED_AT[-1]
        if self.is_over:
            self._pairs.clear()
        return found

    def _find(self) -> Alignment:
        costs = _Costs(self._camera, self._pairs)
        ends = [_descend(costs, start) for start in _STARTS]
        best = min(ends, key=costs.total)
        is_other = abs(best.focal_ratio - 1.0) > _MIN_CHANGE
        gain = 1.0 - costs.total(best) / costs.total(Alignment())
        return best if is_other and gain > _MIN_GAIN else Alignment()


class _Costs:
    """Reprojection costs of the corners of all pairs for an alignment."""

    def __init__(self, camera: Camera, pairs: list[Pair]) -> None:
        chosen = [slice(None, None, 1 + len(pair.sigma_px) // _CORNERS) for pair in pairs]
        both = list(zip(pairs, chosen, strict=True))
        self._camera = camera
        self._one_px = np.concatenate([pair.one_px[rows] for pair, rows in both])
        self._other_px = np.concatenate([pair.other_px[rows] for pair, rows in both])
        self._sigma_px = np.concatenate([pair.sigma_px[rows] for pair, rows in both])
        counts = [len(pair.sigma_px[rows]) for pair, rows in both]
        self._images = np.repeat(np.arange(len(pairs)), counts)
        self._depths_m = np.stack([pair.one_depth_m for pair in pairs])
        self._T_other_one = np.stack([pair.T_other_one for pair in pairs])[self._images]

    def total(self, alignment: Alignment) -> float:
        """Return the mean cost of the corners with a depth."""
        return float(np.nanmean(self.roots(alignment) ** 2))

    def roots(self, alignment: Alignment) -> NDArray[np.float64]:
        """Return the root of each corner's cost (N,), NaN where depth is missing."""
        camera = self._camera
        color, right = alignment.color_camera(camera), alignment.T_depth_color[:3, 3]
        focal_px, centre_px = np.array([color.fx, color.fy]), np.array([color.cx, color.cy])
        where_px = alignment.find(camera, self._one_px, self._depths_m, self._images)
        z = look_up(self._depths_m, self._images, where_px)
        rays = np.column_stack([(self._one_px - centre_px) / focal_px, np.ones(len(z))])
        points_depth = rays * z[:, None] + right
        turned = np.einsum("nij,nj->ni", self._T_other_one[:, :3, :3], points_depth)
        points_color = turned + self._T_other_one[:, :3, 3] - right
        ahead = points_color[:, 2] > 0.1
        uv_px = points_color[:, :2] / np.where(ahead, points_color[:, 2], 1.0)[:, None]
        off_px = np.linalg.norm(uv_px * focal_px + centre_px - self._other_px, axis=1)
        # Pseudo-Huber, so that its root is smooth.
        soft = np.sqrt(1.0 + (off_px / self._sigma_px / _HUBER) ** 2) - 1.0
        roots = np.where(ahead, np.minimum(np.sqrt(2.0 * soft), _WORST), _WORST)
        return np.where(z > 0, roots, np.nan)


def _descend(costs: _Costs, start: Alignment) -> Alignment:
    """Return the alignment after Gauss-Newton iterations."""
    best = start
    for _ in range(_STEPS):
        roots = costs.roots(best)
        slopes = [costs.roots(_moved(best, step)) - roots for step in np.diag(_WIDTHS)]
        jacobian = np.stack(slopes) / _WIDTHS[:, None]
        fits = (roots < _WORST) & np.isfinite(jacobian).all(axis=0)
        jacobian = jacobian[:, fits]
        normal = jacobian @ jacobian.T + 1e-6 * np.eye(2)
        step = -np.linalg.solve(normal, jacobian @ roots[fits])
        moved = _moved(best, np.clip(step, -_LONGEST, _LONGEST))
        if not costs.total(moved) < costs.total(best):
            break
        best = moved
    return best


def _moved(alignment: Alignment, step: NDArray[np.float64]) -> Alignment:
    return Alignment(
        focal_ratio=alignment.focal_ratio + float(step[0]),
        baseline_m=alignment.baseline_m + float(step[1]),
    )
