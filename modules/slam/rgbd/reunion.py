"""Knows the places of earlier sessions again, so that all sessions lie in one map.

Every session has a map of its own, and what another module did in between has drifted. Where the
camera sees what an earlier session saw, it is known where in `map` it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from .recognition import PlaceRecognizer
from .view import View
from .visual_map import VisualMap

_EVERY = 15  # images, of which one is looked up
_TRIED = 2  # keyframes per past session that an image is held against
_SAME_M, _SAME_RAD = 0.1, 0.05  # two images that agree on where the session lies
_DRIFT_M, _DRIFT_RAD = 0.3, 0.2  # that is believed of what happened in between ...
_DRIFT_M_PER_S, _DRIFT_RAD_PER_S = 0.05, 0.05  # ... and for its time: 5 % of walking pace


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Past:
    """An earlier session."""

    visual_map: VisualMap
    recognizer: PlaceRecognizer
    T_map_local: Transform
    end_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Query:
    """A view, and where the present session has it."""

    view: View
    T_local_base: Transform


class Reunion:
    """Looks for past sessions in the present one, a little per image, until it is known."""

    def __init__(self, *, keyframe_limit: int) -> None:
        self._limit = keyframe_limit
        self._past: list[_Past] = []
        self._T_map_local: Transform | None = None
        self._queries: list[tuple[_Past, _Query]] = []
        self._hypothesis: Transform | None = None
        self._is_known, self._images, self._end_ns = False, 0, 0

    def begin(self) -> None:
        """Start a session, which is not placed yet."""
        self._T_map_local, self._end_ns = None, 0
        self._forget()

    def place(self, T_map_local: Transform) -> None:
        """Hear where the session lies; what was found out before is not relied on any more."""
        self._T_map_local = T_map_local.copy()
        self._forget()

    def see(self, view: View, T_local_base: Transform) -> None:
        """Take a view whose pose is held."""
        self._end_ns = view.observation.stamp_ns
        self._images += 1
        if self._past and not self._is_known and not self._queries and self._images % _EVERY == 0:
            query = _Query(view=view, T_local_base=T_local_base.copy())
            self._queries = [(past, query) for past in self._past]

    def step(self) -> Transform | None:
        """Do one image's share; return T_new_old where two views agree on where all poses lie."""
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
        """Keep the map of the session, where it was placed; forget the oldest beyond the limit."""
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
        """Return what moves the session's poses to where a past session has the view."""
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
