"""Decoding of images and depth images, and how images are written."""

from __future__ import annotations

from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError

Scalar = TypeVar("Scalar", bound=np.generic)

_FORMATS = (  # what a file begins with, what is before its pixels, and before its end
    (b"\x89PNG", b"IDAT", b"IEND"),
    (b"\xff\xd8", b"\xff\xda", b"\xff\xd9"),  # JPEG
)


def decode(data: bytes, flags: int) -> NDArray[Any] | None:
    """Return the pixels of an image file (JPEG, PNG, ...), None if it is damaged or cut off.

    `flags` are OpenCV's: IMREAD_COLOR for BGR, IMREAD_UNCHANGED for the stored format. Bytes after
    the image's end are passed over: drivers pad their images, and cameras add notes to them.
    """
    if not data or any(_is_cut(data, *marks) for marks in _FORMATS):
        return None
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        return None
    return None if pixels is None else np.asarray(pixels)


def decode_bgr(data: bytes) -> NDArray[np.uint8] | None:
    """Return the image (H, W, 3) uint8 BGR of a file's bytes, None if it is damaged."""
    pixels = decode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if pixels is None else locked(pixels)


def _is_cut(data: bytes, begin: bytes, scan: bytes, end: bytes) -> bool:
    """Tell whether a file of this format has pixels without an end; a thumbnail has its own."""
    if not data.startswith(begin):
        return False
    at = data.rfind(end)
    return at < 0 or scan in data[at:]


def image_options(image_format: str, jpeg_quality: int) -> list[int]:
    """Return OpenCV's options for images to be written, jpeg or png.

    Raises ConfigError if the format is another one or the quality not 1 to 100.
    """
    if image_format not in ("jpeg", "png"):
        raise ConfigError("image_format", image_format, "jpeg or png")
    if not 1 <= jpeg_quality <= 100:
        raise ConfigError("jpeg_quality", jpeg_quality, "1 to 100")
    return [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if image_format == "jpeg" else []


def locked(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Make the array (...) of any shape read-only and return it."""
    array.flags.writeable = False
    return array


class DepthUnits:
    """Converts stored depth to metres; values that are out of range or not finite become 0."""

    def __init__(self, units_per_m: float, range_m: tuple[float, float]) -> None:
        self._low_m, self._high_m = np.float32(range_m[0]), np.float32(range_m[1])
        count = np.arange(1 << 16, dtype=np.float32)
        self._table_m = self._cut(count / np.float32(units_per_m))

    @classmethod
    def unlimited(cls, units_per_m: float) -> DepthUnits:
        """Return units without a range limit; only the largest integer means "missing"."""
        units = cls(units_per_m, (0.0, float("inf")))
        units._table_m[-1] = 0.0
        return units

    def of_integers(self, stored: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] of integer units."""
        return locked(np.take(self._table_m, stored))

    def of_metres(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] with NaN and infinity as missing (REP-118)."""
        return locked(self._cut(depth_m))

    def _cut(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        is_good = (depth_m >= self._low_m) & (depth_m <= self._high_m)
        return np.where(is_good, depth_m, np.float32(0)).astype(np.float32, copy=False)
