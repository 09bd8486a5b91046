"""Localize a run in a loaded map, and keep checking the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from sceneslam.atlas.places.floor_plan import FloorPlan, draw
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.plan_search import SearchWindow
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.places.registration import PlanRegistration, register
from sceneslam.atlas.uncertainty import WHEELS
from sceneslam.scans.key_scan import KeyScan
from sceneslam.types import planar
from sceneslam.types.planar import Planar

_SPAN_M, _SPAN_SCANS = 6.0, 60  # length of path, and scans, that are compared with the map
_PERIOD_S, _DOUBLINGS = 0.5, 4  # time between two searches; it doubles, up to 8 s
_PATIENCE = 8  # after this many failed searches: each takes 0.1 s or more
_FIX_M, _FIX_S = 0.5, 1.0  # distance and time between comparisons once located
_AGREE_M, _AGREE_RAD = 0.1, 0.05  # two consecutive searches that agree within this are accepted
_REACH_M, _REACH_RAD, _SIGMAS = 0.15, 0.05, 3.0  # search window of a fix around the prediction
_DOUBTS = 3  # consecutive comparisons that contradict the map: the place was wrong
_KNOWN_MIN = 0.6


class LocalizationEvent(Enum):
    """Result of a comparison with the map."""

    NOTHING = "nothing"
    FOUND = "relocalized"
    FIXED = "fixed"  # located before, and confirmed
    WITHDRAWN = "relocalization_withdrawn"  # located before, and contradicted since


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedScan:
    """A scan with its pose in the frame of the run."""

    scan: KeyScan
    T_run_base: Planar


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fix:
    """The robot's pose in the map by its newest scans."""

    stamp_ns: int
    match: PlanRegistration  # of `base` at the stamp, in the map

    @property
    def T_map_base(self) -> Planar:
        """Return T_map_base (3,): x, y [m], yaw [rad]."""
        return self.match.T_target_query


class MapLocalizer:
    """Compares the last metres of a run with a map."""

    def __init__(self, plan: FloorPlan) -> None:
        self.T_map_run: Planar | None = None  # None until the run was located
        self.fixes: list[Fix] = []
        self._map = Recognizer(PlanField(plan))
        self._next_ns = 0
        self._fixed_at: PlacedScan | None = None
        self._guess: Planar | None = None  # T_map_run of the last search
        self._vain = self._doubts = 0

    def is_due(self, placed: PlacedScan) -> bool:
        """Tell whether it is time to compare at the newest scan."""
        if placed.scan.stamp_ns < self._next_ns:
            return False
        if self.T_map_run is None or self._fixed_at is None:
            return True
        away = planar.between(self._fixed_at.T_run_base, placed.T_run_base)
        return bool(np.hypot(away[0], away[1]) >= _FIX_M or abs(away[2]) >= 1.0)

    def compare(self, latest: Sequence[PlacedScan]) -> LocalizationEvent:
        """Compare the latest scans, oldest first, with the map."""
        newest, query = latest[-1], _query(latest)
        if not len(query):
            return LocalizationEvent.NOTHING
        field = PlanField(query)
        if self.T_map_run is not None:
            return self._check(newest, field)
        match = self._map.recognize(field, None)
        if match is None or match.weak_directions:
            self._guess, self._vain = None, self._vain + 1
            self._wait(newest, _PERIOD_S * 2.0 ** min(self._vain // _PATIENCE, _DOUBLINGS))
            return LocalizationEvent.NOTHING
        self._wait(newest, _PERIOD_S)
        T_map_run = _run_in_map(match, newest)
        before, self._guess = self._guess, T_map_run
        if before is None or not _agree(before, T_map_run, newest.T_run_base):
            return LocalizationEvent.NOTHING
        self._take(newest, match)
        return LocalizationEvent.FOUND

    def _check(self, newest: PlacedScan, query: PlanField) -> LocalizationEvent:
        """Compare near the predicted pose; repeated contradictions withdraw the localization."""
        assert self.T_map_run is not None and self._fixed_at is not None
        self._wait(newest, _FIX_S)
        expected = planar.compose(self.T_map_run, newest.T_run_base)
        away = planar.between(self._fixed_at.T_run_base, newest.T_run_base)
        moved_m, turned_rad = float(np.hypot(away[0], away[1])), abs(float(away[2]))
        turn = WHEELS.rad_per_m * moved_m + WHEELS.rad_per_rad * turned_rad
        window = SearchWindow(
            around=expected,
            half_m=_REACH_M + _SIGMAS * WHEELS.per_m * moved_m,
            half_rad=_REACH_RAD + _SIGMAS * turn,
        )
        match = self._map.recognize(query, window)
        if match is not None and _is_within(match, window):
            self._take(newest, match)
            return LocalizationEvent.FIXED
        there = register(query, self._map.field, expected)
        is_contradicted = there.known_ratio >= _KNOWN_MIN and not there.is_verified
        self._doubts = self._doubts + 1 if is_contradicted else 0
        if self._doubts < _DOUBTS:
            return LocalizationEvent.NOTHING
        self.T_map_run, self._guess, self._fixed_at = None, None, None
        self._doubts, self._vain, self.fixes = 0, 0, []
        return LocalizationEvent.WITHDRAWN

    def _take(self, newest: PlacedScan, match: PlanRegistration) -> None:
        self.T_map_run, self._fixed_at = _run_in_map(match, newest), newest
        self.fixes.append(Fix(stamp_ns=newest.scan.stamp_ns, match=match))
        self._doubts = self._vain = 0
        self._wait(newest, _FIX_S)

    def _wait(self, newest: PlacedScan, period_s: float) -> None:
        self._next_ns = newest.scan.stamp_ns + round(period_s * 1e9)


def _query(latest: Sequence[PlacedScan]) -> FloorPlan:
    """Return the plan of the last metres in the frame of base at the newest scan."""
    newest, length_m = latest[-1], 0.0
    scans: list[tuple[Planar, KeyScan]] = []
    after = newest
    for placed in reversed(latest[-_SPAN_SCANS:]):
        step = planar.between(placed.T_run_base, after.T_run_base)
        length_m += float(np.hypot(step[0], step[1]))
        if length_m > _SPAN_M:
            break
        scans.append((planar.between(newest.T_run_base, placed.T_run_base), placed.scan))
        after = placed
    return draw(scans)


def _run_in_map(match: PlanRegistration, newest: PlacedScan) -> Planar:
    T_base_run = planar.between(newest.T_run_base, np.zeros(3))
    return planar.compose(match.T_target_query, T_base_run)


def _agree(first: Planar, second: Planar, T_run_base: Planar) -> bool:
    """Tell whether two estimates of T_map_run put the robot in the same place."""
    off = planar.between(planar.compose(first, T_run_base), planar.compose(second, T_run_base))
    return bool(np.hypot(off[0], off[1]) <= _AGREE_M and abs(off[2]) <= _AGREE_RAD)


def _is_within(match: PlanRegistration, window: SearchWindow) -> bool:
    off = planar.between(window.around, match.T_target_query)
    return bool(np.hypot(off[0], off[1]) <= window.half_m and abs(off[2]) <= window.half_rad)
