"""Relocalize across sessions, so that all sessions of the module lie in one map.

Every session has its own map, and the poses of other modules in between have drifted. When the
camera sees a place of an earlier session, its pose in `map` is known again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from .recognition import PlaceRecognizer
from .view import View
from .visual_map import VisualMap

_EVERY = 15  # one of this many images is searched
_TRIED = 2  # keyframes per past session that an image is compared with
_SAME_M, _SAME_RAD = 0.1, 0.05  # largest difference of two agreeing results
_DRIFT_M, _DRIFT_RAD = 0.3, 0.2  # accepted drift between the sessions
_DRIFT_M_PER_S, _DRIFT_RAD_PER_S = 0.05, 0.05  # accepted drift per second: 5 % of walking pace


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Past:
    """An earlier session."""

    visual_map: VisualMap
    recognizer: PlaceRecognizer
    T_map_local: Transform
    end_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Query:
    """A view with its pose in the current session."""

    view: View
    T_local_base: Transform


class Reunion:
    """Searches past sessions, some work per image, until the current session is aligned."""

    def __init__(self, *, keyframe_limit: int) -> None:
        self._limit = keyframe_limit
        self._past: list[_Past] = []
        self._T_map_local: Transform | None = None
        self._queries: list[tuple[_Past, _Query]] = []
        self._hypothesis: Transform | None = None
        self._is_known, self._images, self._end_ns = False, 0, 0

    def begin(self) -> None:
        """Begin a session, which is not placed yet."""
        self._T_map_local, self._end_ns = None, 0
        self._forget()

    def place(self, T_map_local: Transform) -> None:
        """Set the session's T_map_local (4, 4); earlier search results are dropped."""
        self._T_map_local = T_map_local.copy()
        self._forget()

    def see(self, view: View, T_local_base: Transform) -> None:
        """Take a view with a tracked pose."""
        self._end_ns = view.observation.stamp_ns
        self._images += 1
        if self._past and not self._is_known and not self._queries and self._images % _EVERY == 0:
            query = _Query(view=view, T_local_base=T_local_base.copy())
            self._queries = [(past, query) for past in self._past]

    def step(self) -> Transform | None:
        """Do one image's share; return T_new_old (4, 4) once two views agree on it, else None."""
        if not self._queries or self._T_map_local is None:
            return None
        past, query = self._queries.pop()
        T_new_old = self._recognise(past, query, self._T_map_local)
        if T_new_old is None:
            return None
        earlier, self._hypothesis, self._queries = self._hypothesis, T_new_old, []
        if earlier is None or not _is_small(se3.inverse(earlier) @ T_new_old, _SAME_M, _SAME_RAD):
            return None
        self._is_known = True
        return T_new_old

    def end(self, visual_map: VisualMap, recognizer: PlaceRecognizer) -> None:
        """Keep the session's map if it was placed; remove the oldest maps beyond the limit."""
        if self._T_map_local is None or not len(visual_map.keyframes):
            return
        self._past.append(
            _Past(
                visual_map=visual_map,
                recognizer=recognizer,
                T_map_local=self._T_map_local,
                end_ns=self._end_ns,
            )
        )
        while len(self._past) > 1 and self._size() > self._limit:
            del self._past[0]
        self.begin()

    def _size(self) -> int:
        return sum(len(past.visual_map.keyframes) for past in self._past)

    def _forget(self) -> None:
        self._queries, self._hypothesis = [], None
        self._is_known, self._images = False, 0

    def _recognise(self, past: _Past, query: _Query, T_map_local: Transform) -> Transform | None:
        """Return T_new_old (4, 4) that aligns the session with a past one, by this view."""
        view = query.view
        alike = past.recognizer.places.alike(view.features.descriptors)
        for place in alike[:_TRIED]:
            seen = past.recognizer.recognize(place.place_id, view.features, view.depth_m)
            if seen is None:
                continue
            T_map_base = past.T_map_local @ seen.fix.estimate.T_local_base
            T_new_old = se3.inverse(T_map_local) @ T_map_base @ se3.inverse(query.T_local_base)
            T_error = se3.inverse(T_map_local @ query.T_local_base) @ T_map_base
            elapsed_s = max(0.0, (view.observation.stamp_ns - past.end_ns) * 1e-9)
            drift_m = _DRIFT_M + _DRIFT_M_PER_S * elapsed_s
            drift_rad = _DRIFT_RAD + _DRIFT_RAD_PER_S * elapsed_s
            return np.asarray(T_new_old) if _is_small(T_error, drift_m, drift_rad) else None
        return None


def _is_small(T_a_b: Transform, shift_m: float, turn_rad: float) -> bool:
    is_near = np.linalg.norm(T_a_b[:3, 3]) <= shift_m
    return bool(is_near and se3.rotation_angle_rad(T_a_b) <= turn_rad)
