"""Submaps for loop closure: likelihood fields and searches, built on demand."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

from sceneslam.types.planar import between

from .field import LikelihoodField
from .keyframes import ScanKeyframes
from .loop_search import LoopSearch
from .surface import joined

_KEPT = 24  # places in memory, about 2 MB each


@dataclass(slots=True)
class ScanSubmap:
    """One submap in the frame of its middle keyframe."""

    anchor: int
    field: LikelihoodField
    _search: LoopSearch | None = None

    @property
    def search(self) -> LoopSearch:
        """Return the wide search, built at first use."""
        if self._search is None:
            self._search = LoopSearch(self.field)
        return self._search


@dataclass(slots=True)
class Places:
    """The places of all finished submaps; the latest used are kept."""

    keyframes: ScanKeyframes
    resolution_m: float
    _places: OrderedDict[int, ScanSubmap] = field(default_factory=OrderedDict)

    def of(self, submap: int) -> ScanSubmap:
        """Return a submap's place."""
        if submap not in self._places:
            self._places[submap] = self._make(self.keyframes.of_submap(submap))
            if len(self._places) > _KEPT:
                self._places.popitem(last=False)
        self._places.move_to_end(submap)
        return self._places[submap]

    def _make(self, numbers: range) -> ScanSubmap:
        anchor = numbers[len(numbers) // 2]
        frames = self.keyframes.frames
        T_local_anchor = frames[anchor].T_local_base
        parts = [
            self.keyframes.surfaces_base(i).moved(between(T_local_anchor, frames[i].T_local_base))
            for i in self.keyframes.around(anchor, numbers)
        ]
        return ScanSubmap(anchor=anchor, field=LikelihoodField(joined(parts), self.resolution_m))
