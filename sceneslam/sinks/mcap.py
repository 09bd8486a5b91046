"""Recording of a run as an MCAP file: observations and poses, for Foxglove and as a source."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

from sceneslam.ros.pixels import image_options
from sceneslam.ros.writer import ObservationWriter
from sceneslam.types.errors import ConfigError
from sceneslam.types.files import finish, new_file, part_of
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event, RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

_log = logging.getLogger(__name__)


class McapSink:
    """Writes observations, poses in `map`, active modules and, at the end, the map.

    With `image_format` png and every image and depth image, `source=mcap` reads the same
    observations from it; else it is for viewing only.
    """

    writes_files = True

    def __init__(
        self, path: str, image_format: str, jpeg_quality: int, image_every: int, depth_every: int
    ) -> None:
        image_options(image_format, jpeg_quality)  # refused before the run
        for key, every in (("image_every", image_every), ("depth_every", depth_every)):
            if every < 1:
                raise ConfigError(key, every, "a whole number of observations from 1")
        self._path, self._file = path, Path()
        self._image_format, self._jpeg_quality = image_format, jpeg_quality
        self._image_every, self._depth_every = image_every, depth_every
        self._images = self._depths = 0
        self._writer: ObservationWriter | None = None
        self._module = ""
        self._start_ns: int | None = None
        self._early: list[Event] = []  # before the first observation

    def open(self, rig: Rig, folder: Path) -> None:
        """Open the file, which gets its final name in `close`; a relative path is in `folder`."""
        self._file = new_file(folder, self._path)
        part = part_of(self._file)
        self._writer = ObservationWriter(
            part, rig=rig, image_format=self._image_format, jpeg_quality=self._jpeg_quality
        )
        self._images = self._depths = 0
        self._module = ""
        self._start_ns, self._early = None, []

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Add an observation, its pose if there is one, and the module if it changed."""
        if self._writer is None:
            return
        self._writer.write(self._thinned(observation))
        if T_map_base is not None:
            self._writer.write_pose(observation.stamp_ns, T_map_base)
        if module != self._module:
            self._writer.write_module(observation.stamp_ns, module)
            self._module = module
        if self._start_ns is None:
            self._start_ns = observation.stamp_ns
            self._write_early()

    def write_event(self, event: Event) -> None:
        """Add one event as JSON text; one from before the first observation, at its stamp."""
        if self._start_ns is None:
            self._early.append(event)
        elif self._writer is not None:
            text = json.dumps(dict(event), default=str)
            self._writer.write_event(max(int(event["stamp_ns"]), self._start_ns), text)

    def write_truth(self, truth: GroundTruth) -> None:
        """Add the ground truth, for the evaluation of later runs."""
        if self._writer is not None:
            self._writer.write_truth(truth)

    def write_result(self, result: RunResult) -> None:
        """Add the revised path, the grid and the points."""
        if self._writer is not None:
            self._writer.write_result(result)

    def close(self) -> None:
        """Close the file, and log its size."""
        if self._writer is not None:
            self._write_early()
            writer, self._writer = self._writer, None
            writer.close()
            finish(self._file)
            _log.info("%s: %.1f MB", self._file.name, self._file.stat().st_size / 1e6)

    def _write_early(self) -> None:
        early, self._early = self._early, []
        self._start_ns = self._start_ns or 0
        for event in early:
            self.write_event(event)

    def _thinned(self, observation: Observation) -> Observation:
        """Return the observation without the images that are not due."""
        if observation.image_bgr is not None:
            self._images += 1
            if self._images % self._image_every != 1 % self._image_every:
                observation = replace(observation, image_bgr=None)
        if observation.depth_m is not None:
            self._depths += 1
            if self._depths % self._depth_every != 1 % self._depth_every:
                observation = replace(observation, depth_m=None)
        return observation
