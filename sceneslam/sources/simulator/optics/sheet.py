"""Texture atlas: many small images on one large one, for one look-up over all panels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8] | NDArray[np.float32]

_BORDER = 1  # repeats a block's edge, so that interpolation does not reach the next block


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sheet:
    """The position of each block on the sheet, without its border."""

    shape: tuple[int, int]  # rows, columns
    left_top: NDArray[np.int64]  # (N, 2)
    size_wh: NDArray[np.int64]  # (N, 2)

    def window(self, index: int) -> tuple[slice, slice]:
        """Return the slices (rows, columns) of a block."""
        (left, top), (wide, high) = self.left_top[index], self.size_wh[index]
        return slice(top, top + high), slice(left, left + wide)

    def paste(self, canvas: Pixels, index: int, block: Pixels) -> None:
        """Copy a block with its border to a canvas of the sheet's shape."""
        rows, columns = self.window(index)
        area = canvas[
            rows.start - _BORDER : rows.stop + _BORDER,
            columns.start - _BORDER : columns.stop + _BORDER,
        ]
        area[:] = cv2.copyMakeBorder(block, *(_BORDER,) * 4, cv2.BORDER_REPLICATE)

    def lookup(self) -> NDArray[np.float32]:
        """Return (2 N, 4), coefficients a, b, c, d of each triangle: x = a + b u, y = c + d v.

        x and y are OpenCV's pixel coordinates (centres at integers), u and v are barycentric; the
        second triangle of a block is the first one rotated by 180 degrees.
        """
        start, size = self.left_top - 0.5, self.size_wh
        upper = np.stack([start[:, 0], size[:, 0], start[:, 1], size[:, 1]], axis=1)
        ends = start + size
        lower = np.stack([ends[:, 0], -size[:, 0], ends[:, 1], -size[:, 1]], axis=1)
        return np.stack([upper, lower], axis=1).reshape(-1, 4).astype(np.float32)


def pack(size_wh: NDArray[np.int64], columns: int) -> Sheet:
    """Return positions of blocks (N, 2) [px] on a sheet `columns` wide: in rows, highest first."""
    left_top = np.zeros_like(size_wh)
    left, top, row_height = 0, 0, 0
    columns = max(columns, int(size_wh[:, 0].max()) + 2 * _BORDER)
    for index in np.argsort(-size_wh[:, 1], kind="stable"):
        wide, high = size_wh[index] + 2 * _BORDER
        if left + wide > columns:
            left, top, row_height = 0, top + row_height, 0
        left_top[index] = left + _BORDER, top + _BORDER
        left, row_height = left + wide, max(row_height, high)
    return Sheet(shape=(int(top + row_height), columns), left_top=left_top, size_wh=size_wh)
