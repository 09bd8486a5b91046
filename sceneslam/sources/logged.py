"""Recordings whose stamps are not the times of measurement."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


@runtime_checkable
class Logged(Protocol):
    """A recording whose observations have other stamps than the recording itself.

    Files of trajectories have the recording's stamps, by which others compare them.
    """

    def logged_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the recording's stamps (N,) of observations with `stamps_ns` (N,)."""
        ...
