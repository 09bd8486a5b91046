"""A simulated robot that drives through rooms or a building, in one of nine stories."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import writer as ros_writer
from sceneslam.sources.rosbag import RosBag
from sceneslam.sources.simulator import settings, stories
from sceneslam.sources.simulator.cache import Cache, code_digest
from sceneslam.sources.simulator.optics.exposure import follow
from sceneslam.sources.simulator.places.floor import BuildingLayout
from sceneslam.sources.simulator.render import render
from sceneslam.sources.simulator.robot import motion
from sceneslam.sources.simulator.robot.wheels import SimulatedGyro, WheelOdometry
from sceneslam.sources.simulator.shot import (
    Shot,
    SimulatedFrame,
    build_place,
    floor_plan,
    light_place,
    meter,
)
from sceneslam.sources.simulator.truth import changes_of, scene_at
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_START_NS = 1_000 * 10**9  # first stamp; zero means "unset" in many formats
_OF_ROOMS, _OF_BUILDING = {"rooms.py"}, {"building.py", "zones.py", "zone_kind.py"}
_LIGHTS = ("story", "on", "off")


class Simulator:
    """Renders a story once to a cached MCAP file, and gives the observations of that file.

    `lights` keeps the rooms' lamps on or off, against the story; `laser` switches the scanner on,
    `wheels` the encoders; `order` is a seed for the order of the building's rooms; `duration_s`
    ends the story early; `progress` shows a bar while it renders. The same arguments give the same
    bytes, with any number of `workers` (processes; null: one per core).
    """

    def __init__(
        self,
        story: str,
        seed: int,
        lights: str,
        laser: bool,
        wheels: bool,
        order: int | None,
        duration_s: float | None,
        camera: dict[str, Any],
        scanner: dict[str, Any],
        odometry: dict[str, Any],
        gyro: dict[str, Any],
        exposure: dict[str, Any],
        cache_dir: str,
        workers: int | None,
        progress: bool,
    ) -> None:
        _require("story", story, f"one of {', '.join(stories.NAMES)}", story in stories.NAMES)
        _require("lights", lights, f"one of {', '.join(_LIGHTS)}", lights in _LIGHTS)
        _require("seed", seed, "0 or more", seed >= 0)
        _require("order", order, "null, 0 or more", order is None or order >= 0)
        _require("workers", workers, "null or 1 to 64", workers is None or 1 <= workers <= 64)
        _require("duration_s", duration_s, "null or above 0", duration_s is None or duration_s > 0)
        self._story_name, self._story, self._order = story, stories.find(story, order), order
        self._seed, self._lights, self._duration_s = seed, lights, duration_s
        self._camera = settings.read(settings.CameraSettings, "camera", camera)
        self._scanner = settings.read(settings.LaserSettings, "scanner", scanner)
        self._odometry = settings.read(settings.OdometrySettings, "odometry", odometry)
        self._gyro = settings.read(settings.GyroSettings, "gyro", gyro)
        frames = np.inf if duration_s is None else duration_s * self._camera.rate_hz
        _require("duration_s", duration_s, "null or as long as a frame", frames + 1e-6 >= 1)
        self._exposure = settings.read(settings.ExposureSettings, "exposure", exposure)
        self._laser, self._wheels = laser, wheels
        self._cache_dir = Path(cache_dir)
        self._workers = workers or os.cpu_count() or 1
        self._progress = progress
        self._reader: RosBag | None = None

    @property
    def rig(self) -> Rig:
        """Return the simulated sensors, without rendering."""
        sensors = {Sensor.IMAGE, Sensor.DEPTH, Sensor.GYRO}
        sensors |= {Sensor.SCAN} if self._laser else set()
        sensors |= {Sensor.ODOMETRY} if self._wheels else set()
        return Rig(
            sensors=frozenset(sensors),
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
        """Return the faults of the cached file: none, as damaged files are rendered again."""
        return self._reader.faults if self._reader else ()

    def __iter__(self) -> Iterator[Observation]:
        """Yield the observations of the cached file; renders it if it is missing."""
        yield from self._read()

    def ground_truth(self) -> GroundTruth:
        """Return the exact poses and the true scenes; renders the story if needed."""
        return self._read().ground_truth() or GroundTruth()

    @cached_property
    def _path(self) -> motion.Path:
        return motion.plan(self._story.start_x_y_deg, self._story.moves, self._floor_plan.floor)

    @cached_property
    def _floor_plan(self) -> BuildingLayout:
        return floor_plan(self._story.place, self._order)

    def _read(self) -> RosBag:
        if self._reader is None:
            name = self._story_name
            path = Cache(self._cache_dir).fetch(name, self._dependencies(), self._record)
            self._reader = RosBag(
                path=str(path),
                topics={},
                camera={},
                depth_scale=1000.0,
                depth_range_m=None,
                lidar_range_m=None,
                sync_tolerance_s=0.002,
                silent_after_s=1.0,
                base_frame=None,
                ground_truth_frame=None,
                wheels=None,
            )
        return self._reader

    def _dependencies(self) -> Mapping[str, object]:
        """Return everything that the cached file depends on, with a hash of its place's code."""
        return {
            "story": self._story,
            "seed": self._seed,
            "lights": self._lights,
            "frames": self.length,
            "camera": self._camera,
            "scanner": self._scanner if self._laser else None,
            "odometry": self._odometry,
            "gyro": self._gyro,
            "wheels": self._wheels,
            "order": self._order,
            "exposure": self._exposure,
            "code": code_digest(*_code_of(self._story.place)),
        }

    def _record(self, path: Path) -> None:
        """Render the story into a file."""
        from tqdm import tqdm

        place = build_place(self._story.place, self._seed, self._order)
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
            exposure=self._exposure,
            exposures=np.ones(self.length),
        )
        if self._exposure.is_automatic:
            greys = meter(shot, self.length)
            shot = replace(shot, exposures=follow(greys, self._exposure, shot.rate_hz))
        frames = render(shot, self.length, self._workers)
        bar = tqdm(
            frames,
            desc=f"rendering {self._story_name}",
            total=self.length,
            unit="frame",
            mininterval=0.5,
            disable=not self._progress,
        )
        writer = ros_writer.ObservationWriter(path, rig=self.rig, image_format="jpeg")
        try:
            self._write(writer, shot, bar)
        finally:
            frames.close()
            writer.close()

    def _write(
        self, writer: ros_writer.ObservationWriter, shot: Shot, frames: Iterator[SimulatedFrame]
    ) -> None:
        odometry = WheelOdometry(self._path, self._odometry, self._generator(4))
        gyro = SimulatedGyro(self._path, self._gyro, self._generator(5))
        for index, frame in enumerate(frames):
            time_s, before_s = shot.time_s(index), shot.time_s(index - 1)
            writer.write(
                Observation(
                    stamp_ns=_stamp_ns(time_s),
                    image_bgr=frame.image_bgr,
                    depth_m=frame.depth_mm.astype(np.float32) / np.float32(1000.0),
                    scan=self._scan(shot.sweep_time_s(index), frame.ranges_m),
                    T_odom_base=odometry.pose(time_s) if self._wheels else None,
                    gyro_base=gyro.samples(before_s, time_s),
                )
            )
        writer.write_truth(self._truth(shot))

    def _truth(self, shot: Shot) -> GroundTruth:
        """Return the ground truth: pose and scene of every frame."""
        times_s = [shot.time_s(index) for index in range(self.length)]
        stamps_ns = np.array([_stamp_ns(time_s) for time_s in times_s])
        T_gt_base = np.stack([self._path.pose(time_s) for time_s in times_s])
        trajectory = Trajectory(stamps_ns=stamps_ns, T_world_base=T_gt_base)
        scenes: list[str] = []
        for time_s, T_gt_now in zip(times_s, T_gt_base, strict=True):
            here = scene_at(self._floor_plan, T_gt_now, shot.levels(time_s))
            scenes.append(here or scenes[-1])
        return GroundTruth(trajectory=trajectory, scenes=changes_of(stamps_ns, scenes))

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


def _code_of(place: str) -> Iterator[Path]:
    """Yield the files of code that a recording depends on; its story is compared by value."""
    of_others = _OF_ROOMS if place == "building" else _OF_BUILDING
    for file in Path(__file__).parent.rglob("*.py"):
        if file.name not in {"cache.py", "stories.py", *of_others}:
            yield file


def _stamp_ns(time_s: float) -> int:
    return _START_NS + round(time_s * 1e9)


def _require(name: str, value: object, allowed: str, is_met: bool) -> None:
    if not is_met:
        raise ConfigError(name, value, allowed)
