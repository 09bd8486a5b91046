"""Localize a run in a loaded map, and keep checking the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import FloorPlan, draw
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.plan_search import SearchWindow
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.places.registration import PlanRegistration, register
from sceneslam.atlas.submaps.graph import on_floor
from sceneslam.atlas.submaps.own_loops import Path
from sceneslam.atlas.uncertainty import of_wheels
from sceneslam.scans.key_scan import KeyScan
from sceneslam.types import planar, se3
from sceneslam.types.planar import Planar
from sceneslam.types.rig import Wheels
from sceneslam.types.se3 import Transform
from sceneslam.views.placed_views import Sighting
from sceneslam.views.view import LandmarkView
from sceneslam.views.view_finder import ViewFinder

_SPAN_M, _SPAN_SCANS = 6.0, 60  # length of path, and scans, that are compared with the map
_PERIOD_S, _DOUBLINGS = 0.5, 4  # time between two searches; it doubles, up to 8 s
_PATIENCE = 8  # after this many failed searches: each takes 0.1 s or more
_AGAIN_NS = 200_000_000  # between two searches by views; each takes 20 ms in a map of 50 views
_FIX_M, _FIX_RAD = 0.5, 0.3  # distance or turn between two comparisons once located ...
_FIX_NS = 10**9  # ... and time
_AGREE_M, _AGREE_RAD = 0.1, 0.05  # two consecutive searches that agree within this are accepted
_REACH_M, _REACH_RAD, _SIGMAS = 0.15, 0.05, 3.0  # search window of a fix around the prediction
_APART_M = 1.0  # between places that look alike, at least: in a window no larger, less is enough
_OPEN_M = 1.0  # standard deviation of a position that is not measured
_DOUBTS = 3  # consecutive comparisons that contradict the map: the place was wrong
_KNOWN_MIN = 0.6


_Expected = tuple[Transform, SearchWindow]  # T_map_base (4, 4), and how far off it may be


class LocalizationEvent(Enum):
    """Result of a comparison with the map."""

    NOTHING = "nothing"
    FOUND = "relocalized"
    FIXED = "fixed"  # located before, and confirmed
    WITHDRAWN = "relocalization_withdrawn"  # located before, and contradicted since


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """What the sensors saw from a pose of the run."""

    stamp_ns: int
    T_run_base: Transform
    scan: KeyScan | None = None
    view: LandmarkView | None = None
    is_level: bool = True  # base stands as on a floor, so that walls are where a plan has them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fix:
    """The robot's pose in the map by its newest looks."""

    stamp_ns: int
    T_map_base: Transform
    T_run_base: Transform  # as it was known then, or is by now
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order, base frame
    is_by_view: bool = False
    travelled: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros(2)
    )  # until then: m, rad
    held: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros(2)
    )  # the same, until the position was measured last in all directions
    piece_ns: int = 0  # here its piece of the run begins

    @property
    def T_map_run(self) -> Transform:
        """Return T_map_run (4, 4) by this pose."""
        return self.T_map_base @ se3.inverse(self.T_run_base)

    @property
    def deviation_m(self) -> float:
        """Return the standard deviation of the position on the floor, where it is largest."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[-1]))

    @property
    def is_open(self) -> bool:
        """Tell whether walls leave a direction open, as along a corridor."""
        return self.deviation_m > _OPEN_M


class _Piece:
    """A part of the run: nothing measured the motion to its first pose."""

    def __init__(self, begun_ns: int) -> None:
        self.begun_ns = begun_ns
        self.fixes: list[Fix] = []  # also those of a place that was withdrawn
        self.T_map_run: Transform | None = None  # None until it was located, or where withdrawn


class MapLocalizer:
    """Compares the last metres of a run with a map: its walls, and what a camera sees in it."""

    def __init__(
        self,
        plan: FloorPlan,
        views: ViewFinder | None = None,
        *,
        standing: Callable[[Transform], Transform] = np.asarray,
        wheels: Wheels | None = None,
    ) -> None:
        """Take the map's walls, and its views if the run has a camera.

        `standing` gives a pose (4, 4) the height and tilt of a robot that stands there in the map;
        without it they stay as they are. A run drifts as its `wheels`, None: the usual ones.
        """
        self._drift = of_wheels(wheels or Wheels())
        self._pieces = [_Piece(0)]  # the last one goes on
        self._walls = Recognizer.of(plan)
        self._views, self._standing = views, standing
        self._next_walls_ns = self._next_view_ns = 0
        self._seen: Look | None = None  # that was compared last
        self._travelled = np.zeros(2)  # until then: m, rad
        self._guess: Fix | None = None  # of the last search that found a place
        self._vain = self._doubts = 0

    def is_due(self, newest: Look) -> bool:
        """Tell whether it is time to compare the walls at the newest look."""
        return self._walls is not None and self._is_time(newest, self._next_walls_ns)

    def wants_view(self, newest: Look) -> bool:
        """Tell whether it is time to compare a view at the newest look."""
        return self._views is not None and self._is_time(newest, self._next_view_ns)

    @property
    def T_map_run(self) -> Transform | None:
        """Return T_map_run (4, 4) of the last piece that was located, None before the first."""
        return next(
            (one.T_map_run for one in self._pieces[::-1] if one.T_map_run is not None), None
        )

    @property
    def is_located(self) -> bool:
        """Tell whether the present piece is."""
        return self._piece.T_map_run is not None

    @property
    def pieces_ns(self) -> list[int]:
        """Return the stamp with which each piece of the run begins."""
        return [one.begun_ns for one in self._pieces]

    @property
    def piece_ns(self) -> int:
        """Return the stamp with which the present piece of the run begins, 0 for the first."""
        return self._piece.begun_ns

    @property
    def fixes(self) -> list[Fix]:
        """Return where the run was located, without places that were contradicted since."""
        return [fix for one in self._pieces if one.T_map_run is not None for fix in one.fixes]

    @property
    def _piece(self) -> _Piece:
        return self._pieces[-1]

    def restart(self, stamp_ns: int) -> None:
        """Search everywhere again: nothing measured the motion to the pose at a stamp."""
        self._pieces.append(_Piece(stamp_ns))
        self._guess = self._seen = None
        self._vain = self._doubts = self._next_walls_ns = self._next_view_ns = 0

    def compare(self, latest: Sequence[Look]) -> LocalizationEvent:
        """Compare the latest looks, oldest first, with the map."""
        newest = latest[-1]
        self._drive(latest)
        piece = self._piece
        if piece.T_map_run is not None:
            return self._check(latest, piece.T_map_run @ newest.T_run_base)
        fix = self._by_view(newest, None)
        if fix is not None and self._with_walls(fix, latest) is None:
            fix = None
        if fix is None and self._compares_walls(newest):
            fix = self._by_walls(latest)
        if fix is None:
            return LocalizationEvent.NOTHING
        before, self._guess = self._guess, fix
        if before is None or not _agree(before, fix):
            return LocalizationEvent.NOTHING
        fix = self._with_walls(_mean(fix, before), latest)
        if fix is None:
            return LocalizationEvent.NOTHING
        if piece.fixes:  # it was located before: there, and it drifted, or somewhere else
            last = piece.fixes[-1]
            T_expected = last.T_map_run @ newest.T_run_base
            if not _is_within(fix, self._window(T_expected, last.held)):
                piece.fixes = []
        self._take(fix)
        return LocalizationEvent.FOUND

    def rewind(self, stamp_ns: int, path: Path) -> None:
        """Forget what was found by poses that `path` replaced from a stamp on.

        The first fix of a piece stays: it was located.
        """
        self._guess, self._doubts = None, 0
        kept = [one for one in self._pieces[1:] if one.begun_ns < stamp_ns]
        self._pieces = [*self._pieces[:1], *kept]
        piece = self._piece
        piece.fixes = [fix for fix in piece.fixes if fix.stamp_ns < stamp_ns] or piece.fixes[:1]
        fix = piece.fixes[-1] if piece.fixes else None
        T_run_base = None if fix is None else path(fix.stamp_ns)
        if fix is not None and T_run_base is not None:
            piece.fixes[-1] = fix = replace(fix, T_run_base=T_run_base)
            self._seen = Look(stamp_ns=fix.stamp_ns, T_run_base=T_run_base)
            self._travelled = fix.travelled
            if piece.T_map_run is not None:
                piece.T_map_run = fix.T_map_run

    def _is_time(self, newest: Look, next_ns: int) -> bool:
        """Tell whether the time has come, and a located robot has moved since its last fix."""
        if newest.stamp_ns < next_ns or not self.is_located:
            return newest.stamp_ns >= next_ns
        away = se3.inverse(self._piece.fixes[-1].T_run_base) @ newest.T_run_base
        is_far = np.linalg.norm(away[:3, 3]) >= _FIX_M
        return bool(is_far or se3.rotation_angle_rad(away) >= _FIX_RAD)

    def _compares_walls(self, newest: Look) -> bool:
        """Tell whether walls are compared; a look with a view may come before it is time."""
        if newest.scan is None or self._walls is None:
            return False
        return newest.view is None or self.is_due(newest)

    def _by_view(self, newest: Look, expected: _Expected | None) -> Fix | None:
        """Return the pose by what the camera sees: where it is expected, or else anywhere."""
        views, view = self._views, newest.view
        if views is None or view is None:
            return None
        self._next_view_ns = newest.stamp_ns + (_AGAIN_NS if expected is None else _FIX_NS)
        T_base_cam = views.camera.T_base_cam
        if expected is not None:
            T_map_cam, window = expected[0] @ T_base_cam, expected[1]
            half_m, half_rad = window.half_m, window.half_rad
            if half_m <= _APART_M:
                seen = views.find(view, T_map_cam, half_m=half_m, half_rad=half_rad)
            else:
                seen = views.recognize(view, T_map_cam)
            fix = _fix_of(seen, newest, T_base_cam)
            if fix is not None and _is_within(fix, window):
                return fix
        return _fix_of(views.recognize(view), newest, T_base_cam)

    def _by_walls(self, latest: Sequence[Look]) -> Fix | None:
        """Return the pose by the walls around the last metres, searched in all of the map."""
        assert self._walls is not None
        newest = latest[-1]
        match = self._walls.locate(_query(latest))
        self._vain = 0 if match is not None else self._vain + 1
        period_s = _PERIOD_S * 2.0 ** min(self._vain // _PATIENCE, _DOUBLINGS)
        self._next_walls_ns = newest.stamp_ns + round(period_s * 1e9)
        if match is None:
            if self._guess is not None and not self._guess.is_by_view:
                self._guess = None  # two searches by walls have to agree in a row
            return None
        return self._fix(newest, newest.T_run_base, match)

    def _with_walls(self, fix: Fix, latest: Sequence[Look]) -> Fix | None:
        """Return a place by landmarks as the walls there tell it, None where they contradict it."""
        if not (fix.is_by_view and latest[-1].is_level) or self._walls is None:
            return fix
        window = self._window(fix.T_map_base, self._travelled)
        by_walls, are_refuted = self._near_walls(latest, fix.T_map_base, window)
        return None if are_refuted else _joint(by_walls, fix)

    def _check(self, latest: Sequence[Look], T_map_base: Transform) -> LocalizationEvent:
        """Compare near the predicted pose; repeated contradictions withdraw the localization."""
        newest = latest[-1]
        window = self._window(T_map_base, self._piece.fixes[-1].travelled)
        wide = self._window(T_map_base, self._piece.fixes[-1].held)
        seen = self._by_view(newest, (T_map_base, wide))
        is_contradicted = seen is not None and not _is_within(seen, wide)
        fix = None if is_contradicted else seen
        if self._compares_walls(newest):
            self._next_walls_ns = newest.stamp_ns + _FIX_NS
            by_walls, are_refuted = self._near_walls(latest, T_map_base, window)
            is_contradicted |= are_refuted
            fix = by_walls if fix is None else _joint(by_walls, fix)
        if fix is not None:
            self._take(fix)
            return LocalizationEvent.FIXED
        self._doubts = self._doubts + 1 if is_contradicted else 0
        if self._doubts < _DOUBTS:
            return LocalizationEvent.NOTHING
        self._piece.T_map_run = self._guess = None
        self._doubts = self._vain = 0
        return LocalizationEvent.WITHDRAWN

    def _drive(self, latest: Sequence[Look]) -> None:
        """Add the path from the look that was compared last to the newest one."""
        seen = latest[-1] if self._seen is None else self._seen
        newer = [look for look in latest if look.stamp_ns > seen.stamp_ns]
        for before, after in pairwise([seen, *newer]):
            step = se3.inverse(before.T_run_base) @ after.T_run_base
            moved = np.linalg.norm(step[:3, 3]), se3.rotation_angle_rad(step)
            self._travelled = self._travelled + moved
        self._seen = latest[-1]

    def _window(self, T_map_base: Transform, since: NDArray[np.float64]) -> SearchWindow:
        """Return how far around a pose (4, 4) the robot may be, by its path since then (2,)."""
        path_m, turned_rad = self._travelled - since
        turn_rad = self._drift.rad_per_m * path_m + self._drift.rad_per_rad * turned_rad
        return SearchWindow(
            around=planar.from_transform(T_map_base),
            half_m=float(_REACH_M + _SIGMAS * self._drift.per_m * path_m),
            half_rad=float(_REACH_RAD + _SIGMAS * turn_rad),
        )

    def _near_walls(
        self, latest: Sequence[Look], T_map_base: Transform, window: SearchWindow
    ) -> tuple[Fix | None, bool]:
        """Return the pose by the walls in a window, and whether they contradict its centre."""
        assert self._walls is not None
        newest, query = latest[-1], _query(latest)
        if not len(query):
            return None, False
        field = PlanField(query)
        match = self._walls.recognize(field, window)
        if match is not None:
            fix = self._fix(newest, T_map_base, match)
            if _is_within(fix, window):
                return fix, False
        there = register(field, self._walls.field, window.around)
        return None, there.known_ratio >= _KNOWN_MIN and there.is_refuted

    def _fix(self, newest: Look, T_base: Transform, match: PlanRegistration) -> Fix:
        """Return the pose by walls, near the height and tilt of T_base (4, 4): on a floor there."""
        T_plane = planar.to_transform(planar.from_transform(T_base))
        T_near = planar.to_transform(match.T_target_query) @ se3.inverse(T_plane) @ T_base
        return Fix(
            stamp_ns=newest.stamp_ns,
            T_map_base=self._standing(T_near),
            T_run_base=newest.T_run_base,
            covariance=on_floor(match.covariance),
        )

    def _take(self, fix: Fix) -> None:
        piece = self._piece
        piece.T_map_run = fix.T_map_run
        held = piece.fixes[-1].held if fix.is_open and piece.fixes else self._travelled
        fix = replace(fix, travelled=self._travelled, held=held, piece_ns=piece.begun_ns)
        piece.fixes.append(fix)
        self._doubts = self._vain = 0
        self._next_walls_ns = self._next_view_ns = fix.stamp_ns + _FIX_NS


def _fix_of(seen: Sighting | None, newest: Look, T_base_cam: Transform) -> Fix | None:
    """Return where the camera is as a fix of base."""
    if seen is None:
        return None
    return Fix(
        stamp_ns=newest.stamp_ns,
        T_map_base=seen.T_map_cam @ se3.inverse(T_base_cam),
        T_run_base=newest.T_run_base,
        covariance=se3.carried(seen.covariance, T_base_cam),
        is_by_view=True,
    )


def _joint(by_walls: Fix | None, by_view: Fix) -> Fix:
    """Return the pose by walls, and by landmarks where those leave a direction open."""
    if by_walls is None:
        return by_view
    if not by_walls.is_open:
        return by_walls
    both = by_walls, by_view
    mean, covariance = se3.mean([fix.T_map_base for fix in both], [fix.covariance for fix in both])
    return replace(by_view, T_map_base=mean, covariance=0.5 * covariance)  # their errors differ


def _query(latest: Sequence[Look]) -> FloorPlan:
    """Return the plan of the last metres in the frame of base at the newest look."""
    newest, length_m = planar.from_transform(latest[-1].T_run_base), 0.0
    scans: list[tuple[Planar, KeyScan]] = []
    after = newest
    for look in reversed(latest):
        if look.scan is None:
            continue
        T_run_base = planar.from_transform(look.T_run_base)
        step = planar.between(T_run_base, after)
        length_m += float(np.hypot(step[0], step[1]))
        if length_m > _SPAN_M or len(scans) == _SPAN_SCANS:
            break
        scans.append((planar.between(newest, T_run_base), look.scan))
        after = T_run_base
    return draw(scans)


def _agree(before: Fix, fix: Fix) -> bool:
    """Tell whether an earlier fix puts the robot in the same place, carried on by the run."""
    off = se3.inverse(before.T_map_run @ fix.T_run_base) @ fix.T_map_base
    return se3.is_within(off, _AGREE_M, _AGREE_RAD)


def _mean(fix: Fix, before: Fix) -> Fix:
    """Return the mean of the newest pose and that of an earlier search, carried on by the run."""
    T_before = before.T_map_run @ fix.T_run_base
    T_then_now = se3.inverse(before.T_map_base) @ T_before
    carried = se3.carried(before.covariance, se3.inverse(T_then_now))
    mean, covariance = se3.mean([fix.T_map_base, T_before], [fix.covariance, carried])
    return replace(fix, T_map_base=mean, covariance=covariance)


def _is_within(fix: Fix, window: SearchWindow) -> bool:
    """Tell whether a fix is where it may be, in the plane: heights and tilts drift otherwise."""
    x_m, y_m, yaw_rad = planar.between(window.around, planar.from_transform(fix.T_map_base))
    return bool(np.hypot(x_m, y_m) <= window.half_m and abs(yaw_rad) <= window.half_rad)
