"""Colour and depth images in files, as observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import pixels
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFiles:
    """Paths of the images of one stamp."""

    stamp_ns: int
    color: Path
    depth: Path | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReadFrame:
    """An observation (None if no image could be read) and its problems with their files."""

    observation: Observation | None
    problems: Mapping[str, Path]


class FrameReader:
    """Reads images; thread-safe."""

    def __init__(self, size_wh: tuple[int, int], units: pixels.DepthUnits) -> None:
        self._size_wh = size_wh
        self._units = units
        self._has_depth = False  # True after the first depth image of the first colour image's size

    def read(self, frame: FrameFiles) -> ReadFrame:
        """Return the frame's observation; an image of another size is treated as damaged.

        Raises InputError for depth that is not 16 bit, or if the first one has another size.
        """
        problems: dict[str, Path] = {}
        image_bgr = self._image(frame.color, problems)
        depth_m = None if frame.depth is None else self._depth(frame.depth, problems)
        if image_bgr is None and depth_m is None:
            return ReadFrame(observation=None, problems=problems)
        observation = Observation(stamp_ns=frame.stamp_ns, image_bgr=image_bgr, depth_m=depth_m)
        return ReadFrame(observation=observation, problems=problems)

    def depth_m(self, path: Path) -> NDArray[np.float32] | None:
        """Return a depth image (H, W) [m], None if unreadable; raises InputError as `read`."""
        return self._depth(path, {})

    def _image(self, path: Path, problems: dict[str, Path]) -> NDArray[np.uint8] | None:
        data = _bytes(path, "colour image is missing", problems)
        image_bgr = None if data is None else pixels.decode_bgr(data)
        if image_bgr is None:
            if data is not None:
                problems["colour image is damaged"] = path
            return None
        return image_bgr if self._has_size(path, image_bgr, problems) else None

    def _depth(self, path: Path, problems: dict[str, Path]) -> NDArray[np.float32] | None:
        data = _bytes(path, "depth image is missing", problems)
        stored = None if data is None else pixels.decode(data, cv2.IMREAD_UNCHANGED)
        if stored is None:
            if data is not None:
                problems["depth image is damaged"] = path
            return None
        if stored.dtype != np.uint16 or stored.ndim != 2:
            channels = 1 if stored.ndim == 2 else stored.shape[2]
            raise InputError(
                f"depth image: expected 16 bit in one channel, got {8 * stored.itemsize} bit "
                f"in {channels}: {path}"
            )
        if not self._has_size(path, stored, problems):
            if not self._has_depth:  # then all depth images have another size
                raise InputError(f"depth: {next(reversed(problems))}: {path}")
            return None
        self._has_depth = True
        return self._units.of_integers(stored)

    def _has_size(
        self, path: Path, picture: NDArray[np.generic], problems: dict[str, Path]
    ) -> bool:
        height, width = picture.shape[:2]
        expected = f"{self._size_wh[0]}x{self._size_wh[1]}"
        if (width, height) != self._size_wh:
            problems[f"image left out, it has {width}x{height} pixels, not {expected}"] = path
        return (width, height) == self._size_wh


def first_size_wh(frames: Iterable[FrameFiles]) -> tuple[int, int]:
    """Return width and height [px] of the first readable colour image, else raise InputError."""
    last = Path()
    for frame in frames:
        data = _bytes(frame.color, "", {})
        image_bgr = None if data is None else pixels.decode_bgr(data)
        if image_bgr is not None:
            return int(image_bgr.shape[1]), int(image_bgr.shape[0])
        last = frame.color
    raise InputError(f"none of the colour images can be read, the last being: {last}")


def _bytes(path: Path, problem: str, problems: dict[str, Path]) -> bytes | None:
    try:
        if path.is_file():  # not a pipe: reading one may block forever
            return path.read_bytes()
        problems[problem] = path
        return None
    except OSError:
        problems[problem] = path
        return None
