"""The map layers: a coloured cloud, and scans from the keyframes' depth."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.depth_scan import DepthScanner
from sceneslam.scans.occupancy_grid import scan_layer
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import MapLayers, PointLayer, ScanLayer
from sceneslam.types.rig import Camera

from ..see.lens import undistorted
from ..settings import RgbdSettings
from .keyframes import DepthView, Keyframe, nothing_seen

_LOG = logging.getLogger(__name__)
_BEAMS = 180
_SCAN_STRIDE_PX = 4
_PLANAR_HEIGHT_M = 0.15  # a robot on a floor stays within this of its first height
_PLANAR_TILT_RAD = 0.15


class LayerBuilder:
    """Keeps the part of every keyframe's depth that the map layers need; builds them on demand."""

    def __init__(self, camera: Camera, settings: RgbdSettings) -> None:
        self._camera, self._settings = camera, settings
        stride_px = settings.cloud_stride_px
        self._sampled = 2 * (slice(stride_px // 2, None, stride_px),)
        width, height = camera.size_wh
        v, u = (axis[self._sampled] for axis in np.mgrid[:height, :width].astype(np.float64))
        uv_image = np.stack([u, v], axis=-1)
        self._uv_px = undistorted(camera, uv_image.reshape(-1, 2)).reshape(uv_image.shape)
        self._has_ray = np.isfinite(self._uv_px).all(axis=-1)
        self._scanner = _make_scanner(camera)

    def view(
        self, depth_m: NDArray[np.float32] | None, image_bgr: NDArray[np.uint8], *, stamp_ns: int
    ) -> DepthView:
        """Return the part of a depth image (H, W) [m] for the layers: every stride-th pixel."""
        if depth_m is None:
            return nothing_seen()
        camera, depth = self._camera, depth_m[self._sampled]
        row, column = np.nonzero(camera.measures(depth) & self._has_ray)
        z = depth[row, column]
        u, v = self._uv_px[row, column].T
        x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
        points_cam = np.stack([x, y, z], axis=1).astype(np.float32)
        points_base = se3.apply(camera.T_base_cam, points_cam).astype(np.float32)
        scan = None if self._scanner is None else self._scanner.scan(depth_m, stamp_ns=stamp_ns)
        colors_bgr = image_bgr[self._sampled][row, column]
        return DepthView(
            points_base=points_base, colors_bgr=colors_bgr, pixels=depth.size, scan=scan
        )

    def build(self, keyframes: Sequence[Keyframe]) -> MapLayers:
        """Return the layers in `local`; scans only for planar motion."""
        return MapLayers(points=self._points(keyframes), scans=self._scans(keyframes))

    def _points(self, keyframes: Sequence[Keyframe]) -> PointLayer | None:
        if not keyframes:
            return None
        points = np.concatenate([se3.apply(k.T_local_base, k.view.points_base) for k in keyframes])
        colors_bgr = np.concatenate([k.view.colors_bgr for k in keyframes])
        points, colors_bgr = _thin_by_voxel(points, colors_bgr, self._settings.cloud_voxel_m)
        points.flags.writeable = colors_bgr.flags.writeable = False
        return PointLayer(points=points, colors_bgr=colors_bgr)

    def _scans(self, keyframes: Sequence[Keyframe]) -> ScanLayer | None:
        if self._scanner is None or not keyframes:
            return None
        poses = np.stack([keyframe.T_local_base for keyframe in keyframes])
        tilt_rad = np.arccos(np.clip(poses[:, 2, 2], -1.0, 1.0))
        if np.abs(poses[:, 2, 3]).max() > _PLANAR_HEIGHT_M or tilt_rad.max() > _PLANAR_TILT_RAD:
            return None
        scans = [(k.view.scan, k.T_local_base) for k in keyframes if k.view.scan is not None]
        return scan_layer(
            [scan for scan, _ in scans],
            [T_local_base @ self._scanner.T_base_laser for _, T_local_base in scans],
            cell_m=self._settings.grid_resolution_m,
        )


def _make_scanner(camera: Camera) -> DepthScanner | None:
    try:
        return DepthScanner(camera, beams=_BEAMS, stride_px=_SCAN_STRIDE_PX)
    except ConfigError as error:
        _LOG.warning("no occupancy grid from this camera's depth: %s", error)
        return None


def _thin_by_voxel(
    points: NDArray[np.floating], colors_bgr: NDArray[np.uint8], voxel_m: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return one point per voxel: the mean of its points (M, 3) and of their colours (M, 3)."""
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    spans = cells.max(axis=0, initial=0) + 1
    flat = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    _, voxel, counts = np.unique(flat, return_inverse=True, return_counts=True)
    columns = np.concatenate([points, colors_bgr], axis=1).T
    sums = np.stack([np.bincount(voxel, weights=column) for column in columns], axis=1)
    means = sums / counts[:, None]
    return means[:, :3].astype(np.float32), np.rint(means[:, 3:]).astype(np.uint8)
