"""Finds the camera in the map: near a predicted pose, or anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from .features import Features
from .matching import Matches, match_anywhere, match_near
from .pose_solver import Measurements, PoseEstimate, PoseSolver
from .residuals import Sightings
from .visual_map import VisualMap

_RADIUS_REFINED_PX = 10.0
_WIDER = 2.5  # second try of a guided search
_MIN_INLIER_RATIO = 0.4  # of the matches around a pose that is right
_MIN_FOUND_RATIO = 0.1  # of the landmarks that should show: chance finds 0.05, an image 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fix:
    """A pose and the landmarks that hold it."""

    estimate: PoseEstimate
    landmark_ids: NDArray[np.int64]  # (N,), pixels agree
    feature_rows: NDArray[np.int64]  # (N,)
    deep_rows: NDArray[np.int64]  # those of them whose depth agrees too
    expected_ids: NDArray[np.int64]  # landmarks that the image should show
    local_ids: NDArray[np.int64]  # the local map that they are of


class Localizer:
    """Matches features to the map and solves for the pose."""

    def __init__(
        self, visual_map: VisualMap, solver: PoseSolver, *, radius_px: float, min_inliers: int
    ) -> None:
        self._map, self._solver = visual_map, solver
        self._radius_px, self._min_inliers = radius_px, min_inliers

    def near(
        self, features: Features, T_predicted: Transform, landmark_ids: NDArray[np.int64]
    ) -> Fix | None:
        """Return the pose found by looking for landmarks where a predicted pose shows them."""
        for radius_px in (self._radius_px, _WIDER * self._radius_px):
            prediction = self._map.predict(T_predicted, landmark_ids)
            matches = match_near(
                prediction.uv_px,
                prediction.levels,
                self._map.landmarks.descriptors[prediction.ids],
                features,
                radius_px=radius_px,
            )
            fix = self._solve(features, prediction.ids, matches, T_predicted)
            if fix is not None:
                return fix
        return None

    def anywhere(self, features: Features, landmark_ids: NDArray[np.int64]) -> Fix | None:
        """Return the pose found by comparing all descriptors."""
        matches = match_anywhere(self._map.landmarks.descriptors[landmark_ids], features)
        return self._solve(features, landmark_ids, matches, se3.identity())

    def _solve(
        self,
        features: Features,
        landmark_ids: NDArray[np.int64],
        matches: Matches,
        T_local_base: Transform,
    ) -> Fix | None:
        """Return the pose that the matches agree on, confirmed by the landmarks around it."""
        if len(matches) < self._min_inliers:
            return None
        ids = landmark_ids[matches.landmark_rows]
        coarse = self._solver.search(
            self._measured(features, ids, matches.feature_rows, T_local_base)
        )
        if coarse is None or len(coarse.inlier_rows) < self._min_inliers:
            return None
        local_ids = self._map.around(ids[coarse.inlier_rows])
        return self._confirm(features, coarse.T_local_base, local_ids)

    def _confirm(
        self, features: Features, T_local_base: Transform, landmark_ids: NDArray[np.int64]
    ) -> Fix | None:
        """Return the final pose from all landmarks that a nearly right pose lets us find."""
        prediction = self._map.predict(T_local_base, landmark_ids)
        matches = match_near(
            prediction.uv_px,
            prediction.levels,
            self._map.landmarks.descriptors[prediction.ids],
            features,
            radius_px=_RADIUS_REFINED_PX,
        )
        if len(matches) < self._min_inliers:
            return None
        ids = prediction.ids[matches.landmark_rows]
        measured = self._measured(features, ids, matches.feature_rows, T_local_base)
        estimate = self._solver.refine(measured, T_local_base)
        if estimate is None:
            return None
        count, possible = int(estimate.inliers.sum()), min(len(prediction.ids), len(features))
        least = max(_MIN_INLIER_RATIO * len(matches), _MIN_FOUND_RATIO * possible)
        if count < max(self._min_inliers, least):
            return None
        return Fix(
            estimate=estimate,
            landmark_ids=ids[estimate.inliers],
            feature_rows=matches.feature_rows[estimate.inliers],
            deep_rows=matches.feature_rows[estimate.depth_inliers],
            expected_ids=prediction.ids,
            local_ids=landmark_ids,
        )

    def _measured(
        self,
        features: Features,
        ids: NDArray[np.int64],
        rows: NDArray[np.int64],
        T_local_base: Transform,
    ) -> Measurements:
        """Return what to solve for, seen from about T_local_base, with the landmarks' own doubt."""
        doubts = self._map.doubts(T_local_base, ids)
        return Measurements(
            points_local=self._map.landmarks.points_local[ids],
            seen=Sightings(
                uv_px=features.uv_px[rows],
                sigma_px=np.hypot(self._map.sigma_px(features.levels[rows]), doubts.across_px),
                depth_m=features.depth_m[rows],
                inverse_depth_sigma_per_m=np.hypot(
                    self._map.inverse_depth_sigmas_per_m(features)[rows], doubts.inverse_depth_per_m
                ),
            ),
        )
