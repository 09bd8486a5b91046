"""Localization of the camera: by keyframes near the prediction, or verified where it is vague."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from ..surfaces.keyframe import SurfaceKeyframe
from ..surfaces.registration import (
    CameraPrior,
    Samples,
    SurfaceRegistration,
    compare,
    register,
    samples_of,
)
from ..surfaces.surface import Grid, Surface
from .keyframe_map import KeyframeMap

_TOGETHER = 3  # keyframes for one registration
_USEFUL_OVERLAP = 0.2
_ALIKE = 3  # candidate keyframes for relocalization
_GOOD_RATIO = 0.8  # share of matching points; below, another start is tried as well
_FAR = 100.0  # largest squared Mahalanobis distance to the prediction: ten sigma in one direction
# A pose that is searched in all of the map: experiments/depth.md, "Found again".
_REACH_M = 0.15  # deviation of the prediction up to which points lie near their own surfaces
_SURE_RATIO = 0.8  # smallest share of points that match
_SEEN_RATIO = 0.4  # smallest share of the image that the map shows
_REFUTED_RATIO = 0.03  # largest share of points that stand where the other view sees through
_SAME_M = 0.05  # from a surface; refuted points are farther in front of it
_APART = 0.15  # m, rad: two poses of one image are different places


class DepthLocalizer:
    """Registers images with the keyframes of a map."""

    def __init__(
        self, keyframes: KeyframeMap, *, matched_min_ratio: float, weak_ratio: float
    ) -> None:
        self._map = keyframes
        self._matched_min_ratio, self._weak_ratio = matched_min_ratio, weak_ratio

    def locate(
        self,
        samples: Samples,
        surface: Surface,
        prior: CameraPrior,
        T_local_cam_before: se3.Transform | None,
        *,
        after_gap: bool,
    ) -> SurfaceRegistration | None:
        """Return the camera's pose, None where it is not certain.

        After a gap, a vague prediction is near other surfaces than the image's own: then the pose
        must be verified, wherever the search for it began.
        """
        if after_gap and self._is_vague(samples, prior):
            return self._search(samples, surface, prior, near=True)
        found = self._near(samples, prior, T_local_cam_before)
        return found or self._search(samples, surface, prior, near=False)

    def _is_vague(self, samples: Samples, prior: CameraPrior) -> bool:
        """Tell whether points may be farther than `_REACH_M` from where the prediction has them.

        What the image does not measure is not compared with the map, and may be as vague.
        """
        covariance = np.asarray(np.linalg.inv(prior.information))
        return samples.localizability().reach_m(covariance, self._weak_ratio) > _REACH_M

    def _near(
        self, samples: Samples, prior: CameraPrior, T_local_cam_before: se3.Transform | None
    ) -> SurfaceRegistration | None:
        """Return the camera's pose near the prior; if the fit is poor, near the last pose.

        After a sudden stop or reversal, the last pose is a better start than the prediction.
        """
        found = self._register(samples, prior)
        is_good = found is not None and found.matched_ratio >= _GOOD_RATIO
        again = None
        if not is_good and T_local_cam_before is not None:
            again = self._register(samples, CameraPrior(T_local_cam_before, prior.information))
        both = [one for one in (found, again) if one is not None]
        best = max(both, key=lambda one: one.matched_ratio, default=None)
        return best if best and best.matched_ratio >= self._matched_min_ratio else None

    def _search(
        self, samples: Samples, surface: Surface, expected: CameraPrior, *, near: bool
    ) -> SurfaceRegistration | None:
        """Return the one verified pose by similar keyframes, None if there are more.

        `near`: or by the prediction, which then also tells what the image does not measure. It has
        to be consistent with the motion.
        """
        found = [self._by_similar(samples, index) for index in self._map.alike(surface, _ALIKE)]
        if near:
            found.insert(0, self._settled(samples, expected))
        sure = [
            one
            for one in found
            if one is not None
            and _is_expected(one, expected)
            and self._is_verified(one, samples, surface)
        ]
        best = max(sure, key=lambda one: one.matched_ratio, default=None)
        if best is None or any(_is_apart(best, one) for one in sure):
            return None
        return best

    def _by_similar(self, samples: Samples, index: int) -> SurfaceRegistration | None:
        """Return the pose from a keyframe's, None where the image does not measure all of it."""
        there = self._settled(samples, CameraPrior(self._map[index].T_local_cam, np.eye(6)))
        if there is None or there.localizability.ratios[0] < self._weak_ratio:
            return None
        return there

    def _settled(self, samples: Samples, start: CameraPrior) -> SurfaceRegistration | None:
        """Return the pose from a start that may be far off: other keyframes overlap with it."""
        found = self._register(samples, start)
        if found is None or found.matched_ratio < self._matched_min_ratio:
            return None
        return self._register(samples, CameraPrior(found.T_local_cam, start.information))

    def _is_verified(self, found: SurfaceRegistration, samples: Samples, surface: Surface) -> bool:
        """Tell whether the map shows the image's surfaces, and neither sees through the other's."""
        if found.matched_ratio < _SURE_RATIO or found.seen < _SEEN_RATIO * len(samples):
            return False
        grid = self._map.grid
        theirs, ours = np.zeros(2), np.zeros(2)  # points that match, and that are refuted
        for overlap in self._map.overlaps(samples, found.T_local_cam):
            keyframe = self._map[overlap.index]
            T_key_cam = keyframe.T_cam_local @ found.T_local_cam
            ours += _verdicts(samples, keyframe, T_key_cam, grid)
            known = samples_of(keyframe.surface(), grid)
            theirs += _verdicts(known, surface, se3.inverse(T_key_cam), grid)
        return all(refuted <= _REFUTED_RATIO * (same + refuted) for same, refuted in (ours, theirs))

    def _register(self, samples: Samples, prior: CameraPrior) -> SurfaceRegistration | None:
        overlaps = self._map.overlaps(samples, prior.T_local_cam)
        near = [o.index for o in overlaps[:_TOGETHER] if o.ratio > _USEFUL_OVERLAP]
        keyframes = [self._map[index] for index in near or [overlaps[0].index]]
        return register(samples, prior, keyframes, self._map.grid, weak_ratio=self._weak_ratio)


def _verdicts(
    samples: Samples, other: SurfaceKeyframe | Surface, T_other_cam: se3.Transform, grid: Grid
) -> NDArray[np.float64]:
    """Return how many points lie on the other's surfaces, and how many stand in front of them."""
    residuals, _, is_seen, is_same = compare(samples, other, T_other_cam, _SAME_M, grid)
    is_refuted = is_seen & (residuals < -_SAME_M)
    return np.array([is_same.sum(), is_refuted.sum()], np.float64)


def _is_expected(found: SurfaceRegistration, expected: CameraPrior) -> bool:
    """Tell whether a pose is consistent with the prediction."""
    off = se3.log(se3.inverse(expected.T_local_cam) @ found.T_local_cam)
    return bool(off @ expected.information @ off < _FAR)


def _is_apart(one: SurfaceRegistration, other: SurfaceRegistration) -> bool:
    off = se3.log(se3.inverse(one.T_local_cam) @ other.T_local_cam)
    return bool(np.linalg.norm(off[:3]) > _APART or np.linalg.norm(off[3:]) > _APART)
