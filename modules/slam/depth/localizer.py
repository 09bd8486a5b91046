"""Localization of the camera: by keyframes near the prediction, else by similar keyframes."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3

from ..surfaces.registration import CameraPrior, Samples, SurfaceRegistration, register
from ..surfaces.surface import Surface
from .keyframe_map import KeyframeMap

_TOGETHER = 3  # keyframes for one registration
_USEFUL_OVERLAP = 0.2
_ALIKE = 3  # candidate keyframes for relocalization
_GOOD_RATIO = 0.8  # share of matching points; below, another start is tried as well
_SURE_RATIO = 0.6  # share of matching points for relocalization
_FAR = 100.0  # largest squared Mahalanobis distance to the prediction: ten sigma in one direction


class DepthLocalizer:
    """Registers images with the keyframes of a map."""

    def __init__(
        self, keyframes: KeyframeMap, *, matched_min_ratio: float, weak_ratio: float
    ) -> None:
        self._map = keyframes
        self._matched_min_ratio, self._weak_ratio = matched_min_ratio, weak_ratio

    def near(
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

    def alike(
        self, samples: Samples, surface: Surface, expected: CameraPrior
    ) -> SurfaceRegistration | None:
        """Return the camera's pose by a similar keyframe, if it is consistent with the motion."""
        for index in self._map.alike(surface, _ALIKE):
            there = self._register(samples, CameraPrior(self._map[index].T_local_cam, np.eye(6)))
            if there is None or there.localizability.ratios[0] < self._weak_ratio:
                continue
            off = se3.log(se3.inverse(expected.T_local_cam) @ there.T_local_cam)
            if (
                there.matched_ratio >= _SURE_RATIO
                and there.seen > _SURE_RATIO * len(samples)
                and off @ expected.information @ off < _FAR
            ):
                return there
        return None

    def _register(self, samples: Samples, prior: CameraPrior) -> SurfaceRegistration | None:
        overlaps = self._map.overlaps(samples, prior.T_local_cam)
        near = [o.index for o in overlaps[:_TOGETHER] if o.ratio > _USEFUL_OVERLAP]
        keyframes = [self._map[index] for index in near or [overlaps[0].index]]
        return register(samples, prior, keyframes, self._map.grid, weak_ratio=self._weak_ratio)
