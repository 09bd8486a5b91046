"""Colour and depth images in files, as observations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import pixels
from sceneslam.sources.survey.survey import spread
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation

SAMPLES = 8  # images of a kind that are read before a run

_as_stored = partial(pixels.decode, flags=cv2.IMREAD_UNCHANGED)


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

    def read(self, frame: FrameFiles) -> ReadFrame:
        """Return the frame's observation; an image of another kind is treated as damaged."""
        problems: dict[str, Path] = {}
        image_bgr = self._image(frame.color, problems)
        depth_m = None if frame.depth is None else self._depth(frame.depth, problems)
        if image_bgr is None and depth_m is None:
            return ReadFrame(observation=None, problems=problems)
        observation = Observation(stamp_ns=frame.stamp_ns, image_bgr=image_bgr, depth_m=depth_m)
        return ReadFrame(observation=observation, problems=problems)

    def depth_m(self, path: Path) -> NDArray[np.float32] | None:
        """Return a depth image (H, W) [m], None if it is unreadable or of another kind."""
        return self._depth(path, {})

    def check_depth(self, paths: Iterable[Path]) -> None:
        """Raise InputError if all depth images that can be read are of another kind."""
        odd = ""
        for path in paths:
            stored = _decoded(path, "", _as_stored, {})
            if stored is None:
                continue
            kind = self._odd_depth(stored)
            if not kind:
                return
            odd = odd or f"{kind}: {path}"
        if odd:
            raise InputError(f"depth: no image that was looked at fits, the first has {odd}")

    def _image(self, path: Path, problems: dict[str, Path]) -> NDArray[np.uint8] | None:
        image_bgr = _decoded(path, "colour image", pixels.decode_bgr, problems)
        if image_bgr is None:
            return None
        if kind := self._odd_size(image_bgr):
            problems[f"image left out, it has {kind}"] = path
            return None
        return image_bgr

    def _depth(self, path: Path, problems: dict[str, Path]) -> NDArray[np.float32] | None:
        stored = _decoded(path, "depth image", _as_stored, problems)
        if stored is None:
            return None
        if kind := self._odd_depth(stored):
            problems[f"image left out, it has {kind}"] = path
            return None
        return self._units.of_integers(stored)

    def _odd_depth(self, stored: NDArray[np.generic]) -> str:
        """Return what a depth image has that none should have, "" if it is right."""
        if stored.dtype != np.uint16 or stored.ndim != 2:
            channels = 1 if stored.ndim == 2 else stored.shape[2]
            return f"{8 * stored.itemsize} bit in {channels}, not 16 bit in one channel"
        return self._odd_size(stored)

    def _odd_size(self, stored: NDArray[np.generic]) -> str:
        height, width = stored.shape[:2]
        if (width, height) == self._size_wh:
            return ""
        return f"{width}x{height} pixels, not {self._size_wh[0]}x{self._size_wh[1]}"


def usual_size_wh(frames: Sequence[FrameFiles]) -> tuple[int, int]:
    """Return width and height [px] of most of some colour images, from the first to the last.

    If none of them can be read it is that of the first that can; raises InputError without one.
    """
    sampled = Counter(filter(None, (_size_wh(frames[at]) for at in spread(len(frames), SAMPLES))))
    if sampled:
        return sampled.most_common(1)[0][0]
    for frame in frames:
        if size_wh := _size_wh(frame):
            return size_wh
    raise InputError(f"none of the colour images can be read, the last being: {frames[-1].color}")


def _size_wh(frame: FrameFiles) -> tuple[int, int] | None:
    image_bgr = _decoded(frame.color, "", pixels.decode_bgr, {})
    return None if image_bgr is None else (image_bgr.shape[1], image_bgr.shape[0])


def _decoded(
    path: Path,
    name: str,
    decode: Callable[[bytes], NDArray[Any] | None],
    problems: dict[str, Path],
) -> NDArray[Any] | None:
    """Return the pixels of a file, None if it is missing or damaged, as `problems` then says."""
    data = _bytes(path, f"{name} is missing", problems)
    stored = None if data is None else decode(data)
    if data is not None and stored is None:
        problems[f"{name} is damaged"] = path
    return stored


def _bytes(path: Path, problem: str, problems: dict[str, Path]) -> bytes | None:
    try:
        if path.is_file():  # not a pipe: reading one may block forever
            return path.read_bytes()
        problems[problem] = path
        return None
    except OSError:
        problems[problem] = path
        return None
