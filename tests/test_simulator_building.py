"""The simulated building: in every zone the sensors fail that fail there in the world."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sceneslam.sources.simulator import stories
from sceneslam.sources.simulator.optics.camera import CameraRenderer, RenderedView
from sceneslam.sources.simulator.optics.exposure import Shutter, split
from sceneslam.sources.simulator.optics.noise_table import NoiseTable
from sceneslam.sources.simulator.optics.people import add_people, reach_people
from sceneslam.sources.simulator.optics.rays import RayCaster
from sceneslam.sources.simulator.optics.sensor_noise import expose, measure_depth
from sceneslam.sources.simulator.places import building
from sceneslam.sources.simulator.places.building import floor_plan
from sceneslam.sources.simulator.places.walker import Walker
from sceneslam.sources.simulator.robot.motion import STEP_HZ, Drive, Path, plan
from sceneslam.sources.simulator.robot.wheels import SimulatedGyro, WheelOdometry
from sceneslam.sources.simulator.settings import (
    CameraSettings,
    ExposureSettings,
    GyroSettings,
    OdometrySettings,
)
from sceneslam.sources.simulator.shot import light_place
from sceneslam.sources.simulator.truth import changes_of, scene_at
from sceneslam.types import se3
from sceneslam.types.rig import optical_to_rep103

_RATE_HZ = 2.0
_CAMERA = CameraSettings(
    size_wh=(64, 48),
    fov_deg=57.0,
    rate_hz=15.0,
    depth_range_m=(0.4, 5.0),
    height_m=0.45,
    forward_m=0.0,
    tilt_deg=3.0,
).camera()
EXPOSURE = ExposureSettings(
    is_automatic=True,
    target_grey=120.0,
    lag_s=0.4,
    nominal_s=0.01,
    range_s=(0.0001, 0.02),
    gain_max=1.0,
)
_WHEELS = OdometrySettings(
    wheel_base_m=0.23,
    scale_error_ratio=0.0,
    unequal_ratio=0.0,
    noise_ratio=0.0,
    slips_per_minute=0.0,
    slip_m=0.0,
    lie="none",
    lies_per_minute=1.0,
    lie_s=4.0,
)
_GYRO = GyroSettings(rate_hz=100.0, bias_radps=0.0, noise_radps=0.0, bias_walk_radps_per_sqrt_s=0.0)


@cache
def tour(order: int | None = None) -> Path:
    story = stories.find("office_tour", order)
    return plan(story.start_x_y_deg, story.moves, floor_plan(order).floor)


def zone_of(x_m: float, y_m: float, order: int | None = None) -> str:
    return next((zone.name for zone in floor_plan(order).zones if zone.holds(x_m, y_m)), "")


@pytest.fixture(scope="module")
def measured() -> dict[str, list[tuple[float, float]]]:
    """Return (grey mean, share of pixels with depth) along the tour, by zone; settled exposure."""
    place = replace(building.build(np.random.default_rng(0), None), cell_m=0.6)
    eye = CameraRenderer(place, light_place(place, 0), RayCaster(place.panels), _CAMERA)
    story, noise = stories.find("office_tour", None), NoiseTable(np.random.default_rng(0))
    levels = story.levels(place.groups, 0.0, "story")
    found: dict[str, list[tuple[float, float]]] = {}
    for time_s in np.arange(0.0, tour().duration_s, 1.0 / _RATE_HZ).tolist():
        T_gt_base = tour().pose(time_s)
        view = eye.look(T_gt_base @ _CAMERA.T_base_cam, levels)
        most = EXPOSURE.range_s[1] / EXPOSURE.nominal_s
        lit = (EXPOSURE.target_grey / max(float(view.image_bgr.mean()), 1.0)) ** 2
        time_ratio, gain = split(min(lit, most), EXPOSURE)
        rng = np.random.default_rng(0)
        image = expose(view, noise, rng, Shutter(time_ratio=time_ratio, gain=gain))
        depth_mm = measure_depth(view, _CAMERA, noise, rng)
        x_m, y_m = T_gt_base[:2, 3].tolist()
        found.setdefault(zone_of(x_m, y_m), []).append((image.mean(), (depth_mm > 0).mean()))
    return found


@pytest.mark.parametrize(
    ("zone", "grey", "depth"),
    [
        ("office", (95, 135), (0.3, 1.0)),
        ("twin_a", (95, 135), (0.5, 1.0)),
        ("twin_b", (95, 135), (0.5, 1.0)),
        ("hall", (95, 135), (0.0, 0.05)),
        ("corridor", (95, 135), (0.3, 1.0)),
        ("atrium", (80, 145), (0.0, 0.02)),
        ("ramp", (95, 135), (0.2, 1.0)),
        ("store", (2, 40), (0.3, 1.0)),
        ("bare", (2, 40), (0.5, 1.0)),
    ],
)
def test_camera_and_depth_work_where_they_should(
    measured: Any, zone: str, grey: tuple[float, float], depth: tuple[float, float]
) -> None:
    greys, depths = np.median(measured[zone], axis=0)
    assert grey[0] <= greys <= grey[1]
    assert depth[0] <= depths <= depth[1]


@pytest.mark.parametrize("order", [None, 0])
def test_the_tour_is_long_closed_and_keeps_to_its_limits(order: int | None) -> None:
    x_y = tour(order).x_y_yaw[:, :2]
    length_m = np.linalg.norm(np.diff(x_y, axis=0), axis=1).sum()
    assert 150.0 <= length_m <= (200.0 if order is None else 280.0)
    assert 240.0 <= tour(order).duration_s <= 480.0
    assert np.linalg.norm(x_y[-1] - x_y[0]) < 0.1
    assert np.abs(tour(order).speed_turn[:, 0]).max() <= 0.6 + 1e-9


@pytest.mark.parametrize("order", [None, 0])
def test_every_zone_is_passed_and_the_robot_is_always_in_one(order: int | None) -> None:
    passed = [zone_of(x, y, order) for x, y, _ in tour(order).x_y_yaw[::STEP_HZ].tolist()]
    assert set(passed) == {zone.name for zone in floor_plan(order).zones}


def test_another_order_of_the_rooms_is_another_building() -> None:
    orders = [tuple(zone.name for zone in floor_plan(order).zones) for order in (None, 0, 1, 2)]
    assert len(set(orders)) == 4
    assert len({frozenset(order) for order in orders}) == 1


def test_the_true_scene_is_dark_in_the_two_zones_whose_lamps_are_off() -> None:
    story, zones = stories.find("office_tour", None), floor_plan(None).zones
    levels = story.levels({zone.group for zone in zones}, 0.0, "story")
    poses = [tour().pose(time_s) for time_s in np.arange(0.0, tour().duration_s, 0.5).tolist()]
    scenes = [scene_at(floor_plan(None), T_gt_base, levels) or "nowhere" for T_gt_base in poses]
    changes = changes_of(np.arange(len(scenes)) * 500_000_000, scenes)
    assert [change.scene for change in changes] == ["Bright", "Dark", "Bright", "Dark", "Bright"]
    for T_gt_base, scene in zip(poses, scenes, strict=True):
        near_m = T_gt_base[:2, 3] + [[0.0, 0.0], 1.05 * T_gt_base[:2, 0]]
        dark = [zone_of(x, y) in ("store", "bare") for x, y in near_m.tolist()]
        assert (scene == "Dark") in dark


def test_the_robot_climbs_eight_degrees_and_comes_down_again() -> None:
    poses = np.stack([tour().pose(time_s) for time_s in np.arange(0.0, tour().duration_s, 0.5)])
    pitch_deg = np.rad2deg(np.arcsin(-poses[:, 2, 0]))
    assert pitch_deg.max() == pytest.approx(8.0, abs=0.2)
    assert pitch_deg.min() == pytest.approx(-8.0, abs=0.2)
    assert poses[:, 2, 3].max() == pytest.approx(4.0 * np.tan(np.deg2rad(8.0)), abs=0.01)
    assert np.count_nonzero(poses[:, 2, 3] > 0.02) < 0.15 * len(poses)


def test_wheels_measure_the_slope_and_turn_in_vain_on_a_slippery_floor() -> None:
    odometry = WheelOdometry(tour(), _WHEELS, np.random.default_rng(0))
    times_s = np.arange(0.0, tour().duration_s, 0.1)
    true = np.stack([tour().pose(time_s)[:3, 3] for time_s in times_s])
    told = np.stack([odometry.pose(time_s)[:3, 3] for time_s in times_s])
    steps = [np.linalg.norm(np.diff(way, axis=0), axis=1) for way in (true, told)]
    zones = np.array([zone_of(x, y) for x, y, _ in true[:-1].tolist()])
    excess = {name: (steps[1] - steps[0])[zones == name].sum() for name in set(zones.tolist())}
    assert excess["bare"] == pytest.approx(0.0, abs=0.01)
    assert excess["corridor"] == pytest.approx(0.0, abs=0.01)
    for slippery in ("store", "atrium", "hall"):
        assert 0.15 < excess[slippery] < 2.5  # in all: a fifth or a third of some metres


@pytest.mark.parametrize(
    ("lie", "factor"), [("reversed", -1.0), ("frozen", 0.0), ("slipping", 3.0)]
)
def test_wheels_that_lie_report_another_way_for_a_while(lie: str, factor: float) -> None:
    path = plan((0.0, 0.0, 0.0), (Drive(((6.0, 0.0),), 0.5),))
    lying = replace(_WHEELS, lie=lie, lies_per_minute=0.0, lie_s=4.0)
    told = WheelOdometry(path, lying, np.random.default_rng(3))
    true = WheelOdometry(path, _WHEELS, np.random.default_rng(3))
    times_s = np.arange(0.0, path.duration_s, 0.1)
    steps = np.diff([[one.pose(time_s)[0, 3] for time_s in times_s] for one in (told, true)])
    moving = steps[1] > 1e-3
    lied = ~np.isclose(steps[0], steps[1], atol=1e-6) & moving
    assert lied.sum() * 0.1 == pytest.approx(4.0, abs=0.25)
    assert np.median(steps[0][lied] / steps[1][lied]) == pytest.approx(factor, abs=1e-6)


def test_the_gyro_feels_the_ramp_and_its_bias_walks() -> None:
    clean = SimulatedGyro(tour(), _GYRO, np.random.default_rng(0)).samples(-1.0, tour().duration_s)
    assert np.abs(clean[:, 2]).max() > 0.1  # pitch, at the ramp's foot
    walking = replace(_GYRO, bias_walk_radps_per_sqrt_s=1e-3)
    walked = SimulatedGyro(tour(), walking, np.random.default_rng(0)).samples(
        -1.0, tour().duration_s
    )
    assert np.std((walked - clean)[-1000:, 3]) < 3e-3
    assert 1e-3 < np.abs((walked - clean)[-1, 1:]).max() < 0.1


def test_nobody_walks_where_the_robot_drives() -> None:
    (person,) = building.build(np.random.default_rng(0), None).people
    x_y = tour().x_y_yaw[:: STEP_HZ // 10, :2]
    nearest_m = [
        np.linalg.norm(x_y - person.position_m(time_s), axis=1).min()
        for time_s in np.arange(0.0, 5.0, 0.2)
    ]
    assert min(nearest_m) > 0.6
    assert np.ptp([person.position_m(time_s)[0] for time_s in (0.0, 1.0)]) > 0.3


def test_a_person_is_seen_by_image_and_depth() -> None:
    person = Walker(start_m=(3.0, 0.0), end_m=(3.0, 1.0), group="a", light=0.5)
    shape = (_CAMERA.size_wh[1], _CAMERA.size_wh[0])
    view = RenderedView(
        image_bgr=np.zeros((*shape, 3), np.float32),
        depth_m=np.full(shape, 4.0, np.float32),
        cosine=np.zeros(shape, np.float32),
        blinded=np.ones(shape, np.bool_),
    )
    x, y = np.meshgrid(np.arange(shape[1]) - _CAMERA.cx, np.arange(shape[0]) - _CAMERA.cy)
    ways = np.dstack([x / _CAMERA.fx, y / _CAMERA.fy, np.ones(shape)]).astype(np.float32)
    T_gt_cam = se3.from_parts(optical_to_rep103()[:3, :3], np.array([0.0, 0.0, 1.0]))
    add_people(view, [person], 0.0, T_gt_cam, ways, {"a": 1.0})
    middle = shape[0] // 2, shape[1] // 2
    assert view.depth_m[middle] == pytest.approx(2.8, abs=0.01)  # its front
    assert view.image_bgr[middle].min() > 0 and not view.blinded[middle]
    assert view.depth_m[middle[0], 0] == 4.0 and view.blinded[middle[0], 0]  # beside it
    rays = np.array([[0, 0, 1.0, 1, 0, 0], [0, 0, 1.0, 0, 1, 0]], np.float32)
    assert reach_people([person], 0.0, rays).tolist() == pytest.approx([2.8, np.inf])
