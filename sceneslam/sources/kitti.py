"""KITTI drives: a folder of lidar scans, with times and poses if available."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros.pixels import locked
from sceneslam.sources.intrinsics import checked_range_m
from sceneslam.sources.prefetch import prefetched
from sceneslam.sources.stamped_scans import StampedScans
from sceneslam.sources.survey.survey import Stream, Survey, spread
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import files_by_number, given_folder, read_text
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Lidar, Rig, Sensor
from sceneslam.types.trajectory import Trajectory, parse_stamp_ns
from sceneslam.types.truth import GroundTruth

_FOLDERS = ("velodyne", "velodyne_points/data")
_TIMES = ("times.txt", "velodyne_points/timestamps.txt", "timestamps.txt")
_PERIOD_NS = 100_000_000
_POINT_BYTES = 16  # float32 x y z reflectance
_SAMPLES = 3  # scans that are read for a survey
_SKEW_MAX = 1e-2  # entries of R^T R - I of a rotation written with three decimals or more


class Kitti(StampedScans):
    """Gives one observation per scan; base is the lidar.

    `path` is a drive: `velodyne/*.bin` (odometry benchmark) or `velodyne_points/data/*.bin` (raw
    data), or its folder of scans. Times are read from times.txt or timestamps.txt, else 10 Hz.
    Times and poses have a line per scan; where they have more (a drive with lost scans, a part of
    a drive), a scan's line is the number in its name, from 0.
    Ground truth is groundtruth_tum.txt, the lidar's poses, or poses*.txt: the camera's poses if
    calib.txt beside it has `Tr` (odometry benchmark, SemanticKITTI), else the lidar's.
    `vertical_offset_deg` is how much higher the beams are than the files say.
    """

    def __init__(self, path: str, range_m: list[float], vertical_offset_deg: float) -> None:
        low_m, high_m = checked_range_m("range_m", range_m)
        if not abs(vertical_offset_deg) < 90:
            raise ConfigError("vertical_offset_deg", vertical_offset_deg, "between -90 and 90")
        self._offset_rad = float(np.deg2rad(vertical_offset_deg))
        self._files = _scan_files(given_folder(path))
        self._folder = _drive(self._files[0].parent)
        self._times = next((one for name in _TIMES if (one := self._folder / name).is_file()), None)
        super().__init__(
            Rig(sensors=frozenset({Sensor.POINTS}), lidar=Lidar(range_m=(low_m, high_m))),
            _read_times_ns(self._times, self._files),
        )

    def __iter__(self) -> Iterator[Observation]:
        """Yield the scans; reads files ahead in threads."""
        self._faults.clear()
        scans = prefetched(self._jobs())
        for stamp_ns, path, points in zip(
            self._stamps_ns.tolist(), self._files, scans, strict=True
        ):
            if points is None:
                self._faults.add("scan is empty or cut off", str(path))
            else:
                yield Observation(stamp_ns=stamp_ns, points_lidar=points)

    def survey(self) -> Survey:
        """Return the stamps of the scans and some of the scans."""
        lidar = Stream(
            sensor=Sensor.POINTS,
            place=str(self._files[0].parent),
            count=len(self._files),
            stamps_ns=self._stamps_ns,
        )
        files = [self._files[at] for at in spread(len(self._files), _SAMPLES)]
        scans = [_read_scan(path, self._offset_rad) for path in files]
        assumed = f"no times.txt: the scans are assumed to come at 10 Hz: {self._folder}"
        return Survey(
            streams=[lidar],
            clouds=[points for points in scans if points is not None],
            odd=[] if self._times else [assumed],
        )

    def ground_truth(self) -> GroundTruth | None:
        """Return the true poses T_gt_lidar of the drive, None without a file of poses."""
        tum = self._folder / "groundtruth_tum.txt"
        if tum.is_file():
            return GroundTruth(trajectory=Trajectory.read_tum(tum))
        for path in sorted(self._folder.glob("poses*.txt")):
            return GroundTruth(trajectory=self._read_poses(path))
        return None

    def _read_poses(self, path: Path) -> Trajectory:
        """Return the lidar's poses by a file: per line, rows 1 to 3 of a matrix (4, 4) [m].

        It is T_gt_lidar; with `Tr` in calib.txt it is the pose of the camera.
        """
        text = read_text(path).splitlines()
        try:
            rows = np.loadtxt(text, ndmin=2, dtype=np.float64)
        except ValueError as err:
            raise InputError(f"poses: expected 12 numbers per line ({err}): {path}") from err
        lines = _lines(self._files, len(rows))
        if lines is None or rows.shape[1] != 12 or not np.isfinite(rows).all():
            raise InputError(
                f"poses: expected {len(self._files)} lines of 12 finite numbers, got "
                f"{rows.shape[0]} of {rows.shape[1]}: {path}"
            )
        T_gt_base = np.tile(se3.identity(), (len(rows), 1, 1))
        T_gt_base[:, :3, :] = rows.reshape(-1, 3, 4)
        wrong = np.flatnonzero(se3.skew(T_gt_base) > _SKEW_MAX)
        if len(wrong):
            numbers = [n for n, line in enumerate(text, start=1) if line.partition("#")[0].strip()]
            raise InputError(f"poses: line {numbers[wrong[0]]} has no rotation: {path}")
        T_cam_lidar = _read_T_cam_lidar(path.with_name("calib.txt"))
        T_gt_base = se3.inverse(T_cam_lidar) @ T_gt_base[lines] @ T_cam_lidar
        return Trajectory(stamps_ns=self._stamps_ns, T_world_base=T_gt_base)

    def _jobs(self) -> Iterator[Callable[[], NDArray[np.float32] | None]]:
        for path in self._files:
            yield partial(_read_scan, path, self._offset_rad)


def _scan_files(folder: Path) -> Sequence[Path]:
    for name in (*_FOLDERS, "."):
        files = files_by_number(folder / name, {".bin"})
        if any(file.name.endswith(".pcd.bin") for file in files):
            raise InputError(
                "scans: *.pcd.bin are nuScenes', of five numbers a point, expected KITTI's *.bin, "
                f"of four: {folder}"
            )
        if files:
            return files
    raise InputError(f"no scans, expected velodyne/*.bin or velodyne_points/data/*.bin: {folder}")


def _drive(folder: Path) -> Path:
    """Return the drive's folder by that of its scans, which may be the same."""
    whole = folder.absolute()
    return next((whole.parents[name.count("/")] for name in _FOLDERS if whole.match(name)), folder)


def _read_T_cam_lidar(path: Path) -> se3.Transform:
    """Return `Tr` of a calib.txt, the identity without; raises InputError if it is no transform."""
    T_cam_lidar = se3.identity()
    for line in read_text(path).splitlines() if path.is_file() else ():
        key, _, numbers = line.partition(":")
        if key.strip() != "Tr":
            continue
        try:
            T_cam_lidar[:3] = np.array(numbers.split(), dtype=np.float64).reshape(3, 4)
        except ValueError as err:
            raise InputError(f"Tr: expected 12 numbers, got {numbers.strip()!r}: {path}") from err
        if not np.isfinite(T_cam_lidar).all() or se3.skew(T_cam_lidar) > _SKEW_MAX:
            raise InputError(f"Tr: expected a rotation and a translation: {path}")
    return T_cam_lidar


def _lines(files: Sequence[Path], count: int) -> NDArray[np.int64] | None:
    """Return which of `count` lines of a file is each scan's; None if they do not fit."""
    if count == len(files):
        return np.arange(count)
    names = [path.stem for path in files]
    if count < len(files) or not all(name.isdecimal() for name in names):
        return None
    numbers = np.array([int(name) for name in names])
    return numbers if numbers.max() < count else None


def _read_times_ns(path: Path | None, files: Sequence[Path]) -> NDArray[np.int64]:
    """Return the stamps (N,) [ns] of the scans; without a file of times, 10 Hz from zero.

    Raises InputError if the file's lines are not those of the scans, or a time is invalid.
    """
    if path is None:
        return np.arange(len(files), dtype=np.int64) * _PERIOD_NS
    texts = [line.strip() for line in read_text(path).splitlines()]
    stamps = [_stamp_ns(line, path) for line in texts if line and line[0] != "#"]
    lines = _lines(files, len(stamps))
    if lines is None:
        raise InputError(
            f"times: expected {len(files)} as there are scans, got {len(stamps)}: {path}"
        )
    return np.array(stamps, dtype=np.int64)[lines]


def _stamp_ns(line: str, path: Path) -> int:
    """Return the stamp [ns] of a line: seconds, or date and time as in the raw drives (as UTC)."""
    try:
        if ":" not in line:
            return parse_stamp_ns(line)
        day_time, _, fraction = line.replace(" ", "T").partition(".")
        whole = int(np.datetime64(day_time, "s").astype(np.int64))
        return whole * 10**9 + int((fraction + "0" * 9)[:9])
    except ValueError as err:
        raise InputError(f"times: expected seconds, got {line[:40]!r}: {path}") from err


def _read_scan(path: Path, offset_rad: float) -> NDArray[np.float32] | None:
    """Return the finite points (N, 3) [m], lidar, of a file; None if it is empty or cut off.

    They are raised by `offset_rad`.
    """
    try:
        data = path.read_bytes() if path.is_file() else b""
    except OSError:
        return None
    if not data or len(data) % _POINT_BYTES:
        return None
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, :3]
    return locked(_raised(points[np.isfinite(points).all(axis=1)], offset_rad))


def _raised(points: NDArray[np.float32], angle_rad: float) -> NDArray[np.float32]:
    """Return points (N, 3) [m], each turned by an angle about the axis point x z, towards z."""
    z_m, flat_m = points[:, 2], np.hypot(points[:, 0], points[:, 1])
    up = np.divide(z_m, flat_m, out=np.zeros_like(z_m), where=flat_m > 0)
    cosine, sine = np.float32(np.cos(angle_rad)), np.float32(np.sin(angle_rad))
    flat_ratio = cosine - sine * up
    return np.column_stack([points[:, :2] * flat_ratio[:, None], cosine * z_m + sine * flat_m])
