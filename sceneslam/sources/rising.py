"""Correction of stamps that do not rise, in a sequence of known order."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray


def longest_rising(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices (M,) of the longest strictly rising subsequence of stamps (N,)."""
    tails: list[int] = []  # the smallest stamp that ends a rising run of each length
    ends: list[int] = []  # and its index
    before = np.full(len(stamps_ns), -1)
    for place, stamp in enumerate(stamps_ns.tolist()):
        length = bisect_left(tails, stamp)
        tails[length : length + 1] = [stamp]
        ends[length : length + 1] = [place]
        before[place] = ends[length - 1] if length else -1
    kept = []
    place = ends[-1] if ends else -1
    while place >= 0:
        kept.append(place)
        place = int(before[place])
    return np.array(kept[::-1], dtype=np.int64)


def rising_order(stamps_ns: NDArray[np.int64], *, late_max_ns: int) -> NDArray[np.int64]:
    """Return indices (N,) sorted by stamp; unsorted if one is late by more than `late_max_ns`."""
    behind_ns = np.maximum.accumulate(stamps_ns) - stamps_ns
    if behind_ns.max(initial=0) > late_max_ns:
        return np.arange(len(stamps_ns))
    return np.argsort(stamps_ns, kind="stable")


def rising_stamps(stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return rising stamps (N,): those out of order are interpolated between neighbours.

    At the ends, with one neighbour only, they are set 1 ms apart.
    """
    kept = longest_rising(stamps_ns)
    if not len(kept):
        return stamps_ns
    places = np.arange(len(stamps_ns))
    first, last = int(kept[0]), int(kept[-1])
    # Relative to the first, so that a float holds the nanoseconds.
    origin = int(stamps_ns[first])
    offsets = np.interp(places, kept, (stamps_ns[kept] - origin).astype(np.float64))
    rising: NDArray[np.int64] = np.rint(offsets).astype(np.int64) + origin
    rising[kept] = stamps_ns[kept]
    rising[:first] = stamps_ns[first] - (first - places[:first]) * 1_000_000
    rising[last + 1 :] = stamps_ns[last] + (places[last + 1 :] - last) * 1_000_000
    return rising
