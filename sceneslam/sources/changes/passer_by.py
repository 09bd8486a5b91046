"""A person who walks through the view of any camera: what moves is not the room."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import Source
from sceneslam.ros.pixels import locked
from sceneslam.sources.changes.wrapped import Wrapped, check_sensor
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_inside, check_least
from sceneslam.types.rig import Camera, Sensor

_MOST_M = 20.0
_TEXEL_M = 0.01
_GRAINS = (2, 8, 32)  # texels, of the pattern's layers: seams, folds, pieces of clothing
_CONTRAST = 20.0  # grey values (sigma), of each layer: alike in every octave, as in nature
_GREY = 110.0


class PasserBy(Wrapped):
    """Passes on a source's observations; an upright, patterned plane crosses the camera's view.

    It is `width_m` x `height_m`, `distance_m` before the camera and moves with `speed_mps` from
    side to side, relative to the camera, with `pause_s` between two crossings; it hides what is
    behind it, in image and depth. The pattern is drawn from the seed. A laser does not see it, and
    a lens does not bend it.
    """

    def __init__(
        self,
        source: Source,
        width_m: float,
        height_m: float,
        distance_m: float,
        speed_mps: float,
        pause_s: float,
        seed: int,
    ) -> None:
        check_inside(0.0, _MOST_M, width_m=width_m, height_m=height_m)
        check_inside(0.0, _MOST_M, distance_m=distance_m, speed_mps=speed_mps)
        check_least(0.0, pause_s=pause_s)
        check_least(0, seed=seed)
        check_sensor(source, Sensor.IMAGE, effects="passer_by")
        super().__init__(source)
        self._size_m, self._distance_m = (width_m, height_m), distance_m
        self._speed_mps, self._pause_s, self._seed = speed_mps, pause_s, seed

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations with the plane in their images."""
        camera, pattern = self.rig.camera, self._pattern()
        if camera is None:
            raise InputError("effects=passer_by needs the camera's intrinsics, got none")
        start_ns: int | None = None
        for observation in self._source:
            start_ns = observation.stamp_ns if start_ns is None else start_ns
            image_bgr = observation.image_bgr
            pictures = [one for one in (image_bgr, observation.depth_m) if one is not None]
            # One of another size is left out later, which says so.
            if image_bgr is None or any(one.shape[1::-1] != camera.size_wh for one in pictures):
                yield observation
                continue
            left_m = self._left_m(camera, (observation.stamp_ns - start_ns) * 1e-9)
            shown, inside = self._shown(camera, pattern, left_m)
            depth_m = observation.depth_m
            if depth_m is not None:
                inside &= ~((depth_m > 0) & (depth_m < self._distance_m))
                depth_m = locked(np.where(inside, np.float32(self._distance_m), depth_m))
            image_bgr = locked(np.where(inside[:, :, None], shown, image_bgr))
            yield replace(observation, image_bgr=image_bgr, depth_m=depth_m)

    def _left_m(self, camera: Camera, time_s: float) -> float:
        """Return where the plane's left edge is, to the right of the camera's axis."""
        width_m = self._size_m[0]
        reach_m = camera.size_wh[0] / camera.fx * self._distance_m  # of the view, there
        crossing_s = (reach_m + width_m) / self._speed_mps
        crossings, since_s = divmod(time_s, crossing_s + self._pause_s)
        way_m = min(since_s, crossing_s) * self._speed_mps
        if crossings % 2:
            way_m = reach_m + width_m - way_m
        return way_m - width_m - camera.cx / camera.fx * self._distance_m

    def _shown(
        self, camera: Camera, pattern: NDArray[np.uint8], left_m: float
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the plane's image (H, W, 3), and (H, W) where it is."""
        scale = np.array([camera.fx, camera.fy]) / self._distance_m
        corner_px = np.array([left_m, -0.5 * self._size_m[1]]) * scale + [camera.cx, camera.cy]
        to_image = np.column_stack([np.diag(scale * _TEXEL_M), corner_px])
        width, height = camera.size_wh
        shown = cv2.warpAffine(pattern, to_image, (width, height), borderMode=cv2.BORDER_REPLICATE)
        u, v = np.arange(width), np.arange(height)
        end_px = corner_px + self._size_m * scale
        rows = (v > corner_px[1]) & (v < end_px[1])
        columns = (u > corner_px[0]) & (u < end_px[0])
        return np.asarray(shown, np.uint8), np.outer(rows, columns)

    def _pattern(self) -> NDArray[np.uint8]:
        """Return the plane's pattern (rows, columns, 3) with details of several sizes."""
        rng = np.random.default_rng([self._seed, 11])
        columns, rows = (max(1, round(size_m / _TEXEL_M)) for size_m in self._size_m)
        texels = np.full((rows, columns), _GREY, np.float32)
        for grain in _GRAINS:
            coarse = rng.normal(0.0, _CONTRAST, (rows // grain + 2, columns // grain + 2))
            texels += cv2.resize(
                coarse.astype(np.float32), (columns, rows), interpolation=cv2.INTER_CUBIC
            )
        grey = np.clip(texels, 0, 255).astype(np.uint8)
        return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
