"""What the module works on for the time of one observation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

from .features import Features


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """An observation with what was found in its image."""

    observation: Observation
    gray: NDArray[np.uint8]  # (H, W)
    features: Features
    T_predicted: Transform  # T_local_base, before the image was asked
