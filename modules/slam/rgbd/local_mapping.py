"""Local bundle adjustment beside the tracking, its result merged at fixed images."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .alignment import Alignment
from .alignment_search import AlignmentSearch, Shown, pair_of
from .bundle import Adjusted, adjust
from .ties import DepthTies, Tie, Ties
from .view import View
from .visual_map import VisualMap
from .window import Window, merge_window, take_window

_TIED_IMAGES = 10  # for what has depth: registering it takes the worker 100 to 200 ms
_FREE_IMAGES = 5  # for what has none: triangulated landmarks wait for it, and drift in scale


class LocalMapping:
    """Adjusts the newest keyframes and their landmarks, every so many images.

    A worker has all images between two merges to do it; a merge waits for it, so that what the
    map is at an image depends on the images alone. How many these are depends on its work.
    """

    def __init__(
        self,
        depth_camera: Camera,
        visual_map: VisualMap,
        *,
        alignment: Alignment | None,
    ) -> None:
        self._camera, self._map = visual_map.camera, visual_map
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="rgbd-mapping")
        self._window: Window | None = None
        self._result: Future[Adjusted] | None = None
        self._images_left, self._newest = _FREE_IMAGES, -1
        self._fresh: dict[int, Shown] = {}  # keyframes that the worker has not seen yet
        T_depth_cam = (alignment or Alignment()).T_depth_color
        self._depth_ties = DepthTies(depth_camera, T_depth_cam)  # the worker's own
        self._search = AlignmentSearch(depth_camera, is_over=alignment is not None)  # its too
        self._searched: dict[int, Shown] = {}  # its too
        self._found: Alignment | None = None  # by the worker; told at a merge, a fixed image
        self.alignment: Alignment | None = None  # where it was found not to be what was taken
        self._ties: dict[tuple[int, int], Tie] = {}  # by keyframe ids; the worker's own

    def insert(self, keyframe_id: int, view: View) -> None:
        """Take what a new keyframe shows; without depth it is tied to none."""
        if view.depth_m is not None:
            self._fresh[keyframe_id] = Shown(features=view.features, depth_m=view.depth_m)

    def step(self) -> Transform:
        """Count an image; merge what is due and begin what is next.

        Returns T_new_old, by which the newest keyframe and what is near it were moved.
        """
        self._images_left -= 1
        if self._images_left:
            return se3.identity()
        self._images_left = _FREE_IMAGES
        T_new_old = self._merge()
        newest = max(self._map.keyframes.ids, default=-1)
        if newest != self._newest:
            self._newest = newest
            self._window = take_window(self._map, newest)
            if self._window is not None:
                fresh, self._fresh = self._fresh, {}
                self._images_left = _TIED_IMAGES if fresh else _FREE_IMAGES
                self._result = self._worker.submit(self._adjust, self._window, fresh)
        return T_new_old

    def shutdown(self) -> None:
        """End the worker; what it was at is not merged."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _adjust(self, window: Window, fresh: Mapping[int, Shown]) -> Adjusted:
        """Return the window adjusted; runs in the worker."""
        for keyframe_id, shown in fresh.items():
            self._depth_ties.look(keyframe_id, shown.depth_m)
            if not self._search.is_over:
                self._searched[keyframe_id] = shown
        poses = dict(zip(window.keyframe_ids, window.bundle.T_local_cam, strict=True))
        for other in sorted(fresh.keys() & poses.keys()):
            for one in window.free_ids:
                if one < other:
                    T_one_other = se3.inverse(poses[one]) @ poses[other]
                    tie = self._depth_ties.tie(one, other, T_one_other)
                    if tie is not None:
                        self._ties[one, other] = tie
                        self._compare(one, other, tie)
        rows = {keyframe_id: row for row, keyframe_id in enumerate(window.keyframe_ids)}
        ties = {
            (rows[one], rows[other]): tie
            for (one, other), tie in self._ties.items()
            if one in rows and other in rows
        }
        return adjust(self._camera, replace(window.bundle, ties=Ties.of(ties)))

    def _compare(self, one: int, other: int, tie: Tie) -> None:
        """Ask the colours of two keyframes whether they are the depth camera's."""
        if one in self._searched and other in self._searched:
            here, there = self._searched[one], self._searched[other]
            found = self._search.add(pair_of(here, there, se3.inverse(tie.T_one_other)))
            self._found = found or self._found
        if self._search.is_over:
            self._searched.clear()

    def _merge(self) -> Transform:
        window, result = self._window, self._result
        self._window = self._result = None
        if window is None or result is None:
            return se3.identity()
        adjusted = result.result()
        self.alignment = self._found
        return merge_window(self._map, window, adjusted)
