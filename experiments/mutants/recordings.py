"""Recordings of a few observations, one of every format, so that their sources can be built."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sceneslam.ros.writer import ObservationWriter
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Rig, Sensor

_WIDTH, _HEIGHT = 32, 24
_STRAIGHT = "".join(f"{t_s:.1f} {0.5 * t_s} 0 0 0 0 0 1\n" for t_s in range(5))


def write_recordings(folder: Path) -> None:
    """Write `room.mcap`, `tum/`, `kitti/`, `carmen.clf`, `openloris/` and `path.tum`."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_mcap(folder / "room.mcap")
    _write_tum(folder / "tum")
    _write_kitti(folder / "kitti")
    line = f"FLASER 180 {' '.join(['2.0'] * 180)} 0 0 0 0 0 0 {{}} robot {{}}\n"
    lines = "".join(line.format(t_s, t_s) for t_s in range(1, 4))
    (folder / "carmen.clf").write_text(lines)
    for name in ("gt/gt_home_1.txt", "recorded/odom/home.txt"):
        path = folder / "openloris" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"scene: home\nframe: base_link\nseq: 1\n{_STRAIGHT}")
    (folder / "path.tum").write_text(_STRAIGHT)


def _write_mcap(path: Path) -> None:
    camera = Camera(
        size_wh=(_WIDTH, _HEIGHT), fx=30.0, fy=30.0, cx=15.5, cy=11.5, depth_range_m=(0.3, 8.0)
    )
    sensors = frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.SCAN, Sensor.ODOMETRY})
    rig = Rig(sensors=sensors, camera=camera, laser=Laser(T_base_laser=se3.identity()))
    writer = ObservationWriter(path, rig=rig, image_format="png")
    for index in range(3):
        writer.write(_observation(10**9 + index * 10**8))
    writer.close()


def _observation(stamp_ns: int) -> Observation:
    return Observation(
        stamp_ns=stamp_ns,
        image_bgr=np.full((_HEIGHT, _WIDTH, 3), 128, dtype=np.uint8),
        depth_m=np.full((_HEIGHT, _WIDTH), 2.0, dtype=np.float32),
        scan=LaserScan(
            stamp_ns=stamp_ns,
            ranges_m=np.full(90, 2.0, dtype=np.float32),
            angle_min_rad=-0.78,
            angle_step_rad=0.0174,
            range_min_m=0.1,
            range_max_m=10.0,
        ),
        T_odom_base=se3.identity(),
    )


def _write_tum(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    pictures = {
        "rgb": np.full((_HEIGHT, _WIDTH, 3), 128, dtype=np.uint8),
        "depth": np.full((_HEIGHT, _WIDTH), 10_000, dtype=np.uint16),
    }
    for name, picture in pictures.items():
        cv2.imwrite(str(folder / f"{name}.png"), picture)
        lines = "".join(f"{t_s}.0 {name}.png\n" for t_s in range(1, 4))
        (folder / f"{name}.txt").write_text(lines)


def _write_kitti(folder: Path) -> None:
    (folder / "velodyne").mkdir(parents=True, exist_ok=True)
    cloud = np.full((10, 4), 2.0, dtype=np.float32)
    for index in range(3):
        cloud.tofile(folder / "velodyne" / f"{index:010d}.bin")
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
