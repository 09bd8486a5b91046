"""Correction of stamps of receipt: of those that do not rise, and of those that come in bursts."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

_SPAN = 200  # scans over which the period is measured: bursts average out
_BACKLOG = 20  # scans that wait at most until they are stamped: 3.3 s in Intel's log
_CLOSEST = 0.1  # of the period: so far apart are any two scans
_FASTER = 0.8  # of the usual period: the scanner turns faster; a backlog makes 0.9 of a mean


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


def measured_stamps(received_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return rising times of measurement (N,) of scans, by their stamps of receipt in their order.

    A scanner turns at a constant rate, while a busy computer stamps its scans too late and in
    bursts, but never too early: a scan was measured no later than any of the next `_BACKLOG` was
    received, less the period for each scan between (after Olson, "A passive solution to the sensor
    synchronization problem", IROS 2010, with the count of scans as the sensor's clock).
    """
    count = len(received_ns)
    if count < 2:
        return received_ns
    span = min(_SPAN, count - 1)
    spans_ns = received_ns[span:] - received_ns[:-span]
    period_ns = max(float(np.median(spans_ns)) / span, 1.0 / _CLOSEST)
    periods = _periods(spans_ns / (span * period_ns), span)
    regular_ns = np.rint(periods * period_ns).astype(np.int64)
    late_ns = received_ns - regular_ns
    padded = np.pad(late_ns, (0, _BACKLOG), constant_values=np.iinfo(np.int64).max)
    least_ns = sliding_window_view(padded, _BACKLOG + 1).min(axis=1)
    spaced_ns = np.rint(np.arange(count) * _CLOSEST * period_ns).astype(np.int64)
    apart_ns = np.maximum.accumulate(least_ns + regular_ns - spaced_ns)
    return np.asarray(apart_ns + spaced_ns)


def _periods(spans: NDArray[np.float64], span: int) -> NDArray[np.float64]:
    """Return how many usual periods after the first each of N scans is due.

    `spans` (N - span,) are the mean periods of `span` scans, as shares of the usual one. Where the
    rate has risen, the period is that of the scans before or after, whichever is shorter.
    """
    places = np.arange(len(spans) + span - 1)
    before, after = (spans[at.clip(0, len(spans) - 1)] for at in (places - span + 1, places))
    local = np.minimum(before, after)
    return np.append(0.0, np.cumsum(np.where(local < _FASTER, local, 1.0)))
