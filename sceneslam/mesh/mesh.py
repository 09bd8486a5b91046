"""A coloured mesh from depth images with known poses: truncated signed distances (Open3D)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.config.build import make_source
from sceneslam.config.check import first_line
from sceneslam.config.component import ComponentBuilder
from sceneslam.evaluation.association import covered, interpolated
from sceneslam.interfaces import Live, Source
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.files import own
from sceneslam.types.lens import undistortion_maps
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import TRUTH_GAP_S

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]  # columns and rows

_STEP_M, _STEP_RAD = 0.1, 0.15  # smallest motion between two used images
_BLOCKS = 20_000  # initial number of blocks of 16 x 16 x 16 voxels
_PIXELS_MIN = 100  # valid depths: Open3D refuses images without any
_WEIGHT_MIN = 2.0  # smallest number of images that show a surface


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColouredDepthImage:
    """A depth image with its colours and pose."""

    depth_m: NDArray[np.float32]  # (H, W), 0 = missing
    image_bgr: NDArray[np.uint8]  # (H, W, 3)
    T_map_cam: Transform


@dataclass(frozen=True, slots=True, kw_only=True)
class Meshed:
    """The properties of the written mesh."""

    path: Path
    views: int
    triangles: int


def write_mesh(folder: Path, voxel_m: float, allowed: Sequence[str] = ()) -> Meshed:
    """Write `map/mesh.ply` (x y z [m, map], colours) of a run; return its properties.

    The recording is read again; the poses of its images are those of `trajectory.tum`. `allowed`
    names the packages of the user that may hold its source. Raises ConfigError or InputError if
    the run or its recording cannot be read, or has no depth, FileExistsError if there is a mesh
    that no run wrote.
    """
    source = _source(folder, allowed)
    camera = source.rig.camera
    if camera is None:
        raise InputError(f"mesh: the run's source has no depth camera: {folder}")
    trajectory = Trajectory.read_tum(folder / "trajectory.tum")
    if len(trajectory) < 2:
        raise InputError(f"mesh: the run's trajectory has fewer than two poses: {folder}")
    path = own(folder / "map" / "mesh.ply")
    volume = Volume(camera, voxel_m)
    count = 0
    for view in views(source, trajectory, camera):
        volume.add(view)
        count += 1
    if count == 0:
        raise InputError(f"mesh: no depth image has a pose: {folder}")
    return Meshed(path=path, views=count, triangles=volume.write(path))


def views(
    observations: Iterable[Observation], trajectory: Trajectory, camera: Camera
) -> Iterator[ColouredDepthImage]:
    """Yield the depth images along a trajectory, one per 0.1 m or 9 degrees.

    Images of a time without poses, as after tracking was lost, are left out.
    """
    last: Transform | None = None
    maps = undistortion_maps(camera, camera) if any(camera.distortion) else None
    for one in observations:
        stamp_ns = np.array([one.stamp_ns])
        if one.depth_m is None or not len(covered(trajectory, stamp_ns, TRUTH_GAP_S)):
            continue
        T_map_base = interpolated(trajectory, stamp_ns).T_world_base[0]
        if last is not None and not _is_apart(last, T_map_base):
            continue
        last = T_map_base
        view = _view(one, T_map_base @ camera.T_base_cam, camera, maps)
        if np.count_nonzero(view.depth_m) > _PIXELS_MIN:
            yield view


class Volume:
    """A truncated signed distance field on a grid of voxels."""

    def __init__(self, camera: Camera, voxel_m: float) -> None:
        self._open3d = _load_open3d()
        core = self._open3d.core
        self._camera = camera
        self._device = core.Device("CPU:0")
        self._K = core.Tensor(camera.K)
        self._grid: Any = self._open3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(core.float32, core.float32, core.float32),
            attr_channels=((1), (1), (3)),
            voxel_size=voxel_m,
            block_resolution=16,
            block_count=_BLOCKS,
            device=self._device,
        )

    def add(self, view: ColouredDepthImage) -> None:
        """Fuse a depth image (Curless and Levoy, SIGGRAPH 1996)."""
        image = self._open3d.t.geometry.Image
        depth = image(np.ascontiguousarray(view.depth_m))
        color = image(np.ascontiguousarray(view.image_bgr[..., ::-1], dtype=np.float32) / 255.0)
        T_cam_map = self._open3d.core.Tensor(se3.inverse(view.T_map_cam))
        limits = (1.0, self._camera.depth_range_m[1])  # metres per unit, and the farthest
        blocks = self._grid.compute_unique_block_coordinates(depth, self._K, T_cam_map, *limits)
        self._grid.integrate(blocks, depth, color, self._K, T_cam_map, *limits)

    def write(self, path: Path) -> int:
        """Write the surface as a binary PLY; return its number of triangles."""
        mesh = self._grid.extract_triangle_mesh(_WEIGHT_MIN)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = own(path.with_suffix(".part.ply"))
        if not self._open3d.t.io.write_triangle_mesh(str(part), mesh):
            raise InputError(f"mesh: cannot be written: {path}")
        part.replace(path)
        return int(mesh.triangle.indices.shape[0])


def _view(
    one: Observation, T_map_cam: Transform, camera: Camera, maps: Maps | None
) -> ColouredDepthImage:
    """Return the observation's images, undistorted by the maps; depth out of range is missing."""
    assert one.depth_m is not None
    depth_m = np.where(camera.measures(one.depth_m), one.depth_m, 0.0).astype(np.float32)
    grey = np.full((*depth_m.shape, 3), 128, np.uint8)
    image_bgr = grey if one.image_bgr is None else one.image_bgr
    if maps is not None:
        depth_m = np.asarray(cv2.remap(depth_m, *maps, cv2.INTER_NEAREST), np.float32)
        image_bgr = np.asarray(cv2.remap(image_bgr, *maps, cv2.INTER_LINEAR), np.uint8)
    return ColouredDepthImage(depth_m=depth_m, image_bgr=image_bgr, T_map_cam=T_map_cam)


def _is_apart(T_map_first: Transform, T_map_second: Transform) -> bool:
    T_first_second = se3.inverse(T_map_first) @ T_map_second
    moved_m = float(np.linalg.norm(T_first_second[:3, 3]))
    return moved_m > _STEP_M or float(se3.rotation_angle_rad(T_first_second)) > _STEP_RAD


def _source(folder: Path, allowed: Sequence[str]) -> Source:
    """Return the source of a finished run; its file cannot allow code of its own."""
    for name in ("config.yaml", "trajectory.tum"):
        if not (folder / name).is_file():
            raise InputError(f"mesh: not the folder of a finished run, {name} is missing: {folder}")
    try:
        config = yaml.safe_load((folder / "config.yaml").read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = first_line(error)
        raise InputError(f"mesh: config.yaml cannot be read ({reason}): {folder}") from error
    if not isinstance(config, dict):
        raise InputError(f"mesh: config.yaml is not a table: {folder}")
    source = make_source(config, ComponentBuilder(config | {"allow_targets": list(allowed)}))
    if isinstance(source, Live) and source.live is not None:
        raise InputError(f"mesh: the run's source is live and cannot be read again: {folder}")
    return source


def _load_open3d() -> Any:
    try:
        import open3d
    except ImportError as err:
        raise InputError(
            f"a mesh needs Open3D, which cannot be loaded ({err}); "
            "on Debian or Ubuntu type: sudo apt-get install -y libegl1 libgl1 libusb-1.0-0"
        ) from err
    return open3d
