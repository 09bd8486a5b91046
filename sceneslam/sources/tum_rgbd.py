"""Recordings in the layout of the TUM RGB-D benchmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.ros.pixels import DepthUnits
from sceneslam.sources.faults import FaultLog
from sceneslam.sources.frame_files import (
    SAMPLES,
    FrameFiles,
    FrameReader,
    ReadFrame,
    usual_size_wh,
)
from sceneslam.sources.intrinsics import (
    Intrinsics,
    checked_above_zero,
    checked_range_m,
    given_intrinsics,
)
from sceneslam.sources.prefetch import prefetched
from sceneslam.sources.spanned import TimeSpan
from sceneslam.sources.stamped_files import StampedFile, nearest_once, read_list
from sceneslam.sources.survey.survey import Stream, Survey, spread
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_folder
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
_KNOWN_SIZE_WH = (640, 480)  # [px]
_KNOWN = {  # published calibrations of the benchmark, for images of this size
    "freiburg1": Intrinsics(
        fx=517.3,
        fy=516.5,
        cx=318.6,
        cy=255.3,
        distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    ),
    "freiburg2": Intrinsics(
        fx=520.9,
        fy=521.0,
        cx=325.1,
        cy=249.7,
        distortion=(0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    ),
    "freiburg3": Intrinsics(fx=535.4, fy=539.2, cx=320.1, cy=247.6, distortion=_NO_DISTORTION),
}


class TumRgbd:
    """Gives one observation per line of rgb.txt, with the depth nearest to it in time.

    `camera` (fx, fy, cx, cy, distortion) may be null for the benchmark's own recordings, which are
    known by their folder's name and have 640x480 pixels. `base` is at the camera's origin, with
    REP-103 axes.
    """

    def __init__(
        self,
        path: str,
        camera: dict[str, Any],
        depth_scale: float,
        depth_range_m: list[float],
        sync_tolerance_s: float,
    ) -> None:
        checked_above_zero("depth_scale", depth_scale)
        checked_above_zero("sync_tolerance_s", sync_tolerance_s)
        range_m = checked_range_m("depth_range_m", depth_range_m)
        given = given_intrinsics(camera)
        self._folder = given_folder(path)
        colors = read_list(self._folder / "rgb.txt")
        if not colors:
            raise InputError(f"the list has no images: {self._folder / 'rgb.txt'}")
        has_depth = (self._folder / "depth.txt").is_file()
        depths = read_list(self._folder / "depth.txt") if has_depth else ()
        self._colors, self._depths = colors, depths
        self._depth_scale, self._sync_tolerance_s = depth_scale, sync_tolerance_s
        stamps_ns = [color.stamp_ns for color in colors]
        matches = nearest_once(stamps_ns, depths, round(sync_tolerance_s * 1e9))
        self._frames = [
            FrameFiles(stamp_ns=color.stamp_ns, color=color.path, depth=_path(depth))
            for color, depth in zip(colors, matches, strict=True)
        ]
        size_wh = usual_size_wh(self._frames)
        self._assumed = "" if given else _known_camera(self._folder, size_wh)
        intrinsics = given or _KNOWN[self._assumed]
        self._camera = Camera(
            size_wh=size_wh,
            fx=intrinsics.fx,
            fy=intrinsics.fy,
            cx=intrinsics.cx,
            cy=intrinsics.cy,
            distortion=intrinsics.distortion or _NO_DISTORTION,
            depth_range_m=range_m,
        )
        self._sensors = frozenset({Sensor.IMAGE, Sensor.DEPTH} if depths else {Sensor.IMAGE})
        self._reader = FrameReader(self._camera.size_wh, DepthUnits(depth_scale, range_m))
        self._reader.check_depth(self._sampled())
        self._faults = FaultLog()

    @property
    def rig(self) -> Rig:
        """Return the rig: one camera."""
        return Rig(sensors=self._sensors, camera=self._camera)

    @property
    def length(self) -> int | None:
        """Return the number of images in rgb.txt."""
        return len(self._frames)

    @property
    def faults(self) -> Sequence[str]:
        """Return the images that are missing or damaged."""
        return self._faults.sentences()

    @property
    def span(self) -> TimeSpan | None:
        """Return the first and last stamp of rgb.txt."""
        stamps_ns = [frame.stamp_ns for frame in self._frames]
        return TimeSpan(start_ns=min(stamps_ns), end_ns=max(stamps_ns))

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations; reads and decodes images ahead in threads."""
        self._faults.clear()
        for frame in prefetched(self._jobs()):
            for kind, path in frame.problems.items():
                self._faults.add(kind, str(path))
            if frame.observation is not None:
                yield frame.observation

    def survey(self) -> Survey:
        """Return the stamps of both lists and some depth images."""
        units = DepthUnits.unlimited(self._depth_scale)
        reader = FrameReader(self._camera.size_wh, units)
        depths = [reader.depth_m(path) for path in self._sampled()]
        return Survey(
            streams=[
                Stream(
                    sensor=sensor,
                    place=name,
                    count=len(files),
                    stamps_ns=np.array(sorted(one.stamp_ns for one in files), np.int64),
                )
                for sensor, name, files in (
                    (Sensor.IMAGE, "rgb.txt", self._colors),
                    (Sensor.DEPTH, "depth.txt", self._depths),
                )
                if files
            ],
            sync_tolerance_s=self._sync_tolerance_s,
            depth_scale=self._depth_scale,
            assumed_camera=self._assumed,
            depths_m=[depth_m for depth_m in depths if depth_m is not None],
        )

    def _sampled(self) -> Iterator[Path]:
        for at in spread(len(self._depths), SAMPLES):
            yield self._depths[at].path

    def ground_truth(self) -> GroundTruth | None:
        """Return groundtruth.txt (poses of the camera's optical frame) as poses of `base`."""
        path = self._folder / "groundtruth.txt"
        if not path.is_file():
            return None
        cameras = Trajectory.read_tum(path)
        T_cam_base = se3.inverse(self._camera.T_base_cam)
        trajectory = Trajectory(
            stamps_ns=cameras.stamps_ns, T_world_base=cameras.T_world_base @ T_cam_base
        )
        return GroundTruth(trajectory=trajectory)

    def _jobs(self) -> Iterator[Callable[[], ReadFrame]]:
        for frame in self._frames:
            yield partial(self._reader.read, frame)


def _path(file: StampedFile | None) -> Path | None:
    return None if file is None else file.path


def _known_camera(folder: Path, size_wh: tuple[int, int]) -> str:
    """Return the benchmark's camera that a folder's name names.

    Raises ConfigError without one, or if the images are not as large as the benchmark's.
    """
    name = folder.resolve().name.lower()
    wanted = "a number [px], with fy, cx and cy"
    for camera in _KNOWN:
        if camera not in name and camera.replace("freiburg", "fr") not in name:
            continue
        if size_wh != _KNOWN_SIZE_WH:
            known, got = (f"{width}x{height}" for width, height in (_KNOWN_SIZE_WH, size_wh))
            why = f"the calibration of {camera} is for images of {known}, not {got} pixels"
            raise ConfigError("camera.fx", None, f"{wanted}: {why}")
        return camera
    raise ConfigError("camera.fx", None, f"{wanted}: folder {name!r} names no TUM camera")
