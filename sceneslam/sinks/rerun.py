"""A recording for the Rerun viewer: images, depth, trajectory by module, detector values."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

if TYPE_CHECKING:
    import rerun as rr

# Okabe and Ito's palette, as in the figures; grey for poses that no module gave.
_COLORS_RGB = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0))
_BRIDGED_RGB = (119, 119, 119)
_TRUTH_RGB = (235, 235, 235)
_TRUTH_GAP_NS = 50_000_000
_TRAJECTORY = "world/trajectory"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class _StampedPose:
    stamp_ns: int
    T_map_base: Transform


class RerunSink:
    """Writes `run.rrd`. Only increments of the trajectory are logged, so cost does not grow."""

    def __init__(
        self,
        path: str,
        *,
        required: bool,
        image_every: int,
        depth_every: int,
        scan_every: int,
        jpeg_quality: int,
    ) -> None:
        """Get ready to write to `path`.

        Where the extra `rerun` is not installed nothing is written, or, when the recording is
        `required`, ConfigError says what to install.
        """
        self._every = {"image": image_every, "depth": depth_every, "scan": scan_every}
        for name, every in self._every.items():
            if every < 1:
                raise ConfigError(f"{name}_every", every, "a whole number of observations from 1")
        if not 1 <= jpeg_quality <= 100:
            raise ConfigError("jpeg_quality", jpeg_quality, "1 to 100")
        self._path = Path(path)
        self._jpeg_quality = jpeg_quality
        self._recording: rr.RecordingStream | None = None
        self._colors: dict[str, tuple[int, int, int]] = {"": _BRIDGED_RGB}
        self._count = 0
        self._start_ns = 0
        self._first_pose: _StampedPose | None = None
        self._last_position: list[float] | None = None
        self._last_module: str | None = None
        self._rr: Any = _import_rerun(required)

    def open(self, rig: Rig, folder: Path) -> None:
        """Start the file, with a layout for the sensors that the rig has."""
        if self._rr is None:
            return
        path = folder / self._path
        path.parent.mkdir(parents=True, exist_ok=True)
        # A fixed identity: two runs of one command differ in nothing but the viewer's own stamps.
        self._recording = self._rr.RecordingStream("sceneslam", recording_id="sceneslam")
        self._recording.save(path, default_blueprint=self._layout(rig))
        self._recording.log("world", self._rr.ViewCoordinates.FLU, static=True)
        if rig.camera is not None:
            camera = rig.camera
            pinhole = self._rr.Pinhole(
                image_from_camera=camera.K, resolution=camera.size_wh, image_plane_distance=0.3
            )
            self._recording.log("world/base/camera", pinhole, static=True)
            self._recording.log("world/base/camera", self._pose(camera.T_base_cam), static=True)
        if rig.laser is not None:
            placed = self._pose(rig.laser.T_base_laser)
            self._recording.log("world/base/laser", placed, static=True)

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Log one observation; what it lacks, and what is not due, is left out."""
        recording = self._recording
        if recording is None:
            return
        if not self._count:
            self._start_ns = observation.stamp_ns
        self._set_time(recording, observation.stamp_ns)
        if T_map_base is not None:
            self._write_pose(recording, T_map_base, module)
            if self._first_pose is None:
                self._first_pose = _StampedPose(observation.stamp_ns, T_map_base)
        self._write_sensors(recording, observation)
        if module != self._last_module:
            recording.log("log", self._rr.TextLog(f"module: {module or 'none'}", level="INFO"))
            self._last_module = module
        self._count += 1

    def write_event(self, event: Event) -> None:
        """Log a vote's value as a curve and every decision as a line of text."""
        recording = self._recording
        if recording is None:
            return
        self._set_time(recording, event["stamp_ns"])
        if event["event"] == "vote":
            value = event.get("value")
            if value is not None and math.isfinite(value):
                recording.log("plots/detector", self._rr.Scalars([value]))
        elif event["event"] in ("scene", "decision", "handover", "fault"):
            recording.log("log", self._rr.TextLog(_sentence(event), level="INFO"))

    def write_truth(self, truth: GroundTruth) -> None:
        """Log the true path, laid on the estimate at its first pose."""
        first, stamps_ns = self._first_pose, truth.trajectory.stamps_ns
        if self._recording is None or first is None or not len(stamps_ns):
            return
        nearest = int(np.argmin(np.abs(stamps_ns - first.stamp_ns)))
        if abs(int(stamps_ns[nearest]) - first.stamp_ns) > _TRUTH_GAP_NS:
            return
        T_map_gt = first.T_map_base @ se3.inverse(truth.trajectory.T_world_base[nearest])
        path_map = se3.apply(T_map_gt, truth.trajectory.positions_m)
        strip = self._rr.LineStrips3D([path_map], colors=[_TRUTH_RGB], radii=[0.004])
        self._recording.log("world/ground_truth", strip, static=True)

    def close(self) -> None:
        """Write out what is pending and finish the file."""
        if self._recording is not None:
            self._recording.flush()
            self._recording.disconnect()
            self._recording = None

    def _set_time(self, recording: rr.RecordingStream, stamp_ns: int) -> None:
        elapsed_s = (stamp_ns - self._start_ns) * 1e-9 if self._count else 0.0
        recording.set_time("time", duration=elapsed_s)

    def _write_pose(self, recording: rr.RecordingStream, T_map_base: Transform, key: str) -> None:
        recording.log("world/base", self._pose(T_map_base))
        position = T_map_base[:3, 3].tolist()
        if self._last_position is not None:
            color = self._colors.setdefault(key, _COLORS_RGB[(len(self._colors) - 1) % 5])
            step = self._rr.LineStrips3D(
                [[self._last_position, position]], colors=[color], radii=[0.01]
            )
            recording.log(_TRAJECTORY, step)
        self._last_position = position

    def _write_sensors(self, recording: rr.RecordingStream, observation: Observation) -> None:
        if observation.image_bgr is not None and self._is_due("image"):
            quality = [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality]
            _, jpeg = cv2.imencode(".jpg", observation.image_bgr, quality)
            image = self._rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
            recording.log("world/base/camera/image", image)
        if observation.depth_m is not None and self._is_due("depth"):
            depth_mm = np.clip(observation.depth_m * 1000.0, 0, 65535).astype(np.uint16)
            _, png = cv2.imencode(".png", depth_mm)
            depth = self._rr.EncodedDepthImage(png.tobytes(), media_type="image/png", meter=1000.0)
            recording.log("world/base/camera/depth", depth)
        scan = observation.scan
        if scan is not None and self._is_due("scan"):
            hit = np.isfinite(scan.ranges_m)
            ranges_m, angles_rad = scan.ranges_m[hit], scan.angles_rad[hit]
            points = np.stack([np.cos(angles_rad), np.sin(angles_rad), 0 * angles_rad], axis=1)
            cloud = self._rr.Points3D(points * ranges_m[:, None], radii=[0.02])
            recording.log("world/base/laser/scan", cloud)

    def _is_due(self, sensor: str) -> bool:
        return self._count % self._every[sensor] == 0

    def _pose(self, T_a_b: Transform) -> Any:
        quaternion = self._rr.Quaternion(xyzw=se3.to_quat_xyzw(T_a_b))
        return self._rr.Transform3D(translation=T_a_b[:3, 3], quaternion=quaternion)

    def _layout(self, rig: Rig) -> Any:
        import rerun.blueprint as rrb

        side: list[Any] = []
        if rig.camera is not None:
            image = ["/world/base/camera/image"]
            side.append(
                rrb.Spatial2DView(origin="/world/base/camera", contents=image, name="camera")
            )
            side.append(rrb.TimeSeriesView(origin="/plots", name="detector"))
        side.append(rrb.TextLogView(origin="/log", name="decisions"))
        # The trajectory is logged in steps: show all of them up to the time cursor.
        past = rrb.VisibleTimeRanges(
            timeline="time",
            start=rrb.TimeRangeBoundary.infinite(),
            end=rrb.TimeRangeBoundary.cursor_relative(),
        )
        scene = rrb.Spatial3DView(origin="/world", name="map", overrides={_TRAJECTORY: past})
        views = rrb.Horizontal(scene, rrb.Vertical(*side), column_shares=[3, 2])
        # Opens at the end, with the whole path in sight.
        at_end = rrb.TimePanel(state="collapsed", timeline="time", play_state="following")
        return rrb.Blueprint(views, at_end, collapse_panels=True)


def _import_rerun(required: bool) -> Any:
    """Return the library, None where it is missing and not required."""
    try:
        import rerun
    except ImportError as err:
        install = "pip install 'sceneslam[rerun]'"
        if required:
            raise ConfigError("required", True, f"false, or the extra: {install}") from err
        _log.info("run.rrd is not written, Rerun is not installed: %s", install)
        return None
    return rerun


def _sentence(event: Event) -> str:
    known = [f"{key}={value}" for key, value in event.items() if isinstance(value, str | float)]
    return " ".join(known)
