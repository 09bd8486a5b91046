"""A map at the reported poses: a grid of laser or depth scans, and coloured points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.depth_scan import DepthScanner, scan_frame
from sceneslam.scans.occupancy_grid import OccupancyGrid
from sceneslam.types.errors import ConfigError
from sceneslam.types.lens import undistorted_rays
from sceneslam.types.maps import GridLayer, HybridMap, MovedMap, PointLayer
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform, apply, inverse

_KEY_BITS = 21  # of a voxel's index along each axis
_SCANS = 5000  # kept at most, as of 500 m of path; beyond, half as many for any metre of it
_BLOCK = 1 << 16  # points that are moved at a time
_UNSEEN_BGR = (160, 160, 160)  # of points without a camera


class GridAndPoints:
    """Adds every observation once; loops and a loaded map move what was added."""

    sensors = frozenset({Sensor.SCAN, Sensor.DEPTH})

    def __init__(self, resolution_m: float, voxel_m: float, depth_stride_px: int) -> None:
        if not voxel_m > 0:
            raise ConfigError("voxel_m", voxel_m, "above 0 [m]")
        if depth_stride_px < 1:
            raise ConfigError("depth_stride_px", depth_stride_px, "1 or more")
        self._resolution_m, self._voxel_m = resolution_m, voxel_m
        self._stride = depth_stride_px

    def open(self, rig: Rig) -> None:
        """Start with an empty map."""
        self._rig, self._grid = rig, OccupancyGrid(self._resolution_m)
        self._loaded: Callable[[], GridLayer | None] | None = None  # draws what is beneath scans
        self._scans: list[LaserScan] = []
        self._T_map_laser: list[Transform] = []  # of each scan
        self._count, self._step = 0, 1  # scans so far; every so many, one is kept
        self._is_moved = False  # so that the grid has to be drawn anew
        self._keys = np.zeros(0, np.int64)  # of the voxels with a point, sorted
        self._points, self._colors = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        self._owners = np.zeros(0, np.int32)  # of each point: the depth image that it is from
        self._stamps_ns: list[int] = []  # of these
        self._poses: list[Transform] = []  # T_map_base
        self._scanner: DepthScanner | None = None
        if rig.camera is not None:  # with the paper's range of heights
            self._scanner = DepthScanner(rig.camera, beams=180, stride_px=2)

    def add(self, observation: Observation, T_map_base: Transform, T_map_then: Transform) -> None:
        """Add an observation at T_map_base (4, 4) [m]; at its scan's stamp, base was T_map_then."""
        camera, laser = self._rig.camera, self._rig.laser
        if observation.scan is not None and laser is not None:
            self._add_scan(observation.scan, T_map_then @ laser.T_base_laser)
        elif observation.depth_m is not None and camera is not None and self._scanner is not None:
            scan = self._scanner.scan(observation.depth_m, stamp_ns=observation.stamp_ns)
            self._add_scan(scan, T_map_base @ scan_frame(camera))
        if observation.depth_m is not None and camera is not None:
            self._add_depth(observation, T_map_base)

    def move(self, moved: MovedMap) -> None:
        """Move scans and points with the poses that they were seen from."""
        self._loaded, self._is_moved = moved.loaded, True
        if self._scans:
            stamps_ns = np.array([scan.stamp_ns for scan in self._scans], np.int64)
            self._T_map_laser = list(moved.moved(stamps_ns, np.array(self._T_map_laser)))
        if not self._poses:
            return
        before = np.array(self._poses)
        after = moved.moved(np.array(self._stamps_ns, np.int64), before)
        T_new_old = (after @ inverse(before)).astype(np.float32)
        for start in range(0, len(self._points), _BLOCK):
            block = slice(start, start + _BLOCK)
            T = T_new_old[self._owners[block]]
            turned = np.einsum("nij,nj->ni", T[:, :3, :3], self._points[block])
            self._points[block] = turned + T[:, :3, 3]
        self._keys, kept = np.unique(self._keys_of(self._points), return_index=True)
        self._points, self._colors = self._points[kept], self._colors[kept]
        seen, owners = np.unique(self._owners[kept], return_inverse=True)
        self._owners = owners.astype(np.int32)
        self._poses, self._stamps_ns = list(after[seen]), [self._stamps_ns[row] for row in seen]

    def map(self) -> HybridMap:
        """Return a copy of the map."""
        if self._is_moved:
            self._draw_scans()
        return HybridMap(
            points=PointLayer(points=self._points.copy(), colors_bgr=self._colors),
            point_modules=np.zeros(len(self._points), np.uint8),
            modules=("map",),
            grid=self._grid.layer(),
        )

    def _add_scan(self, scan: LaserScan, T_map_laser: Transform) -> None:
        if self._count % self._step == 0:
            self._scans.append(scan)
            self._T_map_laser.append(T_map_laser)
        self._count += 1
        if len(self._scans) > _SCANS:
            self._scans, self._T_map_laser = self._scans[::2], self._T_map_laser[::2]
            self._step *= 2
        if not self._is_moved:
            self._grid.insert(T_map_laser, scan)

    def _draw_scans(self) -> None:
        """Draw the grid anew: the loaded map, and the scans on it."""
        loaded, cell_m = None if self._loaded is None else self._loaded(), self._resolution_m
        self._grid = OccupancyGrid(cell_m) if loaded is None else OccupancyGrid.of(loaded, cell_m)
        self._is_moved = False
        for scan, T_map_laser in zip(self._scans, self._T_map_laser, strict=True):
            self._grid.insert(T_map_laser, scan)

    def _add_depth(self, observation: Observation, T_map_base: Transform) -> None:
        camera, depth_m = self._rig.camera, observation.depth_m
        assert camera is not None and depth_m is not None
        rows, columns = np.mgrid[
            0 : depth_m.shape[0] : self._stride, 0 : depth_m.shape[1] : self._stride
        ]
        depths = depth_m[rows, columns]
        is_measured = camera.measures(depths)
        rows, columns, depths = rows[is_measured], columns[is_measured], depths[is_measured]
        if not len(depths):
            return
        rays = undistorted_rays(camera, np.column_stack([columns, rows]).astype(np.float64))
        known = np.isfinite(rays[:, 0])
        rays, rows, columns, depths = rays[known], rows[known], columns[known], depths[known]
        points_cam = np.column_stack([rays * depths[:, None], depths])
        points = apply(T_map_base @ camera.T_base_cam, points_cam).astype(np.float32)
        colors = np.full((len(points), 3), _UNSEEN_BGR, np.uint8)
        if observation.image_bgr is not None:
            colors = observation.image_bgr[rows, columns]
        if self._add_points(points, colors, owner=len(self._poses)):
            self._stamps_ns.append(observation.stamp_ns)
            self._poses.append(T_map_base)

    def _add_points(
        self, points: NDArray[np.float32], colors: NDArray[np.uint8], *, owner: int
    ) -> bool:
        """Add the points (N, 3) [m], map, of empty voxels; return whether there are any.

        `colors` (N, 3) are theirs, `owner` the image that they are from.
        """
        keys, first = np.unique(self._keys_of(points), return_index=True)
        is_new = ~np.isin(keys, self._keys, assume_unique=True)
        self._keys = np.union1d(self._keys, keys[is_new])
        self._points = np.concatenate([self._points, points[first[is_new]]])
        self._colors = np.concatenate([self._colors, colors[first[is_new]]])
        self._owners = np.append(self._owners, np.full(is_new.sum(), owner, np.int32))
        return bool(is_new.any())

    def _keys_of(self, points: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the voxels (N,) of points (N, 3) [m]."""
        cells = np.floor(points / self._voxel_m).astype(np.int64) + (1 << (_KEY_BITS - 1))
        return np.asarray((cells[:, 0] << 2 * _KEY_BITS) | (cells[:, 1] << _KEY_BITS) | cells[:, 2])
