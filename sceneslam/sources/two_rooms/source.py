"""A simulated robot that drives from a lit room into a dark one, and seven stories more."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import writer as ros_writer
from sceneslam.sources.rosbag import RosBag
from sceneslam.sources.two_rooms import motion, settings
from sceneslam.sources.two_rooms.cache import Cache, code_digest
from sceneslam.sources.two_rooms.render import render
from sceneslam.sources.two_rooms.shot import Frame, Shot, build_place, light_place
from sceneslam.sources.two_rooms.stories import STORIES
from sceneslam.sources.two_rooms.truth import scenes_of
from sceneslam.sources.two_rooms.wheels import Gyro, WheelOdometry
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_START_NS = 1_000 * 10**9  # stamps count from here: zero means "unset" to many readers
_LIGHTS = ("story", "on", "off")


class TwoRooms:
    """Renders a story once, keeps it as MCAP, and gives the observations of that file.

    `lights` keeps the rooms' lamps on or off, whatever the story says; `laser` switches the
    scanner on; `duration_s` ends the story early. The same arguments give the same bytes, with
    any number of `workers` (processes; null: one per core).
    """

    def __init__(
        self,
        story: str,
        seed: int,
        lights: str,
        laser: bool,
        duration_s: float | None,
        camera: dict[str, Any],
        scanner: dict[str, Any],
        odometry: dict[str, Any],
        gyro: dict[str, Any],
        cache_dir: str,
        workers: int | None,
    ) -> None:
        _require("story", story, f"one of {', '.join(STORIES)}", story in STORIES)
        _require("lights", lights, f"one of {', '.join(_LIGHTS)}", lights in _LIGHTS)
        _require("seed", seed, "0 or more", seed >= 0)
        _require("workers", workers, "null or 1 to 64", workers is None or 1 <= workers <= 64)
        _require("duration_s", duration_s, "null or above 0", duration_s is None or duration_s > 0)
        self._story_name, self._story = story, STORIES[story]
        self._seed, self._lights, self._duration_s = seed, lights, duration_s
        self._camera = settings.read(settings.CameraSettings, "camera", camera)
        self._scanner = settings.read(settings.LaserSettings, "scanner", scanner)
        self._odometry = settings.read(settings.OdometrySettings, "odometry", odometry)
        self._gyro = settings.read(settings.GyroSettings, "gyro", gyro)
        self._laser = laser
        self._cache_dir = Path(cache_dir)
        self._workers = workers or os.cpu_count() or 1
        self._reader: RosBag | None = None

    @property
    def rig(self) -> Rig:
        """Return the simulated sensors; nothing is rendered for it."""
        sensors = {Sensor.IMAGE, Sensor.DEPTH, Sensor.ODOMETRY, Sensor.GYRO}
        return Rig(
            sensors=frozenset(sensors | {Sensor.SCAN} if self._laser else sensors),
            camera=self._camera.camera(),
            laser=self._scanner.laser() if self._laser else None,
        )

    @property
    def length(self) -> int:
        """Return the number of camera frames."""
        duration_s = self._path.duration_s
        if self._duration_s is not None:
            duration_s = min(duration_s, self._duration_s)
        return int(duration_s * self._camera.rate_hz + 1e-6)

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults of the cached file: none, since damaged files are made anew."""
        return self._reader.faults if self._reader else ()

    def __iter__(self) -> Iterator[Observation]:
        """Yield the observations of the cached file; renders it when there is none."""
        yield from self._read()

    def ground_truth(self) -> GroundTruth:
        """Return the exact poses and the scenes that the light makes; renders when needed."""
        return self._read().ground_truth() or GroundTruth()

    @cached_property
    def _path(self) -> motion.Path:
        return motion.plan(self._story.start_x_y_deg, self._story.moves)

    def _read(self) -> RosBag:
        if self._reader is None:
            name = f"two_rooms_{self._story_name}"
            path = Cache(self._cache_dir).fetch(name, self._dependencies(), self._record)
            self._reader = RosBag(
                path=str(path),
                topics={},
                camera={},
                depth_scale=1000.0,
                depth_range_m=None,
                lidar_range_m=None,
                sync_tolerance_s=0.002,
                base_frame=None,
                ground_truth_frame=None,
            )
        return self._reader

    def _dependencies(self) -> Mapping[str, object]:
        """Return all that the cached file depends on, the simulator's own code with it."""
        return {
            "story": self._story_name,
            "seed": self._seed,
            "lights": self._lights,
            "frames": self.length,
            "camera": self._camera,
            "scanner": self._scanner if self._laser else None,
            "odometry": self._odometry,
            "gyro": self._gyro,
            "code": code_digest(*Path(__file__).parent.glob("*.py"), Path(ros_writer.__file__)),
        }

    def _record(self, path: Path) -> None:
        """Render the story into a file."""
        from tqdm import tqdm

        place = build_place(self._story.place, self._seed)
        shot = Shot(
            story=self._story,
            lights=self._lights,
            seed=self._seed,
            path=self._path,
            rate_hz=self._camera.rate_hz,
            camera=self._camera.camera(),
            scanner=self._scanner if self._laser else None,
            place=place,
            light=light_place(place, self._seed),
        )
        frames = render(shot, self.length, self._workers)
        label = f"rendering two_rooms/{self._story_name}"
        writer = ros_writer.ObservationWriter(path, rig=self.rig, image_format="jpeg")
        try:
            self._write(
                writer,
                shot,
                tqdm(frames, desc=label, total=self.length, unit="frame", mininterval=0.5),
            )
        finally:
            frames.close()
            writer.close()

    def _write(
        self, writer: ros_writer.ObservationWriter, shot: Shot, frames: Iterator[Frame]
    ) -> None:
        odometry = WheelOdometry(self._path, self._odometry, self._generator(4))
        gyro = Gyro(self._path, self._gyro, self._generator(5))
        grey_means = []
        for index, frame in enumerate(frames):
            time_s, before_s = shot.time_s(index), shot.time_s(index - 1)
            writer.write(
                Observation(
                    stamp_ns=_stamp_ns(time_s),
                    image_bgr=frame.image_bgr,
                    depth_m=frame.depth_mm.astype(np.float32) / np.float32(1000.0),
                    scan=self._scan(shot.sweep_time_s(index), frame.ranges_m),
                    T_odom_base=odometry.pose(time_s),
                    gyro_base=gyro.samples(before_s, time_s),
                )
            )
            grey_means.append(frame.grey_mean)
        times_s = [shot.time_s(index) for index in range(len(grey_means))]
        stamps_ns = np.array([_stamp_ns(time_s) for time_s in times_s])
        T_gt_base = np.stack([self._path.pose(time_s) for time_s in times_s])
        trajectory = Trajectory(stamps_ns=stamps_ns, T_world_base=T_gt_base)
        scenes = scenes_of(stamps_ns, grey_means)
        writer.write_truth(GroundTruth(trajectory=trajectory, scenes=scenes))

    def _scan(self, time_s: float | None, ranges_m: NDArray[np.float32] | None) -> LaserScan | None:
        if time_s is None or ranges_m is None:
            return None
        near_m, far_m = self._scanner.range_m
        return LaserScan(
            stamp_ns=_stamp_ns(time_s),
            ranges_m=ranges_m,
            angle_min_rad=float(self._scanner.angles_rad()[0]),
            angle_step_rad=float(np.deg2rad(self._scanner.step_deg)),
            range_min_m=near_m,
            range_max_m=far_m,
        )

    def _generator(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, stream, 0])


def _stamp_ns(time_s: float) -> int:
    return _START_NS + round(time_s * 1e9)


def _require(name: str, value: object, allowed: str, is_met: bool) -> None:
    if not is_met:
        raise ConfigError(name, value, allowed)
