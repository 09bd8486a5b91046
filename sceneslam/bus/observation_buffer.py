"""Recent observations with their poses, for a hand-over that begins in the past."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.bridge import Bridge
from sceneslam.bus.judging.gate import Witness
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking
from sceneslam.types.run import BRIDGED
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import STAMP_MAX_NS

_BULKY = ("image_bgr", "depth_m", "points_lidar", "point_times_s")


@dataclass(slots=True, kw_only=True, eq=False)
class BufferedObservation:
    """An observation with its pose, and the state from which later poses can be bridged."""

    observation: Observation
    T_map_base: Transform | None  # None: no pose could be given
    module: str  # the module that gave the pose, BRIDGED without one
    bridge: Bridge  # after the observation
    turn: NDArray[np.float64] | None  # (3, 3) rotation since the previous entry, if trusted
    tracking: Tracking | None  # the active module's answer, also where its pose is not used
    is_trusted: bool  # a module that was not suspect was tracking, as certain as usual
    vouches: bool = False  # then: it measures without wheels, and moved as they and the gyro say
    missed_rad: float | None = None  # yaw by wheels alone since the start, less the gyro's
    T_new_told: Transform = field(default_factory=se3.identity)  # corrections since it was reported

    @property
    def stamp_ns(self) -> int:
        """Return the observation's stamp."""
        return self.observation.stamp_ns

    @property
    def witness(self) -> Witness:
        """Return what is known of the odometry, for a module that gets the observation later."""
        return Witness(missed_rad=self.missed_rad, is_vouched=self.is_trusted and self.vouches)

    def move(self, T_new_old: Transform) -> None:
        """Move the pose by the correction (4, 4) of the map."""
        if self.T_map_base is not None:
            self.T_map_base = T_new_old @ self.T_map_base
        self.bridge, self.T_new_told = self.bridge.moved(T_new_old), T_new_old @ self.T_new_told


def bridged(
    before: BufferedObservation, moments: Sequence[BufferedObservation]
) -> list[BufferedObservation]:
    """Return moments with poses that are bridged from the one before them."""
    bridge, found = before.bridge.copy(), []
    for each in moments:
        T_map_base = bridge.predict(each.observation, by_velocity=False, turn=each.turn)
        if T_map_base is None:  # without odometry; the next odometry continues from the last
            T_map_base = bridge.copy().predict(each.observation, by_velocity=True)
        told = replace(each, T_map_base=T_map_base, module=BRIDGED, bridge=bridge.copy())
        told.is_trusted = False
        found.append(told)
    return found


class ObservationBuffer:
    """The observations of the last seconds, bounded in time and in bytes.

    When the limit is reached, older entries lose their sensor data, so that the spacing of those
    left grows with their age: a module that catches up gets fewer of the older images, and every
    moment still gets its pose.
    """

    def __init__(self, *, span_s: float, limit_mb: float, keeps_sensors: bool) -> None:
        self._span_ns, self._limit_bytes = round(span_s * 1e9), round(limit_mb * 1e6)
        self._keeps_sensors = keeps_sensors
        self._moments: list[BufferedObservation] = []  # by rising stamp
        self._full: list[BufferedObservation] = []  # those that still have their sensor data
        self._bytes = 0  # of that sensor data
        self._read_ns = STAMP_MAX_NS  # entries after it are not removed by the next one

    @property
    def newest(self) -> BufferedObservation:
        """Return the newest entry."""
        return self._moments[-1]

    @property
    def oldest_ns(self) -> int:
        """Return the stamp of the oldest entry."""
        return self._moments[0].stamp_ns

    def add(self, moment: BufferedObservation) -> None:
        """Add an entry; remove those that are too old."""
        self._append(moment)
        old_ns = min(moment.stamp_ns - self._span_ns - 1, self._read_ns)
        self._read_ns = STAMP_MAX_NS
        del self._moments[: _count(self._moments, old_ns)]
        self._drop(slice(0, _count(self._full, old_ns)))
        while not self._keeps_sensors and moment.tracking is not None and len(self._full) > 1:
            self._strip(0)
        while self._bytes > self._limit_bytes and len(self._full) > 2:
            self._strip(self._least_missed())

    def keep_from(self, stamp_ns: int) -> None:
        """Keep the entries after a stamp, which a hand-over is led through, when one is added."""
        self._read_ns = min(self._read_ns, stamp_ns)

    def anchor(self, until_ns: int | None) -> BufferedObservation:
        """Return the newest trusted entry, not after `until_ns` if that is given.

        Without a trusted entry, the newest by a module; without that, the oldest with a pose;
        without a pose, the oldest.
        """
        posed = [moment for moment in self._moments if moment.T_map_base is not None]
        ended = [one for one in posed if until_ns is None or one.stamp_ns <= until_ns]
        trusted = [one for one in ended if one.is_trusted]
        measured = [one for one in ended if one.module != BRIDGED]
        return [*posed[:1], *measured[-1:], *trusted[-1:]][-1] if posed else self._moments[0]

    def after(self, stamp_ns: int) -> list[BufferedObservation]:
        """Return all entries after a stamp."""
        return self._moments[_count(self._moments, stamp_ns) :]

    def last_until(self, stamp_ns: int) -> BufferedObservation | None:
        """Return the newest entry up to a stamp, None if it was removed."""
        count = _count(self._moments, stamp_ns)
        return self._moments[count - 1] if count else None

    def rewrite(self, moments: list[BufferedObservation]) -> None:
        """Replace all entries from the first of `moments` on by these, with corrected poses.

        What is left of their sensor data is kept.
        """
        before_ns = moments[0].stamp_ns - 1
        known = {each.stamp_ns: each.observation for each in self.after(before_ns)}
        del self._moments[_count(self._moments, before_ns) :]
        self._drop(slice(_count(self._full, before_ns), None))
        for moment in moments:
            moment.observation = known.get(moment.stamp_ns, moment.observation)
            self._append(moment)

    def move(self, T_new_old: Transform, after_ns: int) -> None:
        """Move the poses after a stamp by the correction (4, 4) of the map."""
        for moment in self.after(after_ns):
            moment.move(T_new_old)

    def clear(self) -> None:
        """Remove all entries, to free memory when a finished run is kept for its results."""
        self._moments, self._full, self._bytes = [], [], 0

    def _append(self, moment: BufferedObservation) -> None:
        self._moments.append(moment)
        size = _size(moment.observation)
        if size:
            self._full.append(moment)
            self._bytes += size

    def _drop(self, full: slice) -> None:
        """Leave removed entries out of what has sensor data."""
        self._bytes -= sum(_size(moment.observation) for moment in self._full[full])
        del self._full[full]

    def _least_missed(self) -> int:
        """Return the index, among the entries with sensor data, of the least needed one."""
        stamps_ns = np.array([moment.observation.stamp_ns for moment in self._full], np.float64)
        ages_ns = stamps_ns[-1] - stamps_ns[1:-1]
        return int(np.argmin((stamps_ns[2:] - stamps_ns[:-2]) / ages_ns)) + 1

    def _strip(self, full: int) -> None:
        """Remove the sensor data of one entry."""
        moment = self._full.pop(full)
        self._bytes -= _size(moment.observation)
        moment.observation = bare(moment.observation)


def bare(observation: Observation) -> Observation:
    """Return an observation without its sensor data, but for scans, wheels and gyro."""
    return replace(observation, **dict.fromkeys(_BULKY))  # type: ignore[arg-type]


def _count(moments: list[BufferedObservation], stamp_ns: int) -> int:
    """Return the number of entries up to a stamp."""
    return bisect_right(moments, stamp_ns, key=attrgetter("observation.stamp_ns"))


def _size(observation: Observation) -> int:
    """Return the bytes of the sensor data that can be removed."""
    arrays = (getattr(observation, name) for name in _BULKY)
    return sum(array.nbytes for array in arrays if array is not None)
