"""The run as an MCAP file: what the robot saw and where it was, for Foxglove and for re-runs."""

from __future__ import annotations

import json
from pathlib import Path

from sceneslam.ros.writer import ObservationWriter
from sceneslam.types.errors import ConfigError
from sceneslam.types.files import finish, part_of
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth


class McapSink:
    """Writes observations, poses in `map` and active modules; read back by `source=mcap`."""

    def __init__(self, path: str, image_format: str) -> None:
        if image_format not in ("jpeg", "png"):
            raise ConfigError("image_format", image_format, "jpeg or png")
        self._path = self._file = Path(path)
        self._image_format = image_format
        self._writer: ObservationWriter | None = None
        self._module = ""

    def open(self, rig: Rig, folder: Path) -> None:
        """Begin the file, which gets its name by `close`; a relative path is one in `folder`."""
        self._file = folder / self._path
        self._file.parent.mkdir(parents=True, exist_ok=True)
        part = part_of(self._file)
        self._writer = ObservationWriter(part, rig=rig, image_format=self._image_format)
        self._module = ""

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Add one observation, its pose where there is one, and the module when it changes."""
        if self._writer is None:
            return
        self._writer.write(observation)
        if T_map_base is not None:
            self._writer.write_pose(observation.stamp_ns, T_map_base)
        if module != self._module:
            self._writer.write_module(observation.stamp_ns, module)
            self._module = module

    def write_event(self, event: Event) -> None:
        """Add one event as JSON text."""
        if self._writer is not None:
            text = json.dumps(dict(event), default=str)
            self._writer.write_event(int(event["stamp_ns"]), text)

    def write_truth(self, truth: GroundTruth) -> None:
        """Add what is known to be true, so that a re-run can be measured as well."""
        if self._writer is not None:
            self._writer.write_truth(truth)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()
            finish(self._file)
