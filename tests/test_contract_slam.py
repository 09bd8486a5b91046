"""What every SLAM module in `conf/slam` must do: the contract of `interfaces.SlamModule`."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hydra.utils import instantiate
from isolation import isolating
from omegaconf import OmegaConf
from scenery import RIG, room_observation

from sceneslam.interfaces import SlamModule
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.trajectory import Trajectory

COMPONENTS = sorted((Path(__file__).parents[1] / "conf" / "slam").glob("*.yaml"))
ISOLATED = Path("laser in its own process")
STEPS = 20


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Give the trajectory file that a module may ask for: the room's true poses."""
    path = tmp_path_factory.mktemp("recorded") / "room.tum"
    seen = [room_observation(index) for index in range(STEPS)]
    Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in seen]),
        T_world_base=np.stack([one.T_odom_base for one in seen]),
    ).write_tum(path)
    return path


@pytest.fixture(params=[*COMPONENTS, ISOLATED], ids=lambda path: path.stem)
def make(request, recorded):
    """Give a function that builds the module anew from its YAML; one in a process of its own."""
    node = OmegaConf.load(COMPONENTS[0].parent / f"{request.param.stem.split(' ')[0]}.yaml")
    if OmegaConf.is_missing(node, "path"):
        node.path = str(recorded)
    config = OmegaConf.to_container(OmegaConf.merge({"seed": 0}, {"node": node}), resolve=True)
    build = partial(instantiate, config["node"], _convert_="all")
    if request.param is not ISOLATED:
        yield build
        return
    with isolating() as isolated:
        yield partial(isolated, build)


def drive(module, steps=STEPS):
    return [module.track(room_observation(index)) for index in range(steps)]


def active(make):
    module = make()
    module.activate(RIG)
    module.set_scene("Bright")
    return module


def without_sensors(observation):
    """The sensors speak, but say nothing: black, blind, empty."""
    return replace(
        observation,
        image_bgr=np.zeros_like(observation.image_bgr),
        depth_m=np.zeros_like(observation.depth_m),
        scan=replace(observation.scan, ranges_m=np.full_like(observation.scan.ranges_m, np.nan)),
        points_lidar=np.zeros((0, 3), np.float32),
    )


def test_module_fulfils_the_protocol(make):
    module = make()
    assert isinstance(module, SlamModule)
    assert module.requires and all(isinstance(sensors, frozenset) for sensors in module.requires)


def test_local_is_the_base_at_the_first_observation(make):
    tracking = active(make).track(room_observation(0))
    assert tracking.status is not TrackingStatus.LOST
    np.testing.assert_allclose(tracking.T_local_base, np.eye(4), atol=1e-9)


def test_known_motion_is_followed(make):
    first = room_observation(0).T_odom_base
    for index, tracking in enumerate(drive(active(make))):
        truth = se3.inverse(first) @ room_observation(index).T_odom_base
        error = se3.inverse(truth) @ tracking.T_local_base
        assert tracking.status is not TrackingStatus.LOST
        assert np.linalg.norm(error[:3, 3]) < 0.05
        assert se3.rotation_angle_rad(error) < 0.05


def test_every_answer_is_a_rigid_pose_at_the_observation_stamp(make):
    for index, tracking in enumerate(drive(active(make))):
        rotation = tracking.T_local_base[:3, :3]
        assert tracking.stamp_ns == room_observation(index).stamp_ns
        assert tracking.T_local_base.dtype == np.float64
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) > 0
        if tracking.covariance is not None:
            assert tracking.covariance.shape == (6, 6)
            assert np.linalg.eigvalsh(tracking.covariance).min() >= -1e-12


def test_pose_in_the_map_is_eq_2(make):
    module = active(make)
    T_map_local = se3.from_xy_yaw(4.0, -2.0, 1.0)
    module.set_pose(T_map_local)
    tracking = drive(module)[-1]
    np.testing.assert_allclose(module.get_pose(), T_map_local @ tracking.T_local_base, atol=1e-9)


def test_two_runs_are_identical_to_the_bit(make):
    one, two = drive(active(make)), drive(active(make))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first.T_local_base, second.T_local_base)
        assert first.status is second.status


def test_activation_starts_anew(make):
    module = active(make)
    once = drive(module)
    module.shutdown()
    module.activate(RIG)
    again = drive(module)
    np.testing.assert_array_equal(once[-1].T_local_base, again[-1].T_local_base)


def test_blind_sensors_never_yield_nan(make):
    module = active(make)
    drive(module, 5)
    for index in range(5, 12):
        tracking = module.track(without_sensors(room_observation(index)))
        assert np.isfinite(tracking.T_local_base).all()


def test_blind_from_the_first_observation_is_survived(make):
    module = active(make)
    for index in range(3):
        tracking = module.track(without_sensors(room_observation(index)))
        assert np.isfinite(tracking.T_local_base).all()
    module.get_map()


@pytest.mark.parametrize("field", ["image_bgr", "depth_m", "scan", "points_lidar", "T_odom_base"])
def test_a_silent_sensor_is_survived(make, field):
    module = active(make)
    for index in range(6):
        observation = room_observation(index)
        silent = replace(observation, **{field: None}) if index in (2, 3) else observation
        tracking = module.track(silent)
        assert np.isfinite(tracking.T_local_base).all()


def test_map_is_finite_and_in_local(make):
    module = active(make)
    drive(module)
    layers = module.get_map()
    if layers.points is not None:
        points = layers.points.points
        assert points.dtype == np.float32 and points.shape[1:] == (3,)
        assert np.isfinite(points).all() and np.abs(points).max(initial=0) < 20
    if layers.grid is not None:
        assert layers.grid.log_odds.dtype == np.float32
        assert np.isfinite(layers.grid.log_odds).all()


def test_shutdown_may_be_called_twice_and_keeps_the_map(make):
    module = active(make)
    drive(module, 5)
    before = module.get_map()
    module.shutdown()
    module.shutdown()
    after = module.get_map()
    if before.points is not None:
        np.testing.assert_array_equal(before.points.points, after.points.points)
