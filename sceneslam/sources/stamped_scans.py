"""What the recordings of scans with known stamps have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.faults import FaultLog
from sceneslam.sources.spanned import TimeSpan
from sceneslam.types.rig import Rig


class StampedScans:
    """A recording of scans; `stamps_ns` (N,) rise."""

    def __init__(self, rig: Rig, stamps_ns: NDArray[np.int64]) -> None:
        self._rig, self._stamps_ns, self._faults = rig, stamps_ns, FaultLog()

    @property
    def rig(self) -> Rig:
        """Return the sensors on the robot."""
        return self._rig

    @property
    def length(self) -> int | None:
        """Return the number of scans."""
        return len(self._stamps_ns)

    @property
    def faults(self) -> Sequence[str]:
        """Return what could not be read."""
        return self._faults.sentences()

    @property
    def span(self) -> TimeSpan | None:
        """Return the first and last stamp."""
        return TimeSpan(start_ns=int(self._stamps_ns[0]), end_ns=int(self._stamps_ns[-1]))
