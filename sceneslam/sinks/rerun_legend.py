"""A legend of the modules' colours as an image, since the Rerun viewer has no legend."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

_ROW_PX, _WIDTH_PX = 32, 320
_TEXT_RGB = (230, 230, 230)


def legend(colors: Mapping[str, tuple[int, int, int]]) -> NDArray[np.uint8]:
    """Return an image (H, W, 3) RGB with one line per name, in the order of the table."""
    picture = np.zeros((_ROW_PX * max(len(colors), 1), _WIDTH_PX, 3), np.uint8)
    for row, (name, color) in enumerate(colors.items()):
        top, bottom = row * _ROW_PX + 8, (row + 1) * _ROW_PX - 8
        cv2.rectangle(picture, (8, top), (40, bottom), color, thickness=-1)
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(picture, name, (52, bottom), font, 0.6, _TEXT_RGB, 1, cv2.LINE_AA)
    return picture
