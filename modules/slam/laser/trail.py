"""The way of the last second by dead reckoning: a scan may come later than newer observations."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np

from sceneslam.types.planar import Planar, between, compose

_KEPT_NS = 1_000_000_000  # no driver is later


@dataclass(slots=True)
class Trail:
    """The poses of the last observations, in a frame of their own."""

    _stamps_ns: list[int] = field(default_factory=list)
    _poses: list[Planar] = field(default_factory=list)

    def add(self, stamp_ns: int, T_prev_curr: Planar) -> None:
        """Go on by the motion (3,) to an observation."""
        self._poses.append(compose(self._poses[-1], T_prev_curr) if self._poses else np.zeros(3))
        self._stamps_ns.append(stamp_ns)
        old = bisect_left(self._stamps_ns, stamp_ns - _KEPT_NS)
        del self._stamps_ns[:old], self._poses[:old]

    def back_to(self, stamp_ns: int) -> Planar:
        """Return the motion (3,) from the newest observation back to a stamp; none if it is newer.

        To the oldest one that is known, if the stamp is older.
        """
        after = bisect_left(self._stamps_ns, stamp_ns)
        if after == len(self._poses):
            return np.zeros(3)
        then = self._poses[after]
        if after > 0:
            first_ns, last_ns = self._stamps_ns[after - 1 : after + 1]
            share = (stamp_ns - first_ns) / (last_ns - first_ns)
            first = self._poses[after - 1]
            then = compose(first, share * between(first, then))
        return between(self._poses[-1], then)
