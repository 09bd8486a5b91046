"""The data of one observation that the module's parts share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

from ..map.keyframes import OdometryPose
from .features import Features
from .shutter import Turning

_FEWEST = 50  # features (with depth, if required) that a keyframe needs


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """An observation with the features of its image."""

    observation: Observation
    image_bgr: NDArray[np.uint8]  # (H, W, 3)
    features: Features
    T_predicted: Transform  # T_local_base, before the image is used
    turning: Turning
    odometry: OdometryPose | None

    @property
    def shows_enough(self) -> bool:
        """Tell whether the image has enough features to begin a map."""
        return len(self.features) >= _FEWEST

    @property
    def is_monocular(self) -> bool:
        """Tell whether depth is missing or not used."""
        return self.features.deep_count < _FEWEST

    @property
    def depth_m(self) -> NDArray[np.float32] | None:
        """Return the depth image (H, W) [m], None if it is not usable."""
        return None if self.is_monocular else self.observation.depth_m
