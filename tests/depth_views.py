"""Depth images of rooms made of planes, with the noise of a camera that triangulates."""

from __future__ import annotations

from functools import cache

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor

WIDTH, HEIGHT = 320, 240
CAMERA = Camera(size_wh=(WIDTH, HEIGHT), fx=290.0, fy=290.0, cx=159.5, cy=119.5)
RIG = Rig(sensors=frozenset({Sensor.DEPTH}), camera=CAMERA)
NOISE_PER_M = 1.4e-3  # of disparity [1/m]; Khoshelham and Elberink 2012: 1.4 mm at 1 m

WALL = ((1, 0, 0, 2.0),)  # (normal, distance) [m] of planes n @ X = d around the origin
CORRIDOR = ((0, 1, 0, 1.0), (0, -1, 0, 1.0), (0, 0, 1, 1.2), (0, 0, -1, 1.0))


def cave(count=20):
    """Return planes on all sides, 2 to 2.4 m away: whatever part is seen holds a camera."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - height**2)
    distance = 2.2 + 0.2 * np.cos(3.0 * angle)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), height, distance])


ROOM = cave()


def depth_image(planes, T_room_base, *, seed=0, noise_per_m=NOISE_PER_M, camera=CAMERA):
    """Return (H, W) float32 [m], 0 beyond 6 m."""
    T_room_cam = T_room_base @ camera.T_base_cam
    normals, distances = np.array(planes)[:, :3], np.array(planes)[:, 3]
    per_m = normals @ T_room_cam[:3, :3] / (distances - normals @ T_room_cam[:3, 3])[:, None]
    disparity = (_rays(camera.size_wh) @ per_m.T.astype(np.float32)).max(axis=1)
    disparity += noise_per_m * np.random.default_rng(seed).standard_normal(
        len(disparity), np.float32
    )
    depth = np.where(disparity > 1 / 6.0, 1.0 / np.maximum(disparity, 1e-3), 0.0)
    width, height = camera.size_wh
    return depth.reshape(height, width).astype(np.float32)


def observe(planes, T_room_base, index, *, odometry=None, rate_hz=30.0):
    """Return one observation of the room."""
    return Observation(
        stamp_ns=10**9 + round(index * 1e9 / rate_hz),
        depth_m=depth_image(planes, T_room_base, seed=index),
        T_odom_base=odometry,
    )


def handheld(index):
    """Return T_room_base of a hand's swaying motion, nothing of it planar."""
    t = index / 30.0
    turn = np.array([0.15 * np.sin(1.7 * t), 0.25 * np.sin(1.1 * t), 0.6 * np.sin(0.9 * t)])
    shift = np.array([0.3 * np.sin(0.8 * t), 0.2 * np.sin(1.3 * t), 0.15 * np.sin(1.9 * t)])
    return se3.from_parts(se3.so3_exp(turn), shift)


@cache
def _rays(size_wh):
    v, u = np.mgrid[: size_wh[1], : size_wh[0]]
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
