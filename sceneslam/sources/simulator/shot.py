"""The frames of a story: camera and laser measurements of any frame by its index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.optics.camera import CameraRenderer, RenderedView
from sceneslam.sources.simulator.optics.exposure import Shutter, split
from sceneslam.sources.simulator.optics.lighting import LightMap, bake
from sceneslam.sources.simulator.optics.noise_table import NoiseTable
from sceneslam.sources.simulator.optics.people import add_people, reach_people
from sceneslam.sources.simulator.optics.rays import RayCaster
from sceneslam.sources.simulator.optics.sensor_noise import expose, measure_depth
from sceneslam.sources.simulator.places import building, rooms
from sceneslam.sources.simulator.places.floor import BuildingLayout
from sceneslam.sources.simulator.places.place import SimulatedPlace
from sceneslam.sources.simulator.robot.motion import Path
from sceneslam.sources.simulator.settings import ExposureSettings, LaserSettings
from sceneslam.sources.simulator.story import Story
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_PLACE_STREAM, _FRAME_STREAM, _SWEEP_STREAM = 1, 2, 3  # streams of random numbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """The data that all frames of a story share; passed to every worker."""

    story: Story
    lights: str
    seed: int
    path: Path
    rate_hz: float
    camera: Camera
    scanner: LaserSettings | None  # None: no laser
    place: SimulatedPlace
    light: LightMap
    exposure: ExposureSettings
    exposures: NDArray[np.float64]  # (frames,), time ratio x gain

    def time_s(self, index: int) -> float:
        """Return the time [s] of a frame since the story's start."""
        return index / self.rate_hz

    def levels(self, time_s: float) -> dict[str, float]:
        """Return the level of each lamp group at a time."""
        return self.story.levels(self.place.groups, time_s, self.lights)

    def sweep_time_s(self, index: int) -> float | None:
        """Return the time [s] of a laser scan since the previous frame, None without."""
        if self.scanner is None:
            return None
        sweep = int(self.time_s(index) * self.scanner.rate_hz + 1e-6)
        if index > 0 and sweep == int(self.time_s(index - 1) * self.scanner.rate_hz + 1e-6):
            return None
        return sweep / self.scanner.rate_hz


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedFrame:
    """Measurements of camera and laser at one frame."""

    image_bgr: NDArray[np.uint8]  # (H, W, 3)
    depth_mm: NDArray[np.uint16]  # (H, W), 0 = missing
    ranges_m: NDArray[np.float32] | None  # (beams,), inf: no return


class Photographer:
    """Renders any frame of a shot, with the same result in every process."""

    def __init__(self, shot: Shot) -> None:
        self._shot = shot
        self._caster = RayCaster(shot.place.panels)
        self._noise = NoiseTable(np.random.default_rng([shot.seed, _FRAME_STREAM]))
        self._eye = CameraRenderer(shot.place, shot.light, self._caster, shot.camera)

    def take(self, index: int) -> SimulatedFrame:
        """Return frame `index`."""
        shot, time_s = self._shot, self._shot.time_s(index)
        T_gt_cam = shot.path.pose(time_s) @ shot.camera.T_base_cam
        view = self._eye.look(T_gt_cam, shot.levels(time_s))
        self._add_people(view, time_s, T_gt_cam)
        rng = np.random.default_rng([shot.seed, _FRAME_STREAM, index])
        return SimulatedFrame(
            image_bgr=expose(view, self._noise, rng, self._shutter(index)),
            depth_mm=measure_depth(view, shot.camera, self._noise, rng),
            ranges_m=self._sweep(index),
        )

    def _add_people(self, view: RenderedView, time_s: float, T_gt_cam: Transform) -> None:
        shot, rays = self._shot, self._eye.directions
        add_people(view, shot.place.people, time_s, T_gt_cam, rays, shot.levels(time_s))

    def _shutter(self, index: int) -> Shutter:
        """Return a frame's exposure; a fixed one is as sharp as an instant.

        Motion blur of an automatic one is due to rotation only, as driving is slow.
        """
        shot, settings = self._shot, self._shot.exposure
        if not settings.is_automatic:
            return Shutter()
        time_ratio, gain = split(float(shot.exposures[index]), settings)
        T_base_cam = shot.camera.T_base_cam
        turn_cam = T_base_cam[:3, :3].T @ shot.path.turn_rates_radps(shot.time_s(index))
        open_s = time_ratio * settings.nominal_s
        motion_px = (-turn_cam[1] * shot.camera.fx * open_s, turn_cam[0] * shot.camera.fy * open_s)
        return Shutter(time_ratio=time_ratio, gain=gain, motion_px=motion_px)

    def _sweep(self, index: int) -> NDArray[np.float32] | None:
        """Return the ranges (beams,) [m] of a frame's scan, all beams at once; None without."""
        time_s, scanner = self._shot.sweep_time_s(index), self._shot.scanner
        if time_s is None or scanner is None:
            return None
        T_gt_laser = self._shot.path.pose(time_s) @ scanner.laser().T_base_laser
        angles_rad = scanner.angles_rad()
        ways_laser = np.stack([np.cos(angles_rad), np.sin(angles_rad), 0 * angles_rad], axis=1)
        rays = np.empty((len(angles_rad), 6), np.float32)
        rays[:, :3], rays[:, 3:] = T_gt_laser[:3, 3], ways_laser @ T_gt_laser[:3, :3].T
        rng = np.random.default_rng([self._shot.seed, _SWEEP_STREAM, index])
        noise_m = scanner.noise_m * rng.standard_normal(len(rays), dtype=np.float32)
        reach = reach_people(self._shot.place.people, time_s, rays)
        ranges_m = np.minimum(self._caster.first_hits(rays).reach, reach) + noise_m
        near_m, far_m = scanner.range_m
        returned = (ranges_m >= near_m) & (ranges_m <= far_m)
        return np.where(returned, ranges_m, np.inf).astype(np.float32)


def meter(shot: Shot, count: int) -> list[NDArray[np.float32]]:
    """Return the grey values of a coarse pixel grid (N,) of each frame, before exposure."""
    eye = CameraRenderer(shot.place, shot.light, RayCaster(shot.place.panels), shot.camera)
    step_px = max(1, shot.camera.size_wh[0] // 32)
    greys: list[NDArray[np.float32]] = []
    for time_s in map(shot.time_s, range(count)):
        T_gt_cam = shot.path.pose(time_s) @ shot.camera.T_base_cam
        greys.append(eye.meter(T_gt_cam, shot.levels(time_s), step_px))
    return greys


def build_place(kind: str, seed: int, order: int | None) -> SimulatedPlace:
    """Return a place: `two_rooms`, `sunny_rooms`, `bare_rooms`, `corridor` or `building`."""
    rng = np.random.default_rng([seed, _PLACE_STREAM, 0])
    if kind == "building":
        return building.build(rng, order)
    if kind == "corridor":
        return rooms.corridor(rng)
    return rooms.two_rooms(rng, sunny=kind == "sunny_rooms", bare=kind == "bare_rooms")


def floor_plan(kind: str, order: int | None) -> BuildingLayout:
    """Return the layout of a story's place."""
    return building.floor_plan(order) if kind == "building" else rooms.floor_plan()


def light_place(place: SimulatedPlace, seed: int) -> LightMap:
    """Return the light map of a place."""
    rng = np.random.default_rng([seed, _PLACE_STREAM, 1])
    return bake(place, RayCaster(place.panels), rng)
