"""Find the robot again in the latest submaps, where the prediction does not tell where it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Planar

from .field import LikelihoodField
from .free_space import FreeSpace
from .matcher import Match, Matcher
from .prior import MotionPrior, difference
from .surface import ScanSurfaceReader, SurfacePoints
from .wide_search import Found, WideSearch

_WINDOW_M, _WINDOW_RAD = 3.0, 0.8
_ALIKE_RATIO = 0.85  # a second pose with this share of the best score makes it ambiguous
# Anywhere: experiments/laser.md, "After seconds without scans".
_LIKELY_RATIO = 0.7  # of the best score: such poses are compared with it
_WIDEST_M = 5.0  # farther away, the latest submaps show little
_SIGMAS = 2.0  # deviations of a pose in its window
_APART_M, _APART_RAD = 0.3, 0.1  # two poses of one scan are different places
_LEAD_RATIO, _LEAD = 0.1, 40.0  # share of the beams, or nats, by which the best place must lead
_MATCHED_RATIO = 0.6  # least share of the beams near the map
# Largest shares of what stands where the other saw through: people stand before walls.
_OURS_RATIO, _THEIRS_RATIO = 0.1, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanRelocalizer:
    """Searches the field of the latest submaps for a scan."""

    matcher: Matcher
    reader: ScanSurfaceReader

    def near(
        self, surfaces: SurfacePoints, field: LikelihoodField, predicted: Planar, turned_rad: float
    ) -> Match | None:
        """Return the match around a prediction (3,), None if more than one pose fits.

        `turned_rad`: how far it may have turned.
        """
        window_rad = float(np.clip(2.0 * turned_rad, _WINDOW_RAD, np.pi))
        found = _search(surfaces, field, predicted, (_WINDOW_M, window_rad), _ALIKE_RATIO)
        if not found or any(one.score >= _ALIKE_RATIO * found[0].score for one in found[1:]):
            return None
        spread = np.array([_WINDOW_M, _WINDOW_M, _WINDOW_RAD])
        prior = MotionPrior.of(found[0].T_submap_base, np.diag(spread**2))
        return self.matcher.refine(surfaces, field, found[0].T_submap_base, prior)

    def anywhere(
        self,
        scan: LaserScan,
        surfaces: SurfacePoints,
        field: LikelihoodField,
        predicted: Planar,
        reach: Planar,
        match: Match,
    ) -> Match | None:
        """Return the match within reach (2,) [m, rad] of a prediction (3,), None if not certain.

        No other pose may match nearly as many beams, and neither scan nor map may see through the
        other. `match` is what is near the prediction.
        """
        window_m = float(np.clip(reach[0], _WINDOW_M, _WIDEST_M))
        window_rad = float(np.clip(reach[1], _WINDOW_RAD, np.pi))
        found = _search(surfaces, field, predicted, (window_m, window_rad), _LIKELY_RATIO)
        deviation = np.array([window_m, window_m, window_rad]) / _SIGMAS
        prior = MotionPrior.of(predicted, np.diag(deviation**2))
        starts = [match.T_local_base, *(one.T_submap_base for one in found)]
        matches = [self.matcher.refine(surfaces, field, start, prior) for start in starts]
        best = max(matches, key=lambda one: one.inlier_ratio)
        if best.inlier_ratio < _MATCHED_RATIO or any(_is_rival(one, best) for one in matches):
            return None
        return None if self._is_refuted(best.T_local_base, scan, surfaces, field) else best

    def _is_refuted(
        self, pose: Planar, scan: LaserScan, surfaces: SurfacePoints, field: LikelihoodField
    ) -> bool:
        """Tell whether scan or map has surfaces where the other saw through."""
        there = surfaces.moved(pose)
        seen = FreeSpace([scan], [pose], self.reader.T_base_laser, self.reader.range_max_m)
        view = LikelihoodField(there, field.resolution_m, seen)
        ours, theirs = field.refuted_ratio(there.points), view.refuted_ratio(field.points)
        return ours > _OURS_RATIO or theirs > _THEIRS_RATIO


def _search(
    surfaces: SurfacePoints,
    field: LikelihoodField,
    predicted: Planar,
    window: tuple[float, float],
    alike_ratio: float,
) -> list[Found]:
    return WideSearch(field).find(
        surfaces.points,
        predicted,
        window_m=window[0],
        window_rad=window[1],
        alike_ratio=alike_ratio,
    )


def _is_rival(match: Match, best: Match) -> bool:
    """Tell whether a match is another pose than the best, and fits nearly as well."""
    off = difference(match.T_local_base, best.T_local_base)
    is_other = np.hypot(*off[:2]) > _APART_M or abs(off[2]) > _APART_RAD
    is_near = match.inlier_ratio >= best.inlier_ratio - _LEAD_RATIO
    return bool(is_other) and is_near and match.cost < best.cost + _LEAD
