"""One frame of a story: what camera and laser measure, from nothing but the frame's number."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.two_rooms import rooms
from sceneslam.sources.two_rooms.camera import Eye
from sceneslam.sources.two_rooms.lighting import LightMap, bake
from sceneslam.sources.two_rooms.motion import Path
from sceneslam.sources.two_rooms.place import Place
from sceneslam.sources.two_rooms.rays import RayCaster
from sceneslam.sources.two_rooms.sensor_noise import expose, measure_depth
from sceneslam.sources.two_rooms.settings import LaserSettings
from sceneslam.sources.two_rooms.stories import Story
from sceneslam.types.rig import Camera

_PLACE_STREAM, _FRAME_STREAM, _SWEEP_STREAM = 1, 2, 3  # of random numbers, below the seed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shot:
    """All that the frames of a story have in common; passed to every worker."""

    story: Story
    lights: str
    seed: int
    path: Path
    rate_hz: float
    camera: Camera
    scanner: LaserSettings | None  # None: switched off
    place: Place
    light: LightMap

    def time_s(self, index: int) -> float:
        """Return when a frame is taken, since the story's start."""
        return index / self.rate_hz

    def sweep_time_s(self, index: int) -> float | None:
        """Return the time of a laser sweep that ended since the frame before, None without."""
        if self.scanner is None:
            return None
        sweep = int(self.time_s(index) * self.scanner.rate_hz + 1e-6)
        if index > 0 and sweep == int(self.time_s(index - 1) * self.scanner.rate_hz + 1e-6):
            return None
        return sweep / self.scanner.rate_hz


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """What was measured, and what the light truly was."""

    image_bgr: NDArray[np.uint8]  # (H, W, 3)
    depth_mm: NDArray[np.uint16]  # (H, W), 0 = missing
    ranges_m: NDArray[np.float32] | None  # (beams,), inf: no return
    grey_mean: float  # of the noise-free view


class Photographer:
    """Renders any frame of a shot; the same frame is the same bytes, whoever renders it."""

    def __init__(self, shot: Shot) -> None:
        self._shot = shot
        self._caster = RayCaster(shot.place.panels)
        self._eye = Eye(shot.place, shot.light, self._caster, shot.camera)

    def take(self, index: int) -> Frame:
        """Return frame `index`."""
        shot, time_s = self._shot, self._shot.time_s(index)
        T_gt_cam = shot.path.pose(time_s) @ shot.camera.T_base_cam
        view = self._eye.look(T_gt_cam, shot.story.levels(time_s, shot.lights))
        blue, green, red, _ = cv2.mean(view.image_bgr)
        rng = np.random.default_rng([shot.seed, _FRAME_STREAM, index])
        return Frame(
            image_bgr=expose(view, rng),
            depth_mm=measure_depth(view, shot.camera, rng),
            ranges_m=self._sweep(index),
            grey_mean=0.299 * red + 0.587 * green + 0.114 * blue,
        )

    def _sweep(self, index: int) -> NDArray[np.float32] | None:
        """Return the ranges of the sweep that belongs to a frame; its beams leave at once."""
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
        ranges_m = self._caster.first_hits(rays).reach + noise_m
        near_m, far_m = scanner.range_m
        returned = (ranges_m >= near_m) & (ranges_m <= far_m)
        return np.where(returned, ranges_m, np.inf).astype(np.float32)


def build_place(kind: str, seed: int) -> Place:
    """Return a story's place: `two_rooms`, `sunny_rooms`, `bare_rooms` or `corridor`."""
    rng = np.random.default_rng([seed, _PLACE_STREAM, 0])
    if kind == "corridor":
        return rooms.corridor(rng)
    return rooms.two_rooms(rng, sunny=kind == "sunny_rooms", bare=kind == "bare_rooms")


def light_place(place: Place, seed: int) -> LightMap:
    """Return the light of a place."""
    rng = np.random.default_rng([seed, _PLACE_STREAM, 1])
    return bake(place, RayCaster(place.panels), rng)
