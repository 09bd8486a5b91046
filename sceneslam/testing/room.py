"""Simulated observations of a small textured room with all sensors."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Lidar, Rig, Sensor, optical_to_rep103

START_NS = 10**9
WIDTH, HEIGHT, FOCAL = 320, 240, 290.0
HALF_X_M, HALF_Y_M, HALF_Z_M = 3.0, 2.0, 1.2  # walls, floor and ceiling around the origin

CAMERA = Camera(
    size_wh=(WIDTH, HEIGHT), fx=FOCAL, fy=FOCAL, cx=WIDTH / 2, cy=HEIGHT / 2, depth_range_m=(0.3, 8)
)
RIG = Rig(sensors=frozenset(Sensor), camera=CAMERA, laser=Laser(), lidar=Lidar(range_m=(0.2, 20.0)))


@cache
def room_observation(index: int, *, rate_hz: float = 30.0) -> Observation:
    """Return the observation of a robot that drives an arc at 0.3 m/s through the room."""
    t_s = index / rate_hz
    return observation_at(se3.from_xy_yaw(-1.0 + 0.3 * t_s, 0.1 * t_s, 0.15 * t_s), t_s)


def observation_at(T_room_base: se3.Transform, t_s: float) -> Observation:
    """Return the measurements of all sensors at the pose T_room_base (4, 4) [m]."""
    image_bgr, depth_m = _render(T_room_base)
    ranges_m = _hit(T_room_base, _fan())[0]
    cloud = _sphere() * _hit(T_room_base, _sphere())[0][:, None]
    stamp_ns = START_NS + round(t_s * 1e9)
    return Observation(
        stamp_ns=stamp_ns,
        image_bgr=image_bgr,
        depth_m=depth_m,
        scan=LaserScan(
            stamp_ns=stamp_ns,
            ranges_m=ranges_m.astype(np.float32),
            angle_min_rad=-np.pi,
            angle_step_rad=np.pi / 180,
            range_min_m=0.1,
            range_max_m=20.0,
        ),
        points_lidar=cloud.astype(np.float32),
        T_odom_base=T_room_base,
        gyro_base=np.array([[-0.01, 0.0, 0.0, 0.15]]),
        accelerometer_base=np.array([[-0.01, 0.0, 0.0, 9.81]]),
    )


def _render(
    T_room_base: se3.Transform,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return colour (H, W, 3) and depth (H, W) [m] of the room; each wall has its own texture."""
    rays_base = _pixels() @ optical_to_rep103()[:3, :3].T
    scale, wall, surface = _hit(T_room_base, rays_base)
    texel = (surface * 40).astype(int)
    image = _texture()[wall, texel[:, 0] % 400, texel[:, 1] % 400].reshape(HEIGHT, WIDTH, 3)
    depth_m = scale.reshape(HEIGHT, WIDTH).astype(np.float32)
    return np.ascontiguousarray(image), np.round(depth_m, 3)


def _hit(
    T_room_base: se3.Transform, rays_base: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Return per ray: factor to the first wall, the wall's index, and the point on it [m]."""
    rays = rays_base @ T_room_base[:3, :3].T
    origin = T_room_base[:3, 3]
    half = np.array([HALF_X_M, HALF_Y_M, HALF_Z_M])
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = (np.sign(rays) * half - origin) / rays
    factors[rays == 0] = np.inf
    axis = factors.argmin(axis=1)
    factor = factors[np.arange(len(rays)), axis]
    points = origin + rays * factor[:, None]
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    wall = 2 * axis + (rays[np.arange(len(rays)), axis] > 0)
    return factor, wall, np.take_along_axis(points, others, axis=1) + 5.0


@cache
def _texture() -> NDArray[np.uint8]:
    rng = np.random.default_rng(7)
    coarse = rng.integers(20, 236, (6, 100, 100, 3), dtype=np.uint8)
    return np.stack([cv2.resize(c, (400, 400), interpolation=cv2.INTER_NEAREST) for c in coarse])


@cache
def _pixels() -> NDArray[np.float64]:
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


@cache
def _fan() -> NDArray[np.float64]:
    angles = np.arange(360) * np.pi / 180 - np.pi
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(360)], axis=1)


@cache
def _sphere() -> NDArray[np.float64]:
    around, up = np.linspace(-np.pi, np.pi, 200), np.linspace(-0.4, 0.4, 24)
    azimuth, elevation = (one.ravel() for one in np.meshgrid(around, up))
    return np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
