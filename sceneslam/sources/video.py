"""Videos and folders of images: one camera, in any format that OpenCV reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.ros.pixels import decode_bgr, locked
from sceneslam.sources.faults import FaultLog
from sceneslam.sources.intrinsics import checked_above_zero, given_intrinsics
from sceneslam.sources.prefetch import prefetched
from sceneslam.sources.spanned import TimeSpan
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import check_regular, files_by_number, given_path
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.truth import GroundTruth, SceneChange

_IMAGES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".ppm", ".pgm", ".tif", ".tiff", ".webp"})
_FOLDER_RATE_HZ = 30.0  # assumed rate of images without stamps
_HEADER_RATIO = 0.98  # share of announced frames that must exist
_NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Frame:
    image_bgr: NDArray[np.uint8] | None  # (H, W, 3), None where it is damaged
    time_s: float  # time in the video, NaN if unknown
    name: str


class _Footage(Protocol):
    """A sequence of frames."""

    rate_hz: float
    count: int  # announced number

    def jobs(self) -> Iterator[Callable[[], _Frame | None]]:
        """Yield one function per frame, to be called in order; None is returned after the last."""
        ...


class Video:
    """Gives one observation per frame of a video, or per image of a folder.

    Images come by the numbers in their names. Stamps begin at 0; they are the video's own, or
    equidistant if `rate_hz` is given. `camera` (fx, fy, cx, cy, distortion) may be null for
    detectors; with it, all images must have one size.
    `scenes` are the true scenes, [seconds, scene] by rising time, the first at 0; null: unknown.
    """

    def __init__(
        self,
        path: str,
        rate_hz: float | None,
        camera: dict[str, Any],
        scenes: list[list[float | str]] | None,
    ) -> None:
        self._footage = _footage(given_path(path))
        self._rate_hz = None if rate_hz is None else checked_above_zero("rate_hz", rate_hz)
        self._period_s = 1.0 / (self._rate_hz or self._footage.rate_hz)
        self._camera = self._with_size(camera, path)
        self._scenes = _checked(scenes or [])
        self._path, self._faults = path, FaultLog()

    @property
    def rig(self) -> Rig:
        """Return the rig: one camera, possibly with unknown intrinsics."""
        return Rig(sensors=frozenset({Sensor.IMAGE}), camera=self._camera)

    @property
    def length(self) -> int | None:
        """Return the announced number of frames of the video, or that of the folder."""
        return self._footage.count or None

    @property
    def faults(self) -> Sequence[str]:
        """Return the frames that are damaged or missing."""
        return self._faults.sentences()

    @property
    def span(self) -> TimeSpan | None:
        """Return the stamps of the first and last announced frame."""
        if not self._footage.count:
            return None
        return TimeSpan(start_ns=0, end_ns=round((self._footage.count - 1) * self._period_s * 1e9))

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations; decodes ahead in a thread.

        Raises InputError for an image of another size if intrinsics are given.
        """
        self._faults.clear()
        stamp_ns, count = -1, 0
        for frame in prefetched(self._footage.jobs()):
            if frame is None:
                break
            stamp_ns = self._stamp_ns(frame, stamp_ns, count)
            count += 1
            if frame.image_bgr is None:
                self._faults.add("image is damaged", frame.name)
                continue
            self._check_size(frame)
            yield Observation(stamp_ns=stamp_ns, image_bgr=frame.image_bgr)
        if count < _HEADER_RATIO * self._footage.count:
            missing = f"film ends after {count} of {self._footage.count} frames"
            self._faults.add(missing, self._path)

    def ground_truth(self) -> GroundTruth | None:
        """Return the configured scenes, None without."""
        return GroundTruth(scenes=self._scenes) if self._scenes else None

    def _stamp_ns(self, frame: _Frame, last_ns: int, count: int) -> int:
        """Return a frame's stamp [ns]; if it does not rise, one period after the last."""
        if self._rate_hz is not None or np.isnan(frame.time_s):
            return round(count * self._period_s * 1e9)
        stamp_ns = round(frame.time_s * 1e9)
        return stamp_ns if stamp_ns > last_ns else last_ns + round(self._period_s * 1e9)

    def _with_size(self, camera: dict[str, Any], path: str) -> Camera | None:
        """Return the configured camera with the image size; raises InputError without a frame."""
        given = given_intrinsics(camera)
        frames = chain((job() for job in self._footage.jobs()), [None])
        first = next(f for f in frames if f is None or f.image_bgr is not None)
        if first is None or first.image_bgr is None:
            raise InputError(f"film: no frame of it can be read: {path}")
        if given is None:
            return None
        height, width = first.image_bgr.shape[:2]
        return Camera(
            size_wh=(width, height),
            fx=given.fx,
            fy=given.fy,
            cx=given.cx,
            cy=given.cy,
            distortion=given.distortion or _NO_DISTORTION,
        )

    def _check_size(self, frame: _Frame) -> None:
        if self._camera is None or frame.image_bgr is None:
            return
        height, width = frame.image_bgr.shape[:2]
        if (width, height) != self._camera.size_wh:
            size = "{}x{}".format(*self._camera.size_wh)
            raise InputError(
                f"image size: expected {size} as the first image, got {width}x{height}: "
                f"{frame.name}"
            )


class _Folder:
    """Images in their order."""

    rate_hz = _FOLDER_RATE_HZ

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = files
        self.count = len(files)

    def jobs(self) -> Iterator[Callable[[], _Frame | None]]:
        """Yield one function per image."""
        return (partial(self._read, file) for file in self._files)

    @staticmethod
    def _read(file: Path) -> _Frame:
        try:
            image_bgr = decode_bgr(file.read_bytes()) if file.is_file() else None  # a pipe waits
        except OSError:
            image_bgr = None
        return _Frame(image_bgr=image_bgr, time_s=np.nan, name=str(file))


class _Film:
    """A video file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        film = self._open()
        rate_hz = film.get(cv2.CAP_PROP_FPS)
        self.rate_hz = rate_hz if 0 < rate_hz < np.inf else _FOLDER_RATE_HZ
        self.count = max(int(film.get(cv2.CAP_PROP_FRAME_COUNT)), 0)

    def jobs(self) -> Iterator[Callable[[], _Frame | None]]:
        """Yield functions without end; after the last frame they return None."""
        film = self._open()
        while True:
            yield partial(self._read, film)

    def _open(self) -> cv2.VideoCapture:
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        path = self._path.absolute()  # FFmpeg takes what is before a colon for a protocol
        film = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(level)  # failures are reported below
        if not film.isOpened():
            raise InputError(f"film: expected a file that FFmpeg can read, or images: {self._path}")
        return film

    def _read(self, film: cv2.VideoCapture) -> _Frame | None:
        is_read, image = film.read()
        if not is_read:
            return None
        time_s = film.get(cv2.CAP_PROP_POS_MSEC) * 1e-3
        image_bgr = locked(np.asarray(image, np.uint8))
        return _Frame(image_bgr=image_bgr, time_s=time_s, name=f"{time_s:.3f} s: {self._path}")


def _footage(path: Path) -> _Footage:
    """Return the footage of a path; raises InputError for anything else."""
    if not path.exists():
        raise InputError(f"film not found, expected a file or a folder of images: {path}")
    if not path.is_dir():
        check_regular(path, "a film or a folder of images")
        if path.suffix.lower() not in _IMAGES:
            return _Film(path)
    files = files_by_number(path, _IMAGES) if path.is_dir() else [path]
    if not files:
        raise InputError(f"the folder holds no images ({' '.join(sorted(_IMAGES))}): {path}")
    return _Folder(files)


def _checked(scenes: Sequence[Sequence[float | str]]) -> tuple[SceneChange, ...]:
    """Return the true scenes; raises ConfigError unless their times rise from 0."""
    allowed = "a list of [seconds, scene] by rising seconds, the first at 0"
    changes: list[SceneChange] = []
    for entry in scenes:
        if len(entry) != 2 or isinstance(entry[0], str) or not isinstance(entry[1], str):
            raise ConfigError("scenes", scenes, allowed)
        changes.append(SceneChange(stamp_ns=round(entry[0] * 1e9), scene=entry[1]))
    stamps_ns = [change.stamp_ns for change in changes]
    if stamps_ns != sorted(set(stamps_ns)) or stamps_ns[:1] not in ([], [0]):
        raise ConfigError("scenes", scenes, allowed)
    return tuple(changes)
