"""Local bundle adjustment beside the tracking, its result merged at fixed images."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .bundle import Adjusted, adjust
from .visual_map import VisualMap
from .window import Window, merge_window, take_window


class LocalMapping:
    """Adjusts the newest keyframes and their landmarks, every so many images.

    A worker has all images between two merges to do it; a merge waits for it, so that what the
    map is at an image depends on the images alone.
    """

    def __init__(self, camera: Camera, visual_map: VisualMap, *, every_images: int) -> None:
        self._camera, self._map, self._every = camera, visual_map, every_images
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="rgbd-mapping")
        self._window: Window | None = None
        self._result: Future[Adjusted] | None = None
        self._images, self._newest = 0, -1

    def step(self) -> Transform:
        """Count an image; merge what is due and begin what is next.

        Returns T_new_old, by which the newest keyframe and what is near it were moved.
        """
        self._images += 1
        if self._images % self._every:
            return se3.identity()
        T_new_old = self._merge()
        newest = max(self._map.keyframes.ids, default=-1)
        if newest != self._newest:
            self._newest = newest
            self._window = take_window(self._map, newest)
            if self._window is not None:
                self._result = self._worker.submit(adjust, self._camera, self._window.bundle)
        return T_new_old

    def shutdown(self) -> None:
        """End the worker; what it was at is not merged."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _merge(self) -> Transform:
        window, result = self._window, self._result
        self._window = self._result = None
        if window is None or result is None:
            return se3.identity()
        return merge_window(self._map, window, result.result())
