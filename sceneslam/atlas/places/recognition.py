"""Place recognition: find the only pose of a plan in another that is not contradicted."""

from __future__ import annotations

import numpy as np

from sceneslam.atlas.places.floor_plan import FloorPlan
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.plan_search import PlanSearch, SearchWindow, is_apart
from sceneslam.atlas.places.registration import PlanRegistration, register

_SCORE_MIN = 0.3  # of the coarse search, whose cells are 3 x 3 of the plan's
_CANDIDATES = 24  # that are refined, at most,
_LIKELY_RATIO = (
    0.6  # with this share of the best score; a second match has 0.85, less a cell of 0.15 m
)
_POINTS_MIN = 40  # 2 m of wall: less is not distinctive
_RIVAL_RATIO = 0.15  # a second place is as likely unless the best explains so much more, or 2 m
_KNOWN_MIN = 0.6  # share of the walls in known space of the target
_NEAR_M, _NEAR_RAD = 0.3, 0.1  # a window this small needs no search: the refinement converges


class Recognizer:
    """Finds plans in one target."""

    def __init__(self, target: PlanField) -> None:
        self.field, self._search = target, PlanSearch(target)

    @classmethod
    def of(cls, plan: FloorPlan) -> Recognizer | None:
        """Return the recognizer in a plan, None if that shows no walls."""
        return cls(PlanField(plan)) if len(plan) else None

    def recognize(
        self, query: PlanField, window: SearchWindow | None, *, known_min: float = _KNOWN_MIN
    ) -> PlanRegistration | None:
        """Return T_target_query (3,), None if no pose or more than one fits.

        A pose is refuted if walls of one plan lie in free space of the other, or away from its
        walls. `window` None: search the whole target.
        """
        if len(query.plan) < _POINTS_MIN:
            return None
        found = self._candidates(query, window)
        verified = [
            one
            for one in found
            if one.is_verified and one.known_ratio >= known_min and one.weak_directions < 2
        ]
        if not verified:
            return None
        best = max(verified, key=_worth)
        lead = min(_RIVAL_RATIO * _worth(best), _POINTS_MIN / len(query.plan))
        rivals = [
            one
            for one in found
            if is_apart(one.T_target_query, best.T_target_query)
            and _worth(one) >= _worth(best) - lead
            and not one.is_refuted
        ]
        return None if rivals else best

    def locate(self, plan: FloorPlan) -> PlanRegistration | None:
        """Return where in all of the target a plan lies; None if walls leave a direction open."""
        match = self.recognize(PlanField(plan), None) if len(plan) else None
        return None if match is None or match.weak_directions else match

    def _candidates(self, query: PlanField, window: SearchWindow | None) -> list[PlanRegistration]:
        if window is not None and window.half_m <= _NEAR_M and window.half_rad <= _NEAR_RAD:
            return [register(query, self.field, window.around)]
        points = query.plan.points.astype(np.float64)
        peaks = self._search.find(points, window, score_min=_SCORE_MIN, most=_CANDIDATES)
        likely = [peak for peak in peaks if peak.score >= _LIKELY_RATIO * peaks[0].score]
        return [register(query, self.field, peak.T_target_query) for peak in likely]


def _worth(one: PlanRegistration) -> float:
    return one.inlier_ratio * one.known_ratio
