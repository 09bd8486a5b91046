"""Repetition of a recorded round trip, for runs of hours from a recording of seconds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.sources.changes.wrapped import Wrapped
from sceneslam.sources.spanned import TimeSpan
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_least
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange

_PAUSE_NS = 33_000_000  # between the last observation of a lap and the first of the next


class Laps(Wrapped):
    """Repeats a recording `laps` times; stamps and odometry continue from lap to lap.

    The recording should end where it began; else the robot jumps at the end of every lap, which its
    wheels do not measure.
    """

    def __init__(self, source: Source, laps: int) -> None:
        check_least(1, laps=laps)
        super().__init__(source)
        self._laps = laps

    @property
    def length(self) -> int | None:
        """Return the largest possible number of observations, None if unknown."""
        one = self._source.length
        return None if one is None else one * self._laps

    @property
    def span(self) -> TimeSpan | None:
        """Return None: the source's span is that of one lap."""
        return None

    def __iter__(self) -> Iterator[Observation]:
        """Yield the observations of all laps."""
        shift_ns = 0
        T_odom_base: Transform | None = None  # the last odometry that was passed on
        for _ in range(self._laps):
            first: Observation | None = None
            last: Observation | None = None
            T_odom_lap: Transform | None = None  # takes this lap's odometry to the first lap's
            for observation in self._source:
                first = observation if first is None else first
                last = _moved(observation, shift_ns)
                T_lap_base = observation.T_odom_base
                if T_lap_base is not None:
                    if T_odom_base is None:
                        T_odom_lap = se3.identity()
                    elif T_odom_lap is None:
                        T_odom_lap = T_odom_base @ se3.inverse(T_lap_base)
                    T_odom_base = T_odom_lap @ T_lap_base
                    last = replace(last, T_odom_base=T_odom_base)
                yield last
            if first is None or last is None:
                return
            shift_ns = last.stamp_ns + _PAUSE_NS - first.stamp_ns

    def ground_truth(self) -> GroundTruth | None:
        """Return the ground truth of all laps."""
        truth = self._source.ground_truth()
        stamps_ns = [observation.stamp_ns for observation in self._source]
        if truth is None or not stamps_ns:
            return truth
        lap_ns = stamps_ns[-1] + _PAUSE_NS - stamps_ns[0]
        shifts_ns = [lap * lap_ns for lap in range(self._laps)]
        known, start_ns = truth.trajectory, stamps_ns[0] - _PAUSE_NS // 2
        end_ns = start_ns + lap_ns
        is_within = (known.stamps_ns >= start_ns) & (known.stamps_ns < end_ns)
        return GroundTruth(
            trajectory=Trajectory(
                stamps_ns=np.concatenate([known.stamps_ns[is_within] + by for by in shifts_ns]),
                T_world_base=np.concatenate([known.T_world_base[is_within]] * self._laps),
            ),
            scenes=_repeated(_within(truth.scenes, start_ns, end_ns), shifts_ns),
        )


def _moved(observation: Observation, shift_ns: int) -> Observation:
    """Return an observation and its scan with later stamps."""
    scan = observation.scan
    if scan is not None:
        scan = replace(scan, stamp_ns=scan.stamp_ns + shift_ns)
    stamp_ns = observation.stamp_ns + shift_ns
    return replace(observation, stamp_ns=stamp_ns, scan=scan)


def _within(scenes: Sequence[SceneChange], start_ns: int, end_ns: int) -> Sequence[SceneChange]:
    """Return the scene changes of one lap, beginning with the scene at its start."""
    before = [replace(one, stamp_ns=start_ns) for one in scenes if one.stamp_ns < start_ns]
    return [*before[-1:], *(one for one in scenes if start_ns <= one.stamp_ns < end_ns)]


def _repeated(scenes: Sequence[SceneChange], shifts_ns: Sequence[int]) -> tuple[SceneChange, ...]:
    """Return the scene changes of all laps; a scene that goes on into the next lap is no change."""
    every = [replace(one, stamp_ns=one.stamp_ns + by) for by in shifts_ns for one in scenes]
    return tuple(
        one
        for before, one in zip([None, *every], every, strict=False)
        if before is None or one.scene != before.scene
    )
