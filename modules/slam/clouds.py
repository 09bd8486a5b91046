"""Clouds in `base` from a lidar or a depth image, with motion compensation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.deskew import check_times, moved, valid_times_s
from sceneslam.types import se3
from sceneslam.types.lens import undistorted_rays
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor

Cloud = NDArray[np.float64]  # (N, 3) [m], base


class CloudReader:
    """Reads the clouds of a rig's lidar or, without one, of its depth camera."""

    def __init__(self, rig: Rig, *, depth_range_max_m: float, depth_stride_px: int) -> None:
        """Choose the sensor; `range_m` are its trusted limits, `T_base_sensor` its pose."""
        self.is_depth = Sensor.POINTS not in rig.sensors and rig.camera is not None
        self.range_m = (0.0, 100.0)
        self.T_base_sensor = se3.identity()
        self._stride_px = depth_stride_px
        self._camera = rig.camera
        if self.is_depth and rig.camera is not None:
            near_m, far_m = rig.camera.depth_range_m
            self.range_m = (near_m, min(far_m, depth_range_max_m))
            self.T_base_sensor = rig.camera.T_base_cam
            self._rays_cam = _rays_cam(rig.camera, depth_stride_px)
        elif rig.lidar is not None:
            self.range_m = rig.lidar.range_m
            self.T_base_sensor = rig.lidar.T_base_lidar

    def read(
        self, observation: Observation, twist_s: NDArray[np.float64] | None = None
    ) -> Cloud | None:
        """Return the valid points (N, 3) [m], base; None without.

        Points with times are moved to `base` at the observation's stamp by its twist per second
        `twist_s` (6,), if given.
        """
        found = self._sensed(observation)
        if found is None:
            return None
        valid = self._valid(found)
        points = np.asarray(se3.apply(self.T_base_sensor, found[valid]))
        times_s = observation.point_times_s
        if self.is_depth or times_s is None:
            return points
        check_times(times_s, found)
        return points if twist_s is None else moved(points, valid_times_s(times_s[valid]), twist_s)

    def _sensed(self, observation: Observation) -> Cloud | None:
        if not self.is_depth:
            points = observation.points_lidar
            return None if points is None else points.astype(np.float64)
        if observation.depth_m is None or self._camera is None:
            return None
        self._camera.check_size("depth_m", observation.depth_m)
        start = self._stride_px // 2
        depth = observation.depth_m[start :: self._stride_px, start :: self._stride_px]
        return np.asarray(self._rays_cam * depth.reshape(-1, 1).astype(np.float64))

    def _valid(self, points_sensor: Cloud) -> NDArray[np.bool_]:
        """Return (N,) whether points are valid; a camera's range is along its axis."""
        near_m, far_m = self.range_m
        with np.errstate(invalid="ignore", over="ignore"):
            if self.is_depth:
                reach = points_sensor[:, 2]
                # False for NaN.
                return np.asarray((reach > 0) & (reach >= near_m) & (reach <= far_m))
            square = np.einsum("ij,ij->i", points_sensor, points_sensor)
            return np.asarray((square > 0) & (square >= near_m**2) & (square <= far_m**2))


def _rays_cam(camera: Camera, stride_px: int) -> Cloud:
    """Return the rays (N, 3), z = 1, cam, of every stride-th pixel, without distortion.

    All NaN for pixels without a ray, so that their depth is missing.
    """
    width, height = camera.size_wh
    start = stride_px // 2
    u, v = np.meshgrid(np.arange(start, width, stride_px), np.arange(start, height, stride_px))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
    xy = undistorted_rays(camera, pixels)
    return np.column_stack([xy, np.where(np.isnan(xy[:, 0]), np.nan, 1.0)])
