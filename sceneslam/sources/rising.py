"""Correction of stamps of receipt: of those that do not rise, and of those that come in bursts."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

_SPAN = 200  # scans over which the period is measured: bursts average out
_BACKLOG = 20  # scans that wait at most until they are stamped: 3.3 s in Intel's log
_CLOSEST = 0.1  # of the period: so far apart are any two scans
_STEP_NS = np.int64(1_000_000)  # between stamps of which nothing is known
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


def rising_stamps(
    stamps_ns: NDArray[np.int64], believed: NDArray[np.bool_] | None = None
) -> NDArray[np.int64]:
    """Return rising stamps (N,): those out of order are interpolated between neighbours.

    So are those that are not `believed` (N,). At the ends, with one neighbour only, they are set
    1 ms apart.
    """
    places = np.arange(len(stamps_ns))
    candidates = places if believed is None else np.flatnonzero(believed)
    kept = candidates[longest_rising(stamps_ns[candidates])]
    if not len(kept):
        return stamps_ns
    first, last = int(kept[0]), int(kept[-1])
    # Relative to the first, so that a float holds the nanoseconds.
    origin = int(stamps_ns[first])
    offsets = np.interp(places, kept, (stamps_ns[kept] - origin).astype(np.float64))
    rising: NDArray[np.int64] = np.rint(offsets).astype(np.int64) + origin
    rising[kept] = stamps_ns[kept]
    rising[:first] = stamps_ns[first] - (first - places[:first]) * _STEP_NS
    rising[last + 1 :] = stamps_ns[last] + (places[last + 1 :] - last) * _STEP_NS
    return rising


def continued_stamps(stamps_ns: NDArray[np.int64], jump_ns: int) -> NDArray[np.int64]:
    """Return rising stamps (N,) of a clock that was set: it goes on where it was set back.

    Stamps between jumps of more than `jump_ns` are a run. One that lies before the run before it
    begins a usual period after that, and so do all later ones. Single stamps, and runs after which
    the clock is right again, are interpolated.
    """
    steps_ns = np.diff(stamps_ns)
    usual_ns = steps_ns[(steps_ns > 0) & (steps_ns <= jump_ns)]
    period_ns = np.int64(np.median(usual_ns)) if len(usual_ns) else _STEP_NS
    starts = np.flatnonzero(np.abs(steps_ns) > jump_ns) + 1
    joined_ns, believed = stamps_ns.copy(), np.ones(len(stamps_ns), dtype=bool)
    runs, marks = np.split(joined_ns, starts), np.split(believed, starts)  # views
    shift_ns, before_ns = np.int64(0), None
    for place, (run_ns, mark) in enumerate(zip(runs, marks, strict=True)):
        after_ns = runs[place + 1][0] if place + 1 < len(runs) else None
        if _is_undone(before_ns, run_ns, after_ns, jump_ns):
            mark[:] = False
            continue
        if before_ns is not None and before_ns - run_ns[0] > jump_ns:
            shift_ns += before_ns - run_ns[0] + period_ns
        before_ns = run_ns[-1].copy()
        run_ns += shift_ns
    return rising_stamps(joined_ns, believed)


def _is_undone(
    before_ns: np.int64 | None, run_ns: NDArray[np.int64], after_ns: np.int64 | None, jump_ns: int
) -> bool:
    """Tell whether only a run (M,) is wrong: the stamp after it goes on from the one before it."""
    if after_ns is None:
        return False
    if before_ns is None:
        return len(run_ns) == 1 and bool(after_ns < run_ns[0])
    is_between = before_ns <= run_ns[0] and run_ns[-1] <= after_ns
    if is_between or after_ns < before_ns:
        return False
    if len(run_ns) == 1:
        return True
    missing_ns = run_ns[-1] - run_ns[0] - (after_ns - before_ns)  # of the time for the run
    if run_ns[0] > after_ns:  # the clock was ahead for a time, which may have begun with a pause
        return bool(missing_ns <= jump_ns)
    return bool(abs(missing_ns) <= jump_ns)


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
