"""Conversion of depth images to planar laser scans, as in the paper.

The scan's frame `laser` is below (or above) the camera in the plane z = 0 of `base`, with x along
the optical axis: T_base_laser = (camera x, camera y, yaw of the axis). Then a pixel's beam does not
depend on its depth, and a scan needs three look-ups in tables that are computed once per camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.band import checked_band
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.lens import undistorted_rays
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Camera

# Only upright surfaces count as returns: shelves and table tops appear at some distances only.
_UPRIGHT_M, _UPRIGHT_RATIO = 0.1, 1 / 3  # height, absolute or of the band
_NOISE_M, _NOISE_PER_M = 0.005, 0.003  # sigma = a + b * range^2 (triangulation)
_LIMIT_RATIO = 0.1  # of the largest depth: upper bound of the noise margin at the limit
_FARTHEST_M = 1e6  # replaces an infinite limit
_PER_BIN, _RATIO = np.sqrt(_NOISE_M * _NOISE_PER_M), np.sqrt(_NOISE_PER_M / _NOISE_M)


def scan_frame(camera: Camera) -> se3.Transform:
    """Return T_base_laser (4, 4) [m] of scans made from this camera's depth."""
    axis = camera.T_base_cam[:3, 2]
    if np.hypot(axis[0], axis[1]) < 1e-3:  # looks straight up or down: x is up in the image
        axis = -camera.T_base_cam[:3, 1]
    x_m, y_m = camera.T_base_cam[:2, 3]
    return se3.from_xy_yaw(x_m, y_m, float(np.arctan2(axis[1], axis[0])))


class DepthScanner:
    """Converts one camera's depth images to scans: the nearest return per beam within a band."""

    def __init__(
        self,
        camera: Camera,
        *,
        height_min_m: float | None = None,
        height_max_m: float | None = None,
        beams: int,
        stride_px: int,
    ) -> None:
        """Compute tables of each pixel's beam, range and height per metre of depth.

        The band [height_min_m, height_max_m] is above `base`. None: 0.15 m below (above) the
        camera, which is visible at all distances and, on a robot, does not contain the floor.
        """
        height_m = float(camera.T_base_cam[2, 3])
        self.band_m = checked_band(
            height_m, height_min_m=height_min_m, height_max_m=height_max_m, beams=beams
        )
        if stride_px < 1:
            raise ConfigError("stride_px", stride_px, "1 or more")
        self.T_base_laser = scan_frame(camera)
        self._camera, self._beams, self._stride_px = camera, beams, stride_px
        self._camera_height_m = height_m
        self._tabulate()

    def scan(self, depth_m: NDArray[np.float32], *, stamp_ns: int) -> LaserScan:
        """Return the scan of a depth image (H, W) [m] in `laser`.

        A beam without a return in the band is NaN, since missing depth does not mean free space. A
        beam at the camera's depth limit is NaN too: only returns that noise shortens are measured
        there. Raises InputError if the image has another size than the camera.
        """
        self._camera.check_size("depth_m", depth_m)
        depths = depth_m[:: self._stride_px, :: self._stride_px].ravel()[self._pixels]
        heights = self._camera_height_m + self._height_ratio * depths
        valid = self._camera.measures(depths)
        valid &= (heights >= self.band_m[0]) & (heights <= self.band_m[1])
        beam = self._beam[valid]
        ranges_m = (self._range_ratio * depths)[valid]
        heights_m = self._height_per_m[valid] * ranges_m
        nearest_m = self._nearest(beam, depths[valid], ranges_m, heights_m)
        ratio_max = float(self._range_ratio.max(initial=1.0))
        return LaserScan(
            stamp_ns=stamp_ns,
            ranges_m=nearest_m,
            angle_min_rad=self._angle_min_rad + 0.5 * self._step_rad,
            angle_step_rad=self._step_rad,
            range_min_m=0.0,
            range_max_m=self._camera.depth_range_m[1] * ratio_max,
        )

    def _nearest(
        self,
        beam: NDArray[np.int64],
        depths_m: NDArray[np.float32],
        ranges_m: NDArray[np.float32],
        heights_m: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return the mean range (beams,) [m] of each beam's nearest upright surface, NaN without.

        The mean is used as the minimum of many noisy depths would be biased. A surface consists of
        the returns in two neighbouring bins of range; each return adds the height of its pixel.
        """
        depth = (np.arctan(_RATIO * ranges_m) / _PER_BIN).astype(np.int64)
        count = int(depth.max(initial=0)) + 2
        found = np.bincount(beam * count + depth, heights_m, minlength=self._beams * count)
        found = found.reshape(self._beams, count)
        is_upright = found[:, :-1] + found[:, 1:] >= self._upright_m
        # Range of the nearest pair of bins with an upright surface.
        middle_m = np.tan((is_upright.argmax(axis=1) + 1) * _PER_BIN) / _RATIO
        mean_m = np.where(is_upright.any(axis=1), middle_m, np.nan)
        for _ in range(2):  # the first two bins may hold only the nearer half of the noisy returns
            limit_m = 2.0 * (_NOISE_M + _NOISE_PER_M * mean_m * mean_m)
            agrees = np.abs(ranges_m - mean_m[beam]) <= limit_m[beam]
            total_m = np.bincount(beam[agrees], ranges_m[agrees], minlength=self._beams)
            number = np.bincount(beam[agrees], minlength=self._beams)
            mean_m = np.where(number > 0, total_m / np.maximum(number, 1), np.nan)
        # Returns at the depth limit are dropped: only noise brings them into range.
        total_m = np.bincount(beam[agrees], depths_m[agrees], minlength=self._beams)
        scan = np.where(total_m <= self._far_m * number, mean_m, np.nan).astype(np.float32)
        scan.flags.writeable = False
        return scan

    def _tabulate(self) -> None:
        rays_base = _rays_cam(self._camera, self._stride_px) @ self._camera.T_base_cam[:3, :3].T
        low_m, high_m = (limit - self._camera_height_m for limit in self.band_m)
        z_min_m, z_max_m = self._camera.depth_range_m
        z_max_m = min(z_max_m, _FARTHEST_M)
        farthest, nearest = rays_base[:, 2] * z_max_m, rays_base[:, 2] * z_min_m
        # A ray that does not cross the band has no return.
        crosses = (np.minimum(nearest, farthest) <= high_m) & (
            np.maximum(nearest, farthest) >= low_m
        )
        crosses &= (np.abs(rays_base[:, :2]) > 1e-3).any(axis=1)
        if not crosses.any():
            raise ConfigError("height_min_m", self.band_m, "a band that the depth camera sees")
        self._pixels, rays_base = np.flatnonzero(crosses), rays_base[crosses]
        # Each pixel's beam, by its angle about z of base.
        angle = np.arctan2(rays_base[:, 1], rays_base[:, 0]) - se3.yaw_rad(self.T_base_laser)
        angle = (angle + np.pi) % (2 * np.pi) - np.pi
        half_rad = float(np.abs(angle).max()) + 1e-9
        self._angle_min_rad = -half_rad
        self._step_rad = 2 * half_rad / self._beams
        beam = np.floor((angle + half_rad) / self._step_rad).astype(np.int64)
        self._beam = np.clip(beam, 0, self._beams - 1)
        # Range and height per metre of depth.
        self._range_ratio = np.hypot(rays_base[:, 0], rays_base[:, 1]).astype(np.float32)
        self._height_ratio = rays_base[:, 2].astype(np.float32)
        noise_m = _NOISE_M + _NOISE_PER_M * z_max_m * z_max_m
        self._far_m = z_max_m - min(noise_m, _LIMIT_RATIO * z_max_m)
        # A pixel's area on an upright surface at 1 m, as a height over the width of a beam.
        solid = self._stride_px**2 / (self._camera.fx * self._camera.fy)
        self._height_per_m = (solid / self._step_rad / self._range_ratio**3).astype(np.float32)
        self._upright_m = min(_UPRIGHT_M, _UPRIGHT_RATIO * (high_m - low_m))


def _rays_cam(camera: Camera, stride_px: int) -> NDArray[np.float64]:
    """Return the rays (N, 3), z = 1, of every stride-th pixel, without lens distortion."""
    width, height = camera.size_wh
    u, v = np.meshgrid(np.arange(0, width, stride_px), np.arange(0, height, stride_px))
    rays = np.ones((u.size, 3))
    if any(camera.distortion):
        pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
        rays[:, :2] = undistorted_rays(camera, pixels)  # NaN: it does not cross the band
    else:
        rays[:, 0] = (u.ravel() - camera.cx) * (1.0 / camera.fx)
        rays[:, 1] = (v.ravel() - camera.cy) * (1.0 / camera.fy)
    return rays
