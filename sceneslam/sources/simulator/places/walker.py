"""A person who walks to and fro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Walker:
    """A person, about an upright cylinder, on a straight line at a constant speed."""

    start_m: tuple[float, float]  # frame gt
    end_m: tuple[float, float]
    group: str  # of the lamps that shine there
    light: float  # on the person from all around, in units of what the camera shows as white
    speed_mps: float = 0.7
    radius_m: float = 0.2
    height_m: float = 1.72

    def position_m(self, time_s: float) -> NDArray[np.float64]:
        """Return where the person is (2,) in gt."""
        start, end = np.array(self.start_m), np.array(self.end_m)
        length_m = float(np.linalg.norm(end - start))
        along = self.speed_mps * time_s / length_m % 2.0  # 0..1 there, 1..2 back
        return np.asarray(start + min(along, 2.0 - along) * (end - start))
