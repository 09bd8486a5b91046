r"""Print what the candidates for frame-to-model depth odometry give and cost.

    python experiments/depth_candidates.py ../shared/data/tum_fr1_rpy \
        ../shared/data/7scenes_redkitchen

VGICP of small_gicp against an incremental voxel map, by three voxel sizes, over whole recordings;
and the ray cast of a volume (OpenCV, Open3D) at 160 x 120, which registration would come after.
Times are CPU time of one core.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import open3d.core as o3c

try:
    import small_gicp
except ImportError as missing:
    raise SystemExit(
        "error: small_gicp is needed: pip install 'sceneslam[candidates]'"
    ) from missing
from depth import open_source

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.modules.slam.clouds import CloudReader
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types.trajectory import Trajectory

RANGE_MAX_M, STRIDE_PX, SAMPLING_M, VOXEL_M = 4.0, 4, 0.04, 0.02
FAR = {"depth_scale": 1.0, "depth_max": RANGE_MAX_M}


def vgicp(source: TumRgbd, voxel_m: float) -> str:
    """Return ATE and time of VGICP with constant velocity."""
    reader = CloudReader(source.rig, depth_range_max_m=RANGE_MAX_M, depth_stride_px=STRIDE_PX)
    voxels = small_gicp.GaussianVoxelMap(voxel_m)
    poses, stamps_ns, spent_ms, step = [np.eye(4)], [], [], np.eye(4)
    for observation in source:
        points = reader.read(observation)
        if points is None:
            continue
        start_s = time.process_time()
        cloud = small_gicp.voxelgrid_sampling(small_gicp.PointCloud(points), SAMPLING_M)
        small_gicp.estimate_covariances(cloud, small_gicp.KdTree(cloud), num_neighbors=10)
        if stamps_ns:
            guess = poses[-1] @ step
            found = small_gicp.align(
                voxels, cloud, init_T_target_source=guess, max_correspondence_distance=0.2
            )
            step = np.linalg.inv(poses[-1]) @ found.T_target_source
            poses.append(found.T_target_source)
        voxels.insert(cloud, poses[-1])
        stamps_ns.append(observation.stamp_ns)
        spent_ms.append(1e3 * (time.process_time() - start_s))
    estimate = Trajectory(stamps_ns=np.array(stamps_ns), T_world_base=np.array(poses))
    truth = source.ground_truth()
    assert truth is not None
    errors = absolute_errors(estimate, truth.trajectory, 0.02)
    return f"ATE {errors.rmse_m:.3f} m, {np.median(spent_ms):.1f} ms"


def cost_ms(call: Callable[[], object]) -> float:
    """Return the median CPU time of five calls."""
    spent = []
    for _ in range(5):
        start_s = time.process_time()
        call()
        spent.append(1e3 * (time.process_time() - start_s))
    return float(np.median(spent))


def volumes(source: TumRgbd) -> None:
    """Print what integrating and casting one quarter-size image costs."""
    first = next(one for one in source if one.depth_m is not None)
    assert first.depth_m is not None and source.rig.camera is not None
    depth_m = np.ascontiguousarray(first.depth_m[::4, ::4])
    K = np.diag([0.25, 0.25, 1.0]) @ source.rig.camera.K
    settings = cv2.VolumeSettings(cv2.VolumeType_HashTSDF)
    for name, value in (
        ("CameraIntegrateIntrinsics", K.astype(np.float32)),
        ("CameraRaycastIntrinsics", K.astype(np.float32)),
        ("IntegrateWidth", 160),
        ("IntegrateHeight", 120),
        ("RaycastWidth", 160),
        ("RaycastHeight", 120),
        ("DepthFactor", 1.0),
        ("VoxelSize", VOXEL_M),
        ("TsdfTruncateDistance", 3 * VOXEL_M),
        ("MaxDepth", RANGE_MAX_M),
    ):
        getattr(settings, f"set{name}")(value)
    volume, pose = cv2.Volume(cv2.VolumeType_HashTSDF, settings), np.eye(4, dtype=np.float32)
    integrate_ms = cost_ms(lambda: volume.integrate(depth_m, pose))
    cast_ms = cost_ms(lambda: volume.raycast(pose))
    print(f"cv2 HashTSDF: integrate {integrate_ms:.1f} ms, ray cast {cast_ms:.1f} ms")
    kinds, lanes = (o3c.float32, o3c.float32), ((1), (1))
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), kinds, lanes, VOXEL_M, 16, 5000, o3c.Device("CPU:0")
    )
    image, k, pose64 = (
        o3d.t.geometry.Image(o3c.Tensor(depth_m)),
        o3c.Tensor(K),
        o3c.Tensor(np.eye(4)),
    )
    blocks = grid.compute_unique_block_coordinates(image, k, pose64, **FAR)
    integrate_ms = cost_ms(lambda: grid.integrate(blocks, image, k, pose64, **FAR))
    cast_ms = cost_ms(
        lambda: grid.ray_cast(blocks, k, pose64, 160, 120, ["vertex", "normal"], **FAR)
    )
    print(f"Open3D VoxelBlockGrid: integrate {integrate_ms:.1f} ms, ray cast {cast_ms:.1f} ms")


def main() -> None:
    """Print all of it."""
    cv2.setNumThreads(1)
    for folder in map(Path, sys.argv[1:]):
        source = open_source(folder)
        for voxel_m in (0.05, 0.1, 0.2):
            print(
                f"{folder.name}, VGICP, voxels of {voxel_m} m: {vgicp(source, voxel_m)}", flush=True
            )
        volumes(source)


if __name__ == "__main__":
    main()
