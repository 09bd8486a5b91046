"""Relocalize across sessions.

Every session has its own map, and the poses of other modules in between have drifted. When the
camera sees a place of an earlier session, its pose in `map` is known again; every such place is
reported as a loop.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.maps import LoopLayer
from sceneslam.types.se3 import Transform

from ..locate.recognition import PlaceRecognizer
from ..map.visual_map import VisualMap
from ..see.view import View

_EVERY = 15  # one of this many images is searched
_TRIED = 2  # keyframes per past session that an image is compared with
_SAME_M, _SAME_RAD = 0.1, 0.05  # largest difference of two agreeing results
_DRIFT_M, _DRIFT_RAD = 0.3, 0.2  # accepted drift between the sessions
_DRIFT_M_PER_S, _DRIFT_RAD_PER_S = 0.05, 0.05  # accepted drift per second: 5 % of walking pace
_KEYFRAME_M, _KEYFRAME_RAD = 0.005, 0.002  # error of a keyframe (experiments/rgbd_loop.md)
_LOOP_M = 1.0  # between two loops, less would not be independent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Past:
    """An earlier session."""

    visual_map: VisualMap
    recognizer: PlaceRecognizer
    T_map_local: Transform
    end_ns: int
    is_known: bool  # it shows a place of a session before it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Query:
    """A view with its pose in the current session."""

    view: View
    T_local_base: Transform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Loop:
    """A place of an earlier session that was recognized."""

    stamps_ns: tuple[int, int]  # of the keyframe, and now
    T_from_to: Transform  # base then to base now
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order
    T_new_old: Transform  # aligns the session with the past one


class SessionRelocalizer:
    """Searches past sessions, some work per image, until the current session is aligned."""

    def __init__(self, *, keyframe_limit: int) -> None:
        self._limit = keyframe_limit
        self._past: list[_Past] = []
        self._loops: list[_Loop] = []  # of the current session
        self._T_map_local: Transform | None = None
        self._queries: list[tuple[_Past, _Query]] = []
        self._hypothesis: _Loop | None = None
        self._is_known, self._images, self._end_ns = False, 0, 0
        self._looped_at = np.full(3, np.inf)  # where the last loop was

    def begin(self) -> None:
        """Begin a session, which is not placed yet."""
        self._T_map_local, self._end_ns, self._loops = None, 0, []
        self._forget()

    def place(self, T_map_local: Transform) -> None:
        """Set the session's T_map_local (4, 4); earlier search results are dropped."""
        self._T_map_local = T_map_local.copy()
        self._forget()

    @property
    def loops(self) -> LoopLayer | None:
        """Return the loops from earlier sessions to the current one."""
        if not self._loops:
            return None
        return LoopLayer(
            stamps_ns=np.array([loop.stamps_ns for loop in self._loops], np.int64),
            T_from_to=np.array([loop.T_from_to for loop in self._loops]),
            information=np.array([np.linalg.inv(loop.covariance) for loop in self._loops]),
        )

    def see(self, view: View, T_local_base: Transform) -> None:
        """Add a view with a tracked pose.

        It is not searched if the depth camera is too far from everything that the image shows: from
        there a sideways motion looks like a turn.
        """
        self._end_ns = view.observation.stamp_ns
        self._images += 1
        if not self._past or self._queries or self._images % _EVERY:
            return
        if view.is_monocular and view.observation.depth_m is not None:
            return
        if self._is_known and np.linalg.norm(T_local_base[:3, 3] - self._looped_at) < _LOOP_M:
            return
        query = _Query(view=view, T_local_base=T_local_base.copy())
        self._queries = [(past, query) for past in self._past]

    def step(self) -> Transform | None:
        """Do one image's share; return T_new_old (4, 4) once two views agree on it, else None."""
        if not self._queries or self._T_map_local is None:
            return None
        past, query = self._queries.pop()
        loop = self._recognise(past, query, self._T_map_local)
        if loop is None:
            return None
        self._queries = []
        if self._is_known:
            self._add(loop, query)
            return None
        earlier, self._hypothesis = self._hypothesis, loop
        if earlier is None or not se3.is_within(
            se3.inverse(earlier.T_new_old) @ loop.T_new_old, _SAME_M, _SAME_RAD
        ):
            return None
        self._is_known = True
        self._loops.append(earlier)
        self._add(loop, query)
        return loop.T_new_old

    def end(self, visual_map: VisualMap, recognizer: PlaceRecognizer) -> None:
        """Keep the session's map if it was placed; beyond the limit one is removed.

        First those of places that earlier sessions show, too, then the oldest.
        """
        if self._T_map_local is None or not len(visual_map.keyframes):
            return
        self._past.append(
            _Past(
                visual_map=visual_map,
                recognizer=recognizer,
                T_map_local=self._T_map_local,
                end_ns=self._end_ns,
                is_known=self._is_known,
            )
        )
        while len(self._past) > 1 and self._size() > self._limit:
            self._past.remove(next((past for past in self._past if past.is_known), self._past[0]))
        self.begin()

    def _size(self) -> int:
        return sum(len(past.visual_map.keyframes) for past in self._past)

    def _forget(self) -> None:
        self._queries, self._hypothesis = [], None
        self._is_known, self._images = False, 0

    def _add(self, loop: _Loop, query: _Query) -> None:
        self._loops.append(loop)
        self._looped_at = query.T_local_base[:3, 3]

    def _recognise(self, past: _Past, query: _Query, T_map_local: Transform) -> _Loop | None:
        """Return the loop that aligns the session with a past one, by this view."""
        view = query.view
        alike = past.recognizer.places.alike(view.features.descriptors)
        for place in alike[:_TRIED]:
            seen = past.recognizer.recognize(place.place_id, view.features, view.depth_m)
            if seen is None:
                continue
            estimate = seen.fix.estimate
            T_map_base = past.T_map_local @ estimate.T_local_base
            T_error = se3.inverse(T_map_local @ query.T_local_base) @ T_map_base
            elapsed_s = max(0.0, (view.observation.stamp_ns - past.end_ns) * 1e-9)
            drift_m = _DRIFT_M + _DRIFT_M_PER_S * elapsed_s
            drift_rad = _DRIFT_RAD + _DRIFT_RAD_PER_S * elapsed_s
            if not se3.is_within(T_error, drift_m, drift_rad):
                return None
            keyframe = past.visual_map.keyframes[seen.keyframe_id]
            floor = np.repeat([_KEYFRAME_M**2, _KEYFRAME_RAD**2], 3)
            return _Loop(
                stamps_ns=(keyframe.stamp_ns, view.observation.stamp_ns),
                T_from_to=se3.inverse(keyframe.T_local_base) @ estimate.T_local_base,
                covariance=estimate.covariance + np.diag(floor),
                T_new_old=se3.inverse(T_map_local) @ T_map_base @ se3.inverse(query.T_local_base),
            )
        return None
