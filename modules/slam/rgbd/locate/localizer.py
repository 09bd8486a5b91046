"""Localize the camera in the map: near a predicted pose, or anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from ..map.visual_map import VisualMap
from ..see.features import Features
from ..settings import RgbdSettings
from .matching import Matches, match_anywhere, match_near
from .pose_solver import MIN_INLIER_RATIO, Consensus, Measurements, PoseEstimate, PoseSolver, Prior
from .residuals import Sightings

_RADIUS_REFINED_PX = 10.0
_WIDER = 2.5  # factor on the search radius, in the last try of a guided search
_MIN_FOUND_RATIO = 0.1  # found, of the expected landmarks: 0.05 by chance, 0.2 in an image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisualFix:
    """A pose and the landmarks that support it."""

    estimate: PoseEstimate
    landmark_ids: NDArray[np.int64]  # (N,), pixels agree
    feature_rows: NDArray[np.int64]  # (N,)
    deep_rows: NDArray[np.int64]  # the feature rows whose depth agrees, too
    expected_ids: NDArray[np.int64]  # landmarks that the image should contain

    def found_ratio(self, features: Features) -> float:
        """Return the share of the expected landmarks that the image contains."""
        possible = min(len(self.expected_ids), len(features))
        return len(self.landmark_ids) / max(1, possible)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """Expected landmarks, and the features matched to them."""

    expected_ids: NDArray[np.int64]  # (M,)
    landmark_ids: NDArray[np.int64]  # (N,)
    feature_rows: NDArray[np.int64]  # (N,)
    measured: Measurements  # (N,)

    def __len__(self) -> int:
        return len(self.feature_rows)


class VisualLocalizer:
    """Matches features to the map and solves for the pose."""

    def __init__(
        self, visual_map: VisualMap, solver: PoseSolver, *, settings: RgbdSettings
    ) -> None:
        self._map, self._solver = visual_map, solver
        self._radius_px, self._min_inliers = settings.search_radius_px, settings.min_inliers

    def near(
        self, features: Features, T_predicted: Transform, held_ids: NDArray[np.int64]
    ) -> VisualFix | None:
        """Return the pose by matching landmarks (N,) near their pixels at T_predicted (4, 4).

        First the landmarks tracked last (`held_ids`), then all around them, then with a larger
        radius.
        """
        found = self._look(features, T_predicted, held_ids, self._radius_px)
        if len(found) >= self._min_inliers:
            fix = self._confirm(features, found, self._solver.approach(found.measured, T_predicted))
            if fix is not None:
                return fix
        local_ids = self._map.around(held_ids)
        for radius_px in (self._radius_px, _WIDER * self._radius_px):
            found = self._look(features, T_predicted, local_ids, radius_px)
            fix = self._search(features, found)
            if fix is not None:
                return fix
        return None

    def together(
        self, features: Features, held_ids: NDArray[np.int64], prior: Prior
    ) -> VisualFix | None:
        """Return the pose by the image and a prior, where the image shows the map there.

        The landmarks are those around `held_ids` (N,).
        """
        local_ids = self._map.around(held_ids)
        found = self._look(features, prior.T_local_base, local_ids, self._radius_px)
        there = Consensus(T_local_base=prior.T_local_base, inlier_rows=np.arange(len(found)))
        return self._confirm(features, found, there, prior)

    def beside(self, features: Features, fix: VisualFix) -> VisualFix | None:
        """Return the pose found by matching again from a pose of the same image."""
        found = self._look(
            features, fix.estimate.T_local_base, fix.expected_ids, _RADIUS_REFINED_PX
        )
        return self._confirm(
            features, found, self._solver.approach(found.measured, fix.estimate.T_local_base)
        )

    def around(self, features: Features, held_ids: NDArray[np.int64]) -> VisualFix | None:
        """Return the pose by descriptors only, among all landmarks around `held_ids` (N,)."""
        return self.anywhere(features, self._map.around(held_ids))

    def anywhere(self, features: Features, landmark_ids: NDArray[np.int64]) -> VisualFix | None:
        """Return the pose by descriptors only, among `landmark_ids` (N,)."""
        matches = match_anywhere(
            self._map.landmarks.descriptors.take(landmark_ids, axis=0), features
        )
        return self._search(features, self._found(features, landmark_ids, matches, se3.identity()))

    def _search(self, features: Features, found: _Found) -> VisualFix | None:
        """Return the pose that most of the pairs agree on, confirmed by the landmarks around it."""
        if len(found) < self._min_inliers:
            return None
        return self._confirm(features, found, self._solver.search(found.measured))

    def _confirm(
        self,
        features: Features,
        rough: _Found,
        consensus: Consensus | None,
        prior: Prior | None = None,
    ) -> VisualFix | None:
        """Return the final pose, from all landmarks that are found with a nearly correct pose."""
        if consensus is None or len(consensus.inlier_rows) < self._min_inliers:
            return None
        T_local_base = consensus.T_local_base
        local_ids = self._map.around(rough.landmark_ids[consensus.inlier_rows])
        found = self._look(features, T_local_base, local_ids, _RADIUS_REFINED_PX)
        if len(found) < self._min_inliers:
            return None
        estimate = self._solver.refine(found.measured, T_local_base, prior)
        if estimate is None:
            return None
        count, possible = int(estimate.inliers.sum()), min(len(found.expected_ids), len(features))
        least = max(MIN_INLIER_RATIO * len(found), _MIN_FOUND_RATIO * possible)
        if count < max(self._min_inliers, least):
            return None
        return VisualFix(
            estimate=estimate,
            landmark_ids=found.landmark_ids[estimate.inliers],
            feature_rows=found.feature_rows[estimate.inliers],
            deep_rows=found.feature_rows[estimate.depth_inliers],
            expected_ids=found.expected_ids,
        )

    def _look(
        self,
        features: Features,
        T_local_base: Transform,
        landmark_ids: NDArray[np.int64],
        radius_px: float,
    ) -> _Found:
        """Return the landmarks found within `radius_px` of their pixels at a pose."""
        prediction = self._map.predict(T_local_base, landmark_ids)
        matches = match_near(prediction, features, radius_px=radius_px)
        return self._found(features, prediction.ids, matches, T_local_base)

    def _found(
        self,
        features: Features,
        expected_ids: NDArray[np.int64],
        matches: Matches,
        T_local_base: Transform,
    ) -> _Found:
        """Return the matches, with the landmarks' own covariance as seen from T_local_base."""
        ids, rows = expected_ids[matches.landmark_rows], matches.feature_rows
        doubts = self._map.doubts(T_local_base, ids)
        inverse_depth_sigmas = self._map.inverse_depth_sigmas_per_m(features)[rows]
        seen = Sightings(
            uv_px=features.uv_px[rows],
            sigma_px=np.hypot(self._map.sigma_px(features.levels[rows]), doubts.across_px),
            depth_m=features.depth_m[rows],
            inverse_depth_sigma_per_m=np.hypot(inverse_depth_sigmas, doubts.inverse_depth_per_m),
        )
        landmarks = self._map.landmarks
        return _Found(
            expected_ids=expected_ids,
            landmark_ids=ids,
            feature_rows=rows,
            measured=Measurements(
                points_local=landmarks.points_local.take(ids, axis=0),
                seen=seen,
                images=landmarks.found.take(ids),
            ),
        )
