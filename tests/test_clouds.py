"""Clouds for registration: swept ones made still, and depth images as points."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from sceneslam.modules.slam.clouds import CloudReader
from sceneslam.modules.slam.voxel_cloud import VoxelCloud
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Lidar, Rig, Sensor

CAMERA = Camera(size_wh=(64, 48), fx=52.5, fy=52.5, cx=31.5, cy=23.5)


def test_sweep_is_undone_to_the_stamp():
    rig = Rig(sensors=frozenset({Sensor.POINTS}), lidar=Lidar(range_m=(0.1, 50.0)))
    reader = CloudReader(rig, depth_range_max_m=5.0, depth_stride_px=8)
    twist_s = np.array([2.0, -1.0, 0.5, 0.1, -0.2, 0.9])
    times = np.linspace(0.0, 0.1, 50)
    still = np.random.default_rng(1).uniform(-10, 10, (50, 3))
    swept = np.array(
        [
            se3.apply(se3.inverse(se3.exp(twist_s * time)), point[None])[0]
            for time, point in zip(times, still, strict=True)
        ]
    ).astype(np.float32)
    observation = Observation(stamp_ns=0, points_lidar=swept, point_times_s=times)
    np.testing.assert_allclose(reader.read(observation, twist_s), still, atol=0.02)
    equal = replace(observation, point_times_s=np.full(50, 0.1))
    assert np.isfinite(reader.read(equal, twist_s)).all()
    with pytest.raises(InputError, match="point_times_s: expected 50 values, got 3"):
        reader.read(replace(observation, point_times_s=np.zeros(3)), twist_s)


def test_depth_becomes_points_of_base():
    camera = replace(CAMERA, depth_range_m=(0.0, 8.0))
    rig = Rig(sensors=frozenset({Sensor.DEPTH}), camera=camera)
    reader = CloudReader(rig, depth_range_max_m=5.0, depth_stride_px=4)
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, :32] = [[0.0], [np.nan], [np.inf], [6.0]] * 12
    cloud = reader.read(Observation(stamp_ns=0, depth_m=depth))
    assert len(cloud) == 12 * 8
    np.testing.assert_allclose(cloud[:, 0], 2.0)
    assert (cloud[:, 1] < 0).all()  # the right half of the image lies to the right
    with pytest.raises(InputError, match="depth_m"):
        reader.read(Observation(stamp_ns=0, depth_m=np.zeros((4, 4), np.float32)))


def test_depth_at_pixels_that_no_ray_of_a_folding_lens_reaches_is_missing():
    camera = Camera(
        size_wh=(640, 480),
        fx=340.0,
        fy=340.0,
        cx=319.5,
        cy=239.5,
        distortion=(-0.33, 0.12, 0.0, 0.0, -0.02),
    )
    reader = CloudReader(
        Rig(sensors=frozenset({Sensor.DEPTH}), camera=camera),
        depth_range_max_m=5.0,
        depth_stride_px=8,
    )
    wall_m = np.full((480, 640), 2.0, np.float32)
    cloud = reader.read(Observation(stamp_ns=0, depth_m=wall_m))
    assert 0.8 * 4800 < len(cloud) < 4800
    assert np.linalg.norm(cloud[:, 1:], axis=1).max() < 2.0 * 1.64  # it folds at 1.62


def test_cloud_of_a_place_that_is_seen_again_does_not_grow():
    rng, cloud = np.random.default_rng(0), VoxelCloud(0.1)
    parts = [rng.uniform(0.0, 1.0, (30_000, 3)).astype(np.float32) for _ in range(40)]
    sizes = []
    for part in parts:
        cloud.add(part)
        sizes.append(len(pickle.dumps(cloud)))
    assert max(sizes) < 5 * sizes[0]
    points = np.concatenate(parts)
    first = np.unique(np.floor(points / 0.1).astype(np.int64), axis=0, return_index=True)[1]
    np.testing.assert_array_equal(cloud.points(), points[np.sort(first)])
