"""A person who walks back and forth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Walker:
    """A person as an upright cylinder, on a straight line at constant speed."""

    start_m: tuple[float, float]  # frame gt
    end_m: tuple[float, float]
    group: str  # lamp group at this position
    light: float  # irradiance from all around; 1: white is white in the image
    speed_mps: float = 0.7
    radius_m: float = 0.2
    height_m: float = 1.72

    def position_m(self, time_s: float) -> NDArray[np.float64]:
        """Return the person's position (2,) [m] in `gt`."""
        start, end = np.array(self.start_m), np.array(self.end_m)
        length_m = float(np.linalg.norm(end - start))
        along = self.speed_mps * time_s / length_m % 2.0  # 0..1 forth, 1..2 back
        return np.asarray(start + min(along, 2.0 - along) * (end - start))
