"""Local bundle adjustment in a worker; results are merged some images later."""

from __future__ import annotations

from concurrent.futures import Future

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from ..map.visual_map import VisualMap
from ..see.alignment import Alignment
from ..see.alignment_search import Shown
from ..see.cores import Here, worker_beside
from ..see.side_process import SideProcess
from ..see.view import View
from .mapping_work import MappingResult, MappingWork, Task
from .window import MapWindow, merge_window, take_window

_Worker = SideProcess[Task, MappingResult] | Here[Task, MappingResult]
_TIED_IMAGES = 10  # between merges with depth, whose registration takes 100 to 200 ms
_FREE_IMAGES = 5  # without depth: triangulated landmarks need it early, as they drift in scale
_BEGINNING = 16  # first views, kept to rebuild the map: 2.1 MB each


class LocalMapping:
    """Adjusts the newest keyframes and their landmarks at fixed intervals of images.

    A worker does it between two merges. If `is_repeatable`, a merge waits for the worker, so that
    the map at an image depends on the images alone; else it is put off, as a robot cannot wait.
    """

    def __init__(
        self,
        depth_camera: Camera,
        visual_map: VisualMap,
        *,
        alignment: Alignment | None,
        is_repeatable: bool,
    ) -> None:
        self._is_repeatable = is_repeatable
        self._map, self._depth_camera, self._known = visual_map, depth_camera, alignment
        self._worker: _Worker | None = None
        self._window: MapWindow | None = None
        self._result: Future[MappingResult] | None = None
        self._images_left, self._newest = _FREE_IMAGES, -1
        self._fresh: dict[int, Shown] = {}  # keyframes that the worker has not received yet
        self._is_aligned = alignment is not None
        self.alignment: Alignment | None = None  # if it differs from the assumed one
        self.beginning: dict[int, View] = {}  # by keyframe id, until that is known

    def insert(self, keyframe_id: int, view: View) -> None:
        """Add a new keyframe's view; without depth it gets no relative-pose constraint."""
        self._process()
        if not self._is_aligned:
            self.beginning[keyframe_id] = view
            if len(self.beginning) > _BEGINNING:
                del self.beginning[min(self.beginning)]
        if view.depth_m is not None:
            self._fresh[keyframe_id] = Shown(features=view.features, depth_m=view.depth_m)

    def step(self) -> Transform:
        """Count an image; merge a finished task and begin the next when they are due.

        Returns T_new_old (4, 4), the correction of the newest keyframe and its surroundings.
        """
        self._images_left = max(self._images_left - 1, 0)
        if self._images_left or self._is_late():
            return se3.identity()
        self._images_left = _FREE_IMAGES
        T_new_old = self._merge()
        newest = max(self._map.keyframes.ids, default=-1)
        if newest != self._newest:
            self._newest = newest
            self._window = take_window(self._map, newest, self._fresh)
            if self._window is not None:
                self._images_left = _TIED_IMAGES if self._fresh else _FREE_IMAGES
                self._fresh = {}
                self._result = self._process().submit(self._window.task)
        return T_new_old

    def shutdown(self) -> None:
        """End the worker; its pending task is not merged."""
        if self._worker is not None:
            self._worker.end()

    def _is_late(self) -> bool:
        """Tell whether a merge is due, and put off because the worker is not done."""
        return not (self._is_repeatable or self._result is None or self._result.done())

    def _merge(self) -> Transform:
        window, result = self._window, self._result
        self._window = self._result = None
        if window is None or result is None:
            return se3.identity()
        outcome = result.result()
        self.alignment, self._is_aligned = outcome.alignment, outcome.is_aligned
        if self._is_aligned and self.alignment is None:
            self.beginning.clear()
        return merge_window(self._map, window, outcome.adjusted)

    def _process(self) -> _Worker:
        """Return the worker; it starts with the first keyframe, to be ready when it is needed."""
        if self._worker is None:
            self._worker = worker_beside(
                MappingWork, self._map.camera, self._depth_camera, self._known
            )
        return self._worker
