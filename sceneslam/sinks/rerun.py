"""A run in the Rerun viewer: as a recording `run.rrd`, or live while it runs."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneslam.sinks import rerun_layout as at
from sceneslam.sinks.rerun_end import write_end
from sceneslam.sinks.rerun_legend import legend
from sceneslam.sinks.rerun_sensors import SensorLog
from sceneslam.sinks.rerun_viewer import Viewer
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.files import finish, new_file, part_of
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event, RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

if TYPE_CHECKING:
    import rerun as rr

_LEVELS = {
    **dict.fromkeys(("scene", "decision", "handover", "revised", "tracking"), "INFO"),
    **dict.fromkeys(("refused", "suspect"), "WARN"),
    **dict.fromkeys(("fault", "dropped"), "ERROR"),
}


_MAP_COLORS = {"modules": at.BY_MODULE, "true": at.AS_SEEN}


class RerunSink:
    """Logs a run. The trajectory is logged in increments, so that the cost per pose is constant."""

    def __init__(
        self,
        path: str | None,
        *,
        viewer: Viewer | None,
        required: bool,
        image_every: int,
        depth_every: int,
        scan_every: int,
        jpeg_quality: int,
        map_colors: str,
    ) -> None:
        """Prepare to write to the file `path`, or to a viewer.

        `map_colors`: initial colours of the map, modules (one per module) or true (the camera's).

        Without the extra `rerun` nothing is written, or, if it is `required`, ConfigError names the
        extra to install.
        """
        if (path is None) == (viewer is None):
            raise ConfigError("path", path, "a file, or null with a viewer")
        if map_colors not in _MAP_COLORS:
            raise ConfigError("map_colors", map_colors, " | ".join(_MAP_COLORS))
        self._shown = _MAP_COLORS[map_colors]
        every = {"image": image_every, "depth": depth_every, "scan": scan_every}
        self._sensors = SensorLog(every, jpeg_quality)
        self._path, self._viewer = path, viewer
        self._file: Path | None = None
        self._recording: rr.RecordingStream | None = None
        self._colors: dict[str, tuple[int, int, int]] = {"": at.BRIDGED_RGB}
        self._start_ns: int | None = None
        self._voted: str | None = None  # the scene of the last vote
        self._first: tuple[int, Transform] | None = None
        self._last_position: list[float] | None = None
        self._truth: GroundTruth | None = None
        self._rr: Any = _import_rerun(required)

    @property
    def writes_files(self) -> bool:
        """Tell whether it writes a recording."""
        return self._path is not None

    def open(self, rig: Rig, folder: Path) -> None:
        """Start the file or the viewer, with a layout for the sensors that the rig has."""
        if self._rr is None:
            return
        # A fixed id: two runs of one command differ only in the stamps that the viewer adds.
        name = "sceneslam" if self._path is not None else folder.name
        self._recording = self._rr.RecordingStream("sceneslam", recording_id=name)
        layout = at.layout(rig, shown=self._shown)
        if self._viewer is not None:
            sys.stderr.write(f"{self._viewer.open()}\n")
            self._recording.connect_grpc(self._viewer.url, default_blueprint=layout)
        else:
            self._file = new_file(folder, str(self._path))
            self._recording.save(part_of(self._file), default_blueprint=layout)
        self._recording.log("world", self._rr.ViewCoordinates.FLU, static=True)
        self._sensors.place(self._recording, rig)

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Log the measurements of an observation that are due."""
        recording = self._recording
        if recording is None:
            return
        if self._start_ns is None:
            self._start_ns = observation.stamp_ns
        self._set_time(recording, observation.stamp_ns)
        if T_map_base is not None:
            self._first = self._first or (observation.stamp_ns, T_map_base)
            self._write_pose(recording, T_map_base, module)
        self._sensors.write(recording, observation)

    def write_event(self, event: Event) -> None:
        """Log a vote as curves, other events as lines of text."""
        recording = self._recording
        if recording is None:
            return
        self._set_time(recording, event["stamp_ns"])
        if event["event"] == "vote":
            self._write_vote(recording, event)
        if event["event"] == "scene":
            self._write_level(recording, at.CONFIRMED, event["scene"], event["previous"])
        if event["event"] in _LEVELS:
            is_trouble = event.get("status", "tracking") != "tracking"
            level = "WARN" if is_trouble else _LEVELS[event["event"]]
            is_state = event["event"] == "tracking"
            panel = at.TRACKING if is_state else at.DECISIONS
            recording.log(panel, self._rr.TextLog(_sentence(event), level=level))

    def write_truth(self, truth: GroundTruth) -> None:
        """Keep the ground truth for the end of the run."""
        self._truth = truth

    def write_result(self, result: RunResult) -> None:
        """Log the revised trajectory, the map in the modules' colours, and the errors."""
        if self._recording is None or self._start_ns is None:
            return
        self._set_time(self._recording, int(result.observed_ns[-1]))
        for key in (*result.map.modules, *result.modules):
            self._color(key)
        write_end(self._recording, result, self._truth, self._first, self._start_ns, self._colors)

    def close(self) -> None:
        """Flush and close the file."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()
            self._recording = None
            if self._file is not None:
                finish(self._file)

    def _set_time(self, recording: rr.RecordingStream, stamp_ns: int) -> None:
        """Set the time since the first observation; zero for an event before it."""
        since_ns = 0 if self._start_ns is None else max(stamp_ns - self._start_ns, 0)
        recording.set_time(at.TIMELINE, duration=since_ns * 1e-9)

    def _write_pose(self, recording: rr.RecordingStream, T_map_base: Transform, key: str) -> None:
        quaternion = self._rr.Quaternion(xyzw=se3.to_quat_xyzw(T_map_base))
        pose = self._rr.Transform3D(translation=T_map_base[:3, 3], quaternion=quaternion)
        recording.log(at.BASE, pose)
        position = T_map_base[:3, 3].tolist()
        if self._last_position is not None:
            strip = [[self._last_position, position]]
            step = self._rr.LineStrips3D(strip, colors=[self._color(key)], radii=[0.01])
            recording.log(at.ONLINE, step)
        self._last_position = position

    def _write_vote(self, recording: rr.RecordingStream, event: Event) -> None:
        value = event.get("value")
        if value is not None and math.isfinite(value):
            recording.log(at.VALUE, self._rr.Scalars([value]))
        previous = self._voted if self._voted != event["scene"] else None
        self._voted = event["scene"]
        self._write_level(recording, at.VOTES, event["scene"], previous)
        for scene, probability in event.get("posterior", {}).items():
            recording.log(f"{at.POSTERIOR}/{scene}", self._rr.Scalars([probability]))

    def _write_level(
        self, recording: rr.RecordingStream, path: str, scene: str, previous: str | None
    ) -> None:
        """Log 1 for the current scene and 0 for the previous one."""
        recording.log(f"{path}/{scene}", self._rr.Scalars([1.0]))
        if previous is not None:
            recording.log(f"{path}/{previous}", self._rr.Scalars([0.0]))

    def _color(self, key: str) -> tuple[int, int, int]:
        """Return a module's colour; a new one is added to the legend."""
        if key not in self._colors:
            self._colors[key] = at.PALETTE_RGB[(len(self._colors) - 1) % 5]
            if self._recording is not None:
                shown = {name or "bridged": color for name, color in self._colors.items()}
                picture = legend(shown | {"truth": at.TRUTH_RGB})
                self._recording.log(at.LEGEND, self._rr.Image(picture), static=True)
        return self._colors[key]


def _import_rerun(required: bool) -> Any:
    """Return the library, None where it is missing and not required."""
    try:
        import rerun
    except ImportError as err:
        if required:
            install = "pip install 'sceneslam[rerun]'"
            raise ConfigError("required", True, f"false, or the extra: {install}") from err
        return None
    return rerun


def _sentence(event: Mapping[str, Any]) -> str:
    """Return an event as `kind: key value, key value`, numbers short."""
    fields = {key: value for key, value in event.items() if key not in ("event", "stamp_ns")}
    words = [f"{key} {value}" for key, value in fields.items() if isinstance(value, str)]
    words += [f"{key} {value:.3g}" for key, value in fields.items() if isinstance(value, float)]
    words += [f"{key} {value}" for key, value in fields.items() if type(value) is int]
    return f"{event['event']}: {', '.join(words)}"
