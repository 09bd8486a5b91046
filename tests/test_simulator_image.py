"""The simulator's pictures: geometry, light and the sensors' faults."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest

from sceneslam.sources.simulator.optics.camera import CameraRenderer, RenderedView
from sceneslam.sources.simulator.optics.exposure import NOMINAL, Shutter, follow, split
from sceneslam.sources.simulator.optics.lighting import bake
from sceneslam.sources.simulator.optics.noise_table import NoiseTable
from sceneslam.sources.simulator.optics.rays import RayCaster
from sceneslam.sources.simulator.optics.sensor_noise import expose as expose_with
from sceneslam.sources.simulator.optics.sensor_noise import measure_depth as measure_with
from sceneslam.sources.simulator.optics.sheet import pack
from sceneslam.sources.simulator.places.place import Lamp, PanelBuilder, SimulatedPlace
from sceneslam.sources.simulator.places.surfaces import WHITE, fabric, paint
from sceneslam.sources.simulator.settings import ExposureSettings
from sceneslam.types import se3
from sceneslam.types.rig import Camera, optical_to_rep103

_FULL = {"a": 1.0, "sun": 0.0}


_NOISE = NoiseTable(np.random.default_rng(7))


def expose(view: RenderedView, rng: np.random.Generator, shutter: Shutter = NOMINAL) -> Any:
    return expose_with(view, _NOISE, rng, shutter)


def measure_depth(view: RenderedView, cam: Camera, rng: np.random.Generator) -> Any:
    return measure_with(view, cam, _NOISE, rng)


def camera() -> Camera:
    T_base_cam = optical_to_rep103()
    T_base_cam[2, 3] = 1.0
    return Camera(
        size_wh=(160, 120),
        fx=150.0,
        fy=150.0,
        cx=79.5,
        cy=59.5,
        depth_range_m=(0.4, 4.5),
        T_base_cam=T_base_cam,
    )


@pytest.fixture(scope="module")
def room() -> SimulatedPlace:
    """A closed room, 4 x 4 x 2.5 m, with one lamp, a cloth on its east wall and a box."""
    builder, plain = PanelBuilder(np.random.default_rng(0)), paint(WHITE)
    builder.level((0, 4), (0, 4), 0.0, plain)
    builder.level((0, 4), (0, 4), 2.5, plain, faces_up=False)
    corners = [(0, 0), (0, 4), (4, 4), (4, 0), (0, 0)]
    for left, right in pairwise(corners):
        look = fabric((120, 120, 120), 30.0) if left == (4, 4) else plain
        builder.wall(left, right, (0, 2.5), look)
    builder.box((3.0, 1.4), (0.4, 0.4, 1.2), plain, yaw_deg=20)
    lamp = Lamp(group="a", centre_m=(2.0, 2.0, 2.49), size_xy_m=(0.5, 0.5), power=4.0)
    return SimulatedPlace(panels=tuple(builder.panels), lamps=(lamp,))


@pytest.fixture(scope="module")
def eye(room: SimulatedPlace) -> CameraRenderer:
    caster = RayCaster(room.panels)
    return CameraRenderer(room, bake(room, caster, np.random.default_rng(0)), caster, camera())


def look(
    eye: CameraRenderer, x_m: float, y_m: float, yaw_deg: float, level: float = 1.0
) -> RenderedView:
    T_gt_base = se3.from_xy_yaw(x_m, y_m, np.deg2rad(yaw_deg))
    return eye.look(T_gt_base @ camera().T_base_cam, _FULL | {"a": level})


def plain_view(depth_m: float, cosine: float = 1.0, grey: float = 120.0) -> RenderedView:
    shape = (120, 160)
    return RenderedView(
        image_bgr=np.full((*shape, 3), grey, np.float32),
        depth_m=np.full(shape, depth_m, np.float32),
        cosine=np.full(shape, cosine, np.float32),
        blinded=np.zeros(shape, np.bool_),
    )


def test_depth_is_the_distance_along_the_optical_axis(eye: CameraRenderer) -> None:
    view = look(eye, 1.0, 2.0, 180.0)
    assert np.allclose(view.depth_m[40:80], 1.0, atol=1e-4)


def test_two_views_of_one_point_show_the_same_colour(eye: CameraRenderer) -> None:
    first, second = look(eye, 1.0, 3.0, 0.0), look(eye, 1.3, 2.9, 4.0)
    cam = camera()
    T_gt_1 = se3.from_xy_yaw(1.0, 3.0, 0.0) @ cam.T_base_cam
    T_gt_2 = se3.from_xy_yaw(1.3, 2.9, np.deg2rad(4.0)) @ cam.T_base_cam
    v, u = np.mgrid[20:60, 60:120]
    ways = np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones(u.shape)], axis=-1)
    points = (ways * first.depth_m[v, u][..., None]).reshape(-1, 3)
    seen = se3.apply(se3.inverse(T_gt_2) @ T_gt_1, points) @ cam.K.T
    at = (seen[:, :2] / seen[:, 2:]).astype(np.float32).reshape(*u.shape, 2)
    warped = cv2.remap(second.image_bgr, at, None, cv2.INTER_LINEAR)
    correlation = np.corrcoef(warped[..., 1].ravel(), first.image_bgr[v, u, 1].ravel())[0, 1]
    assert correlation > 0.8


def test_light_of_two_levels_adds_up(eye: CameraRenderer) -> None:
    full, half = look(eye, 1.0, 2.0, 0.0), look(eye, 1.0, 2.0, 0.0, level=0.5)
    lit = (full.image_bgr > 20) & (full.image_bgr < 250)
    adds_up = np.isclose((half.image_bgr**2)[lit] * 2.0, (full.image_bgr**2)[lit], rtol=1e-3)
    assert adds_up.mean() > 0.995  # an edge too faint to be softened may differ


def test_the_box_throws_a_shadow(room: SimulatedPlace) -> None:
    light = bake(room, RayCaster(room.panels), np.random.default_rng(0))
    x, across, y, down = light.lookup[0]  # of the floor: u along x, v from y = 4 to 0

    def light_at(x_m: float, y_m: float) -> float:
        column, row = round(x + across * x_m / 4), round(y + down * (4 - y_m) / 4)
        return float(light.irradiance[0, row, column, 1])

    assert light_at(3.5, 1.0) < 0.5 * light_at(3.5, 3.0)  # as far from the lamp, free of the box


def test_plain_walls_hold_no_features(eye: CameraRenderer) -> None:
    image = expose(look(eye, 1.0, 2.0, 180.0), np.random.default_rng(0))
    assert len(cv2.ORB_create(500).detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))) == 0


def test_textured_walls_hold_many_features(eye: CameraRenderer) -> None:
    image = expose(look(eye, 2.2, 3.2, 0.0), np.random.default_rng(0))
    assert len(cv2.ORB_create(500).detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))) > 50


@pytest.mark.parametrize("depth_m", [0.8, 2.0, 4.0])
def test_depth_noise_is_the_published_one(depth_m: float) -> None:
    depth_mm = measure_depth(plain_view(depth_m), camera(), np.random.default_rng(0))
    expected_m = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    assert depth_mm.std() / 1000.0 == pytest.approx(expected_m, rel=0.1)
    assert depth_mm.mean() / 1000.0 == pytest.approx(depth_m, abs=1e-3)


@pytest.mark.parametrize("depth_m", [0.35, 4.7, np.inf])
def test_depth_out_of_range_is_missing(depth_m: float) -> None:
    depth_mm = measure_depth(plain_view(depth_m), camera(), np.random.default_rng(0))
    assert np.count_nonzero(depth_mm) < 0.01 * depth_mm.size


def test_depth_is_missing_at_grazing_angles() -> None:
    steep = plain_view(2.0, cosine=float(np.cos(np.deg2rad(80))))
    assert np.count_nonzero(measure_depth(steep, camera(), np.random.default_rng(0))) == 0


def test_near_things_hide_what_lies_left_of_them_from_the_projector() -> None:
    view = plain_view(3.0)
    view.depth_m[:, 80:100] = 1.0
    depth_mm = measure_depth(view, camera(), np.random.default_rng(0))
    shadow_px = round(150 * 0.075 * (1 / 1.0 - 1 / 3.0))
    assert not depth_mm[:, 80 - shadow_px + 2 : 79].any()
    assert depth_mm[:, 40:70].all()
    assert depth_mm[:, 110:].all()


def test_photon_noise_is_even_in_the_light_and_read_noise_wins_in_the_dark() -> None:
    rng = np.random.default_rng(0)
    spread = {g: expose(plain_view(2.0, grey=g), rng).std() for g in (30.0, 120.0, 220.0)}
    assert spread[120.0] == pytest.approx(spread[220.0], rel=0.1)
    assert spread[30.0] > 1.05 * spread[120.0]
    assert expose(plain_view(2.0, grey=120.0), rng).mean() == pytest.approx(120.0, abs=0.5)


def test_depth_and_colour_from_planes_are_those_of_a_ray_per_pixel(
    room: SimulatedPlace, eye: CameraRenderer
) -> None:
    view, cam, caster = look(eye, 1.0, 2.0, 0.0), camera(), RayCaster(room.panels)
    T_gt_cam = se3.from_xy_yaw(1.0, 2.0, 0.0) @ cam.T_base_cam
    v, u = np.mgrid[0:120, 0:160]
    ways = np.stack([(u - cam.cx) / cam.fx, (v - cam.cy) / cam.fy, np.ones(u.shape)], axis=-1)
    rays = np.empty((u.size, 6), np.float32)
    rays[:, :3], rays[:, 3:] = T_gt_cam[:3, 3], ways.reshape(-1, 3) @ T_gt_cam[:3, :3].T
    hits = caster.first_hits(rays)
    assert np.allclose(view.depth_m.ravel(), hits.reach, atol=1e-4)
    normals = np.repeat([panel.normal for panel in room.panels], 2, axis=0)[hits.triangle]
    cosine = np.abs((normals * rays[:, 3:]).sum(axis=1)) / np.linalg.norm(rays[:, 3:], axis=1)
    assert np.allclose(view.cosine.ravel(), cosine, atol=1e-4)


def test_polish_and_sunlight_take_the_depth_away() -> None:
    half = np.zeros((120, 160), np.bool_)
    half[:60] = True
    view = replace(plain_view(2.0), blinded=half)
    depth_mm = measure_depth(view, camera(), np.random.default_rng(0))
    assert not depth_mm[:60].any()
    assert depth_mm[60:].all()


def exposure(**changes: Any) -> ExposureSettings:
    usual = {"is_automatic": True, "target_grey": 120.0, "lag_s": 0.4, "nominal_s": 0.01}
    limits = {"range_s": (0.001, 0.02), "gain_max": 2.0}
    return ExposureSettings(**(usual | limits | changes))


def test_exposure_follows_the_light_with_its_lag_and_within_its_limits() -> None:
    greys = [np.full(9, grey, np.float32) for grey in [120.0] * 30 + [60.0] * 60 + [5.0] * 60]
    exposures = follow(greys, exposure(), rate_hz=30.0)
    assert exposures[29] == pytest.approx(1.0, abs=0.01)
    assert exposures[30 + 12] == pytest.approx(4.0 ** (1 - np.exp(-1)), rel=0.05)  # a lag later
    assert exposures[89] == pytest.approx(4.0, rel=0.02)
    assert exposures[-1] == 4.0  # 20 ms of 10, twice amplified; 576 would be needed
    assert split(4.0, exposure()) == (2.0, 2.0)
    assert split(0.5, exposure()) == (0.5, 1.0)


def test_a_fixed_exposure_is_the_nominal_one() -> None:
    greys = [np.full(9, grey, np.float32) for grey in (120.0, 5.0)]
    assert follow(greys, exposure(is_automatic=False), 30.0).tolist() == [1.0, 1.0]


def test_exposure_brightens_the_image_and_gain_its_noise() -> None:
    rng, view = np.random.default_rng(0), plain_view(2.0, grey=40.0)
    plain, longer = expose(view, rng), expose(view, rng, Shutter(time_ratio=4.0))
    amplified = expose(view, rng, Shutter(gain=4.0))
    assert longer.mean() == pytest.approx(80.0, abs=0.5)
    assert amplified.mean() == pytest.approx(2.0 * plain.mean(), rel=0.02)
    assert amplified.std() > 1.8 * longer.std()


def test_turning_smears_the_image_along_its_motion_only() -> None:
    view = plain_view(2.0, grey=0.0)
    view.image_bgr[60, 80] = 255.0
    image = expose(view, np.random.default_rng(0), Shutter(motion_px=(8.0, 0.0))).astype(float)
    assert image[60, 76:85].mean() > 4.0 * image[50, 76:85].mean()
    assert image[63, 80].mean() < 2.0 * image[50, 76:85].mean()


def test_packed_blocks_do_not_overlap() -> None:
    size_wh = np.random.default_rng(0).integers(2, 40, (60, 2))
    sheet = pack(size_wh, 128)
    taken = np.zeros(sheet.shape, np.uint8)
    for index, (wide, high) in enumerate(size_wh):
        sheet.paste(taken, index, np.ones((high, wide), np.uint8) + taken[sheet.window(index)])
    assert taken.max() == 1
