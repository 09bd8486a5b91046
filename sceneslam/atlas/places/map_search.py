"""Search a loaded map for a run while it goes on: when, with which looks, and what was found."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from itertools import pairwise

from sceneslam.atlas.places.localizer import Fix, LocalizationEvent, Look, MapLocalizer
from sceneslam.atlas.submaps.own_loops import Path
from sceneslam.types import se3
from sceneslam.types.run import Note
from sceneslam.types.se3 import Transform

_REST_NS = 1_000_000_000  # between two searches while the robot stands
_UNFOUND_NS = 5_000_000_000  # after this time a run reports that it was not located
_RECENT = 80  # newest looks with a scan that the localizer gets


class MapSearch:
    """Where the run lies in the loaded map, by one search at a time.

    A search takes its looks when it begins; its result counts when it is collected.
    """

    def __init__(
        self, localizer: MapLocalizer | None, *, executor: Executor, path: Path, note: Note
    ) -> None:
        """Begin; without a localizer nothing is found. `path` gives the run's poses as they are."""
        self._localizer, self._executor = localizer, executor
        self._path, self._note = path, note
        self._search: Future[LocalizationEvent] | None = None
        self._recent: list[Look] = []  # with a scan
        self._rewound_ns: int | None = None  # looks from here on have poses that were replaced
        self._restart_ns: int | None = None  # a piece begins here, and the localizer is to be told
        self._began_ns: int | None = None  # with the first look of the piece
        self._has_told = False
        self._is_news = False
        self._found: list[tuple[int, Transform]] = []  # from which stamp on T_map_run is which
        self.fixes: list[Fix] = []  # by which it is so
        self.was_found = False  # at any time

    @property
    def is_placed(self) -> bool:
        """Tell whether any piece of the run is located, by what was not withdrawn."""
        return bool(self._found)

    @property
    def is_located(self) -> bool:
        """Tell whether the piece that goes on was located."""
        return self._localizer is not None and self._localizer.is_located

    @property
    def piece_ns(self) -> int:
        """Return the stamp with which the piece begins that is located now."""
        return 0 if self._localizer is None else self._localizer.piece_ns

    @property
    def T_map_run(self) -> Transform:
        """Return T_map_run (4, 4) in the loaded map; the identity until the run was located."""
        return self._found[-1][1] if self._found else se3.identity()

    def T_map_runs(self, starts_ns: Sequence[int]) -> list[Transform]:
        """Return T_map_run (4, 4) of submaps with these first stamps (N,).

        It is as it was before the next one of the same piece began; the newest has today's.
        """
        pieces_ns = [0] if self._localizer is None else self._localizer.pieces_ns
        runs = []
        for start_ns, next_ns in pairwise([*starts_ns, math.inf]):
            piece = bisect_right(pieces_ns, start_ns)
            end_ns = min([next_ns, *pieces_ns[piece : piece + 1]])
            found = bisect_left(self._found, end_ns, key=lambda one: one[0])
            runs.append(self._found[found - 1][1] if found else se3.identity())
        return runs

    def take_news(self) -> bool:
        """Tell whether T_map_run has changed since the last call."""
        is_news, self._is_news = self._is_news, False
        return is_news

    def wants_view(self, look: Look) -> bool:
        """Tell whether it is time to compare a view at a look."""
        localizer = self._localizer
        return localizer is not None and self._search is None and localizer.wants_view(look)

    def rests(self, stamp_ns: int) -> bool:
        """Tell whether the map should be searched even if the robot stands."""
        if self.is_located or not self._recent:
            return False
        return stamp_ns - self._recent[-1].stamp_ns >= _REST_NS

    def rewind(self, stamp_ns: int) -> None:
        """Expect other poses from a stamp on."""
        before_ns = stamp_ns if self._rewound_ns is None else self._rewound_ns
        self._rewound_ns = min(stamp_ns, before_ns)
        if self._restart_ns is not None and stamp_ns <= self._restart_ns:
            self._restart_ns = None

    def restart(self, stamp_ns: int) -> None:
        """Search everywhere again: nothing measured the motion to the pose at a stamp."""
        self._restart_ns = stamp_ns

    def look(self, look: Look) -> None:
        """Compare a look with the map, if it is time and no search is running."""
        localizer = self._localizer
        if localizer is None:
            return
        if self._began_ns is None:
            self._began_ns = look.stamp_ns
        latest = [*self._recent[1 - _RECENT :], look]
        if look.scan is not None:
            self._recent = latest
        if self._search is not None:
            return
        if look.view is not None or (look.scan is not None and localizer.is_due(look)):
            self._search = self._executor.submit(localizer.compare, tuple(latest))
            self.collect(look.stamp_ns)
        else:
            self._take(LocalizationEvent.NOTHING, localizer, look.stamp_ns)

    def collect(self, stamp_ns: int) -> None:
        """Take the result of a search that has ended; between two, what else the localizer needs.

        `stamp_ns` is the newest pose's.
        """
        localizer = self._localizer
        if localizer is None:
            return
        if self._search is not None and self._search.done():
            search, self._search = self._search, None
            self._take(search.result(), localizer, stamp_ns)
        if self._search is None and self._rewound_ns is not None:
            recent = [(look, self._path(look.stamp_ns)) for look in self._recent]
            self._recent = [replace(look, T_run_base=T) for look, T in recent if T is not None]
            localizer.rewind(self._rewound_ns, self._path)
            self._follow(localizer, self._rewound_ns)
            self._rewound_ns = None
        if self._search is None and self._restart_ns is not None:
            localizer.restart(self._restart_ns)
            self._recent = [look for look in self._recent if look.stamp_ns >= self._restart_ns]
            self._restart_ns, self._began_ns, self._has_told = None, None, False

    def _take(self, outcome: LocalizationEvent, localizer: MapLocalizer, stamp_ns: int) -> None:
        """Process the result of a comparison with the map."""
        assert self._began_ns is not None
        after_s = (stamp_ns - self._began_ns) / 1e9
        if outcome is LocalizationEvent.FIXED:
            self._follow(localizer, localizer.fixes[-1].stamp_ns)
        elif outcome is LocalizationEvent.FOUND:
            self._follow(localizer, localizer.piece_ns)
            self.was_found = self._has_told = True
            self._note(outcome.value, stamp_ns, after_s=after_s, T_map_run=self.T_map_run.tolist())
        elif outcome is LocalizationEvent.WITHDRAWN:
            self._follow(localizer, localizer.piece_ns)
            self._note(outcome.value, stamp_ns, after_s=after_s)
        elif not self.is_located and not self._has_told and after_s * 1e9 >= _UNFOUND_NS:
            self._note("not_relocalized", stamp_ns, after_s=after_s)
            self._has_told = True

    def _follow(self, localizer: MapLocalizer, from_ns: int) -> None:
        """Take the localizer's estimate of where the run lies, for poses from a stamp on."""
        self._is_news |= bool(self._found) or localizer.is_located
        self._found, self.fixes = [one for one in self._found if one[0] < from_ns], localizer.fixes
        if localizer.is_located and localizer.T_map_run is not None:
            self._found.append((from_ns, localizer.T_map_run))
