"""What was observed lately and what was known of the motion then, for a hand-over in the past."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.atlas import BRIDGED
from sceneslam.bus.bridge import Bridge
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_THINNED_RATIO = 0.95  # of the limit is left, so that not every moment has to thin
_BULKY = ("image_bgr", "depth_m", "points_lidar", "point_times_s")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moment:
    """An observation with its pose, and all that later poses can be bridged from."""

    observation: Observation
    T_map_base: Transform | None  # None: it got no pose
    module: str  # that gave it, BRIDGED for none
    bridge: Bridge  # after the observation
    turn: NDArray[np.float64] | None  # (3, 3) since the moment before, as a believed module says
    is_trusted: bool  # a module that was not suspect said it was tracking, as sure as usual

    @property
    def stamp_ns(self) -> int:
        """Return when it was."""
        return self.observation.stamp_ns

    def bridged(self, T_map_base: Transform | None, bridge: Bridge) -> Moment:
        """Return the moment with a pose that no module gave."""
        return replace(self, T_map_base=T_map_base, module=BRIDGED, bridge=bridge, is_trusted=False)


class Memory:
    """The moments of the last while, bounded in time and in bytes.

    Where the bytes do not suffice, older moments lose their sensor data, so that those left lie
    apart in proportion to their age: a module that is led through them sees fewer images of long
    ago, and every moment still gets its pose.
    """

    def __init__(self, *, span_s: float, limit_mb: float, keeps_sensors: bool) -> None:
        self._span_ns, self._limit_bytes = round(span_s * 1e9), round(limit_mb * 1e6)
        self._keeps_sensors = keeps_sensors
        self._moments: deque[Moment] = deque()
        self._bytes = 0

    @property
    def newest(self) -> Moment:
        """Return the moment that was added last."""
        return self._moments[-1]

    def add(self, moment: Moment) -> None:
        """Remember a moment; forget what is too old."""
        self._moments.append(moment)
        self._bytes += _size(moment)
        while moment.stamp_ns - self._moments[0].stamp_ns > self._span_ns:
            self._bytes -= _size(self._moments.popleft())
        if not self._keeps_sensors and len(self._moments) > 1:
            self._strip(len(self._moments) - 2)
        elif self._bytes > self._limit_bytes:
            self._thin()

    def anchor(self, until_ns: int | None) -> Moment:
        """Return the newest trusted moment, not after `until_ns` if that is given.

        Where none is left, the oldest that has a pose; the very oldest where none has.
        """
        posed = [moment for moment in self._moments if moment.T_map_base is not None]
        for moment in reversed(posed):
            if moment.is_trusted and (until_ns is None or moment.stamp_ns <= until_ns):
                return moment
        return posed[0] if posed else self._moments[0]

    def after(self, stamp_ns: int) -> list[Moment]:
        """Return all moments after an instant."""
        return [moment for moment in self._moments if moment.stamp_ns > stamp_ns]

    def last_until(self, stamp_ns: int) -> Moment | None:
        """Return the newest moment up to an instant, None where it is forgotten."""
        until = (moment for moment in reversed(self._moments) if moment.stamp_ns <= stamp_ns)
        return next(until, None)

    def rewrite(self, moments: list[Moment]) -> None:
        """Put moments that are now better known in the place of all from the first of them on."""
        while self._moments and self._moments[-1].stamp_ns >= moments[0].stamp_ns:
            self._bytes -= _size(self._moments.pop())
        for moment in moments:
            self._moments.append(moment)
            self._bytes += _size(moment)

    def _thin(self) -> None:
        """Take the data of the moment that is missed least, until the rest fits."""
        full = [index for index, moment in enumerate(self._moments) if _size(moment)]
        stamps_ns = np.array([self._moments[index].stamp_ns for index in full], np.float64)
        while self._bytes > _THINNED_RATIO * self._limit_bytes and len(full) > 2:
            ages_ns = stamps_ns[-1] - stamps_ns[1:-1]
            missed = int(np.argmin((stamps_ns[2:] - stamps_ns[:-2]) / ages_ns)) + 1
            self._strip(full.pop(missed))
            stamps_ns = np.delete(stamps_ns, missed)

    def _strip(self, index: int) -> None:
        moment = self._moments[index]
        self._bytes -= _size(moment)
        observation = replace(
            moment.observation, image_bgr=None, depth_m=None, points_lidar=None, point_times_s=None
        )
        self._moments[index] = replace(moment, observation=observation)


def _size(moment: Moment) -> int:
    """Return the bytes of the sensor data that can be done without."""
    arrays = (getattr(moment.observation, name) for name in _BULKY)
    return sum(array.nbytes for array in arrays if array is not None)
