"""Small images of the camera at changes of scene or module."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sceneslam.evaluation.report.moments import change_of
from sceneslam.types.observation import Observation
from sceneslam.types.run import Event, KeyMoment

_WIDTH_PX = 240
_MOST = 24  # stored images


class Moments:
    """The first image, and one for every change of scene or module."""

    def __init__(self) -> None:
        self.kept: list[KeyMoment] = []

    def look(self, observation: Observation, events: Sequence[Event]) -> None:
        """Store the observation's image if one of its events is a change."""
        image_bgr = observation.image_bgr
        if image_bgr is None or image_bgr.dtype != np.uint8 or len(self.kept) == _MOST:
            return
        changes = tuple(event for event in events if change_of(event))
        if changes or not self.kept:
            height, width = image_bgr.shape[:2]
            size = (_WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))
            small = cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA)
            self.kept.append(
                KeyMoment(
                    stamp_ns=observation.stamp_ns,
                    events=changes,
                    image_bgr=np.asarray(small, np.uint8),
                )
            )
