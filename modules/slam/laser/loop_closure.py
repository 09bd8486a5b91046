"""Loop closure: candidate submaps for a keyframe, its pose in them, and verification."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.planar import Planar, apply, between, compose, from_transform, turn

from .keyframes import ScanKeyframes
from .matcher import Match, Matcher
from .places import Places, ScanSubmap
from .pose_graph import ScanEdge
from .surface import SurfacePoints

_NEAR_M = 3.0  # a submap is visible within this distance of its keyframes
_DRIFT_M = 0.05  # half width of the search, per metre driven since
_DRIFT_RAD = 0.004
_WINDOW_M, _WINDOW_RAD = 0.15, 0.05  # half width at zero distance
_WINDOW_MAX_M, _WINDOW_MAX_RAD = 6.0, 0.6
_WIDE_M, _WIDE_RAD = 0.5, 0.2  # wider windows need the wide search and a second loop to confirm
_SUBMAPS_MAX = 2  # submaps tried per keyframe
_PAUSE = 4  # keyframes between two loops into the same submap
_SCORE_MIN = 0.6
_INLIER_MIN_RATIO = 0.65
_THROUGH_M, _THROUGH_MAX_RATIO = 0.3, 0.15  # points this far before the returns: doors, people
_BESIDE_RAD = 0.02  # angle within which a beam passes a point
_AGREE_M, _AGREE_RAD = 0.25, 0.05
_FLOOR = np.diag(np.array([0.02, 0.02, 0.005]) ** 2)  # m, m, rad: least covariance of a loop


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Witness:
    keyframe: int
    edge: ScanEdge


@dataclass(slots=True)
class ScanLoopCloser:
    """Loop edges for one keyframe after the other."""

    keyframes: ScanKeyframes
    places: Places
    matcher: Matcher
    _links: list[dict[int, float]] = field(default_factory=list)  # submap: {other: distance [m]}
    _tried: dict[int, int] = field(default_factory=dict)  # submap: keyframe of the last trial
    _witnesses: list[_Witness] = field(default_factory=list)

    def close(self, number: int) -> list[ScanEdge]:
        """Return the loop edges of a new keyframe, mostly none."""
        self._link(number)
        finished = self.keyframes.finished_submaps
        if finished == 0:
            return []
        far_m = self._drives(number)[:finished]
        accepted: list[ScanEdge] = []
        for submap in self._candidates(number, far_m):
            self._tried[submap] = number
            window_m = min(_WINDOW_M + _DRIFT_M * far_m[submap], _WINDOW_MAX_M)
            window_rad = min(_WINDOW_RAD + _DRIFT_RAD * far_m[submap], _WINDOW_MAX_RAD)
            edge = self._match(number, submap, window_m, window_rad)
            if edge is None:
                continue
            if window_m <= _WIDE_M and window_rad <= _WIDE_RAD:
                accepted.append(edge)
            else:
                accepted += self._confirm(number, edge)
        for edge in accepted:
            self._join(edge)
        return accepted

    def _candidates(self, number: int, far_m: NDArray[np.float64]) -> list[int]:
        poses = self.keyframes.poses
        size = self.keyframes.submap_keyframes
        away_m = np.hypot(*(poses[: len(far_m) * size, :2] - poses[number, :2]).T)
        nearest_m = away_m.reshape(len(far_m), size).min(axis=1)
        window_m = np.minimum(_WINDOW_M + _DRIFT_M * far_m, _WINDOW_MAX_M)
        open_to = np.array(
            [number - self._tried.get(s, -_PAUSE) >= _PAUSE for s in range(len(far_m))]
        )
        near = np.flatnonzero(open_to & (nearest_m < _NEAR_M + window_m))
        order = np.argsort((window_m + nearest_m)[near], kind="stable")
        return [int(submap) for submap in near[order[:_SUBMAPS_MAX]]]

    def _match(
        self, number: int, submap: int, window_m: float, window_rad: float
    ) -> ScanEdge | None:
        place = self.places.of(submap)
        surfaces = self.keyframes.surfaces_base(number)
        frames = self.keyframes.frames
        predicted = between(frames[place.anchor].T_local_base, frames[number].T_local_base)
        start = predicted
        if window_m > _WIDE_M or window_rad > _WIDE_RAD:
            found = place.search.find(
                surfaces.points,
                predicted,
                window_m=window_m,
                window_rad=window_rad,
                score_min=_SCORE_MIN,
            )
            if found is None or not found.is_unique:
                return None
            start = found.T_submap_base
        prior = np.diag(np.array([window_m, window_m, window_rad]) ** 2)
        match = self.matcher.refine(surfaces, place.field, start, prior)
        if not self._believes(match, place, surfaces):
            return None
        G = turn(-float(match.T_local_base[2]))
        return ScanEdge(
            first=place.anchor,
            second=number,
            T_first_second=match.T_local_base,
            covariance=G @ match.covariance @ G.T + _FLOOR,
            is_loop=True,
        )

    def _believes(self, match: Match, place: ScanSubmap, surfaces: SurfacePoints) -> bool:
        return (
            match.inlier_ratio >= _INLIER_MIN_RATIO
            and match.weak_directions == 0
            and self._seen_through_ratio(surfaces, place.field.points, match.T_local_base)
            <= _THROUGH_MAX_RATIO
        )

    def _confirm(self, number: int, edge: ScanEdge) -> list[ScanEdge]:
        """Return this edge and the earlier one that agrees with it, or nothing without one."""
        size = self.keyframes.submap_keyframes
        self._witnesses = [w for w in self._witnesses if number - w.keyframe <= size]
        poses = self.keyframes.poses
        for witness in self._witnesses:
            first, second = (
                compose(poses[e.first], e.T_first_second) for e in (witness.edge, edge)
            )
            off = between(between(poses[witness.keyframe], poses[number]), between(first, second))
            if np.hypot(off[0], off[1]) < _AGREE_M and abs(off[2]) < _AGREE_RAD:
                self._witnesses.remove(witness)
                return [witness.edge, edge]
        self._witnesses.append(_Witness(keyframe=number, edge=edge))
        return []

    def _link(self, number: int) -> None:
        """Add a keyframe to the graph of submaps."""
        size = self.keyframes.submap_keyframes
        submap = number // size
        if submap == len(self._links):
            self._links.append({})
        before = (number - 1) // size
        if number > 0 and before != submap:
            driven = self.keyframes.frames[number - size : number]
            metres = sum(frame.distance_m for frame in driven)
            self._connect(before, submap, metres)

    def _join(self, edge: ScanEdge) -> None:
        size = self.keyframes.submap_keyframes
        self._connect(edge.first // size, edge.second // size, 0.5)

    def _connect(self, one: int, other: int, metres: float) -> None:
        least = min(metres, self._links[one].get(other, metres))
        self._links[one][other] = self._links[other][one] = least

    def _drives(self, number: int) -> NDArray[np.float64]:
        """Return the length [m] of the shortest path of edges to each submap (Dijkstra)."""
        far_m = np.full(len(self._links), np.inf)
        far_m[number // self.keyframes.submap_keyframes] = 0.0
        waiting = np.ones(len(far_m), dtype=bool)
        for _ in range(len(far_m)):
            nearest = int(np.argmin(np.where(waiting, far_m, np.inf)))
            waiting[nearest] = False
            for other, metres in self._links[nearest].items():
                far_m[other] = min(far_m[other], far_m[nearest] + metres)
        return far_m

    def _seen_through_ratio(
        self, scan_base: SurfacePoints, points_submap: NDArray[np.float64], T_submap_base: Planar
    ) -> float:
        """Return the share of the submap's points in view that the scan's beams passed through.

        Points behind the scan's returns are not in view. As beams graze corners, a point counts
        only if the neighbouring beams passed it, too.
        """
        T_base_laser = from_transform(self.keyframes.reader.T_base_laser)
        T_laser_submap = between(compose(T_submap_base, T_base_laser), np.zeros(3))
        bearing, reach = _polar(apply(between(T_base_laser, np.zeros(3)), scan_base.points))
        order = np.argsort(bearing, kind="stable")
        bearing, reach = bearing[order], reach[order]
        angle, away = _polar(apply(T_laser_submap, points_submap))
        at = np.clip(np.searchsorted(bearing, angle), 1, len(bearing) - 2)
        beside = np.minimum(np.abs(bearing[at] - angle), np.abs(bearing[at - 1] - angle))
        in_view = beside < _BESIDE_RAD
        least = np.minimum(np.minimum(reach[at - 1], reach[at]), reach[at + 1])
        through = in_view & (away < least - _THROUGH_M)
        agrees = in_view & (np.abs(away - reach[at]) < _THROUGH_M)
        return float(through.sum() / max(through.sum() + agrees.sum(), 1))


def _polar(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = points.T
    return np.arctan2(y, x), np.hypot(x, y)
