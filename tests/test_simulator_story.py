"""The simulator's stories: the drive, the light and what is true of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_simulator_building import EXPOSURE

from sceneslam.sources.simulator.optics.camera import CameraRenderer
from sceneslam.sources.simulator.optics.lighting import LightMap
from sceneslam.sources.simulator.optics.rays import RayCaster
from sceneslam.sources.simulator.places.place import SimulatedPlace
from sceneslam.sources.simulator.robot.motion import (
    STEP_HZ,
    Drive,
    Face,
    Path,
    Shift,
    Wait,
    advance,
    plan,
)
from sceneslam.sources.simulator.robot.wheels import SimulatedGyro, WheelOdometry
from sceneslam.sources.simulator.settings import (
    CameraSettings,
    GyroSettings,
    OdometrySettings,
)
from sceneslam.sources.simulator.shot import Shot, build_place, floor_plan, light_place, meter
from sceneslam.sources.simulator.stories import STORIES
from sceneslam.sources.simulator.truth import changes_of, scene_at
from sceneslam.types import se3

_RATE_HZ = 10.0
_CAMERA = CameraSettings(
    size_wh=(48, 36),
    fov_deg=57.0,
    rate_hz=_RATE_HZ,
    depth_range_m=(0.4, 4.5),
    height_m=0.45,
    forward_m=0.0,
    tilt_deg=3.0,
).camera()
_CHANGES = {
    "bright_to_dark": ["Bright", "Dark"],
    "dark_to_bright": ["Dark", "Bright"],
    "there_and_back": ["Bright", "Dark", "Bright"],
    "lights_out": ["Bright", "Dark"],
    "flicker": ["Bright"],
    "white_wall": ["Bright"],
    "dark_corridor": ["Bright", "Dark"],
    "depth_dropout": ["Bright"],
}


@cache
def path_of(story: str) -> Path:
    return plan(STORIES[story].start_x_y_deg, STORIES[story].moves)


@cache
def place_of(kind: str) -> SimulatedPlace:
    return build_place(kind, seed=0, order=None)


@cache
def light_of(kind: str) -> LightMap:
    return light_place(place_of(kind), seed=0)


@cache
def greys_of(story: str, lights: str = "story") -> np.ndarray:
    """Return the true grey means at a low rate, by a small camera."""
    kind = STORIES[story].place
    eye = CameraRenderer(place_of(kind), light_of(kind), RayCaster(place_of(kind).panels), _CAMERA)
    path = path_of(story)
    greys = []
    for time_s in np.arange(0.0, path.duration_s, 1.0 / _RATE_HZ).tolist():
        levels = STORIES[story].levels(place_of(kind).groups, time_s, lights)
        seen = eye.look(path.pose(time_s) @ _CAMERA.T_base_cam, levels).image_bgr
        image = np.minimum(seen, 255.0)
        greys.append(float((image @ [0.114, 0.587, 0.299]).mean()))
    return np.array(greys)


def true_scenes(story: str, lights: str = "story") -> list[tuple[float, str]]:
    """Return the true changes of a story: (time [s], scene)."""
    rooms, path = floor_plan(STORIES[story].place, None), path_of(story)
    times_s = np.arange(0.0, path.duration_s, 1.0 / _RATE_HZ)
    scenes = []
    for time_s in times_s.tolist():
        levels = STORIES[story].levels(("a", "b", "night", "sun"), time_s, lights)
        scenes.append(scene_at(rooms, path.pose(time_s), levels) or "nowhere")
    changes = changes_of((times_s * 1e9).astype(np.int64), scenes)
    return [(change.stamp_ns / 1e9, change.scene) for change in changes]


def names(changes: list[tuple[float, str]]) -> list[str]:
    return [scene for _, scene in changes]


@pytest.mark.parametrize("story", STORIES)
def test_the_robot_keeps_its_limits_and_stands_still_first(story: str) -> None:
    speed, turn = np.abs(path_of(story).speed_turn.T)
    assert np.all(speed[:STEP_HZ] == 0.0)
    assert np.all(turn[:STEP_HZ] == 0.0)
    assert speed.max() <= 0.5
    assert turn.max() <= np.deg2rad(60)
    assert 20.0 <= path_of(story).duration_s <= (60.0 if story == "there_and_back" else 35.0)


@pytest.mark.parametrize("story", STORIES)
def test_the_robot_touches_nothing(story: str) -> None:
    caster, path = RayCaster(place_of(STORIES[story].place).panels), path_of(story)
    at = np.repeat(path.x_y_yaw[:: STEP_HZ // 5, :2], 72 * 3, axis=0)
    turns = np.tile(np.repeat(np.deg2rad(np.arange(0, 360, 5)), 3), len(at) // 216)
    heights = np.tile([0.03, 0.2, 0.45], len(at) // 3)
    zero = np.zeros_like(turns)
    rays = np.stack([*at.T, heights, np.cos(turns), np.sin(turns), zero], axis=1)
    assert caster.first_hits(rays.astype(np.float32)).reach.min() > 0.2


def test_poses_between_steps_lie_on_the_arc_of_the_step() -> None:
    path = path_of("bright_to_dark")
    index = 2400
    between = path.pose((index + 0.5) / STEP_HZ)
    expected = advance(path.x_y_yaw[index], *path.speed_turn[index], 0.5 / STEP_HZ)
    assert np.allclose(between, se3.from_xy_yaw(*expected), atol=1e-12)


@given(speed=st.floats(-0.5, 0.5), turn=st.floats(-1.0, 1.0), duration=st.floats(0.0, 2.0))
def test_two_arcs_of_the_same_speeds_make_one(speed: float, turn: float, duration: float) -> None:
    start = np.array([1.0, 2.0, 0.3])
    once = advance(start, speed, turn, duration)
    twice = advance(advance(start, speed, turn, duration / 2), speed, turn, duration / 2)
    assert np.allclose(once, twice, atol=1e-12)


def test_moves_end_where_they_say() -> None:
    moves = (Wait(0.5), Drive(((2.0, 0.0), (2.0, 1.5))), Face(180.0), Shift(-0.4))
    path = plan((0.0, 0.0, 0.0), moves)
    x_m, y_m, yaw_rad = path.x_y_yaw[-1]
    assert np.allclose([x_m, y_m], [2.4, 1.5], atol=0.06)
    assert abs(np.cos(yaw_rad) + 1.0) < 1e-5


@pytest.mark.parametrize("story", STORIES)
def test_zones_and_lamps_make_the_scenes_that_the_story_tells(story: str) -> None:
    assert names(true_scenes(story)) == _CHANGES[story]


def test_the_scene_changes_a_metre_before_the_middle_of_the_wall() -> None:
    (_, _), (time_s, _) = true_scenes("bright_to_dark")
    x_m = path_of("bright_to_dark").pose(time_s)[0, 3]
    assert x_m == pytest.approx(4.1, abs=0.06)  # it comes at a slant


@pytest.mark.slow
@pytest.mark.parametrize(
    "story", ["bright_to_dark", "dark_to_bright", "there_and_back", "dark_corridor"]
)
def test_no_door_is_seen_through_before_the_true_scene_changes(story: str) -> None:
    greys, changes = greys_of(story), true_scenes(story)
    seen_s = (np.flatnonzero(np.diff(greys[20:] > 100)) + 21) / _RATE_HZ
    delays_s = seen_s - [time_s for time_s, _ in changes[1:]]
    assert np.all(delays_s > -0.5)  # far less than the 2 s that confirm a scene
    assert np.all(delays_s < 2.5)


def test_the_scene_changes_when_half_the_light_has_gone() -> None:
    (_, _), (time_s, _) = true_scenes("lights_out")
    assert time_s == pytest.approx(12.1, abs=0.051)


@pytest.mark.parametrize(("lights", "scene"), [("on", "Bright"), ("off", "Dark")])
def test_with_the_lights_kept_on_or_off_the_scene_never_changes(lights: str, scene: str) -> None:
    assert names(true_scenes("there_and_back", lights)) == [scene]


@pytest.mark.slow
@pytest.mark.parametrize("story", ["bright_to_dark", "there_and_back", "lights_out", "flicker"])
def test_the_image_shows_the_true_scene_but_for_door_passages(story: str) -> None:
    greys, changes = greys_of(story), true_scenes(story)
    starts_s = np.array([time_s for time_s, _ in changes])
    times_s = np.arange(len(greys)) / _RATE_HZ
    scenes = np.array(names(changes))[np.searchsorted(starts_s, times_s, "right") - 1]
    away = np.abs(times_s[:, None] - starts_s[None, 1:]).min(axis=1, initial=np.inf) > 3.0
    differ = np.count_nonzero(away & ((greys > 100) != (scenes == "Bright"))) / _RATE_HZ
    assert differ <= (2.9 if story == "flicker" else 0.3)  # a flicker is no scene


@pytest.mark.slow
@pytest.mark.parametrize("story", STORIES)
def test_lit_views_are_well_above_the_threshold_of_the_paper(story: str) -> None:
    greys = greys_of(story)
    bright = greys[greys > 115]
    between = np.count_nonzero((greys <= 112) & (greys > 60)) / _RATE_HZ
    assert 115 < np.median(bright) < 195
    assert between < 1.2 * (len(_CHANGES[story]) - 1) + 0.5


@pytest.mark.slow
@pytest.mark.parametrize("story", ["bright_to_dark", "there_and_back", "lights_out"])
def test_dark_parts_are_dark_for_long_but_never_black(story: str) -> None:
    greys = greys_of(story)
    assert np.count_nonzero(greys < 60) / _RATE_HZ >= 5.0
    assert np.median(greys[greys < 60]) < 30
    assert greys.min() > 2.0


@pytest.mark.slow
def test_the_grey_mean_falls_within_two_seconds_as_in_figure_5() -> None:
    greys = greys_of("bright_to_dark")
    last_bright = np.flatnonzero(greys > 125)[-1]
    first_dark = np.flatnonzero(greys < 32)[0]
    assert 0.5 <= (first_dark - last_bright) / _RATE_HZ <= 2.0


def test_flicker_never_lasts_a_second() -> None:
    story = STORIES["flicker"]
    levels = [
        story.levels(("a", "b"), time_s, "story")["a"] for time_s in np.arange(0.0, 21.0, 0.01)
    ]
    off = np.diff(np.flatnonzero(np.diff(np.array(levels) < 0.5)))[::2] * 0.01
    assert len(off) >= 4
    assert off.min() >= 0.1
    assert off.max() < 1.0


def test_each_frame_is_metered_in_its_own_light() -> None:
    place = replace(place_of("two_rooms"), cell_m=0.6)
    shot = Shot(
        story=STORIES["flicker"],
        lights="story",
        seed=0,
        path=path_of("flicker"),
        rate_hz=_RATE_HZ,
        camera=_CAMERA,
        scanner=None,
        place=place,
        light=light_place(place, seed=0),
        exposure=EXPOSURE,
        exposures=np.ones(60),
    )
    means = [float(grey.mean()) for grey in meter(shot, 60)]
    dark = [index for index, mean in enumerate(means) if mean < 60.0]
    assert dark == [41, 42]  # the lamp fails from 4.0 to 4.3 s


def changes(scenes: list[str]) -> list[tuple[float, str]]:
    stamps_ns = (np.arange(len(scenes)) * 1e9 / _RATE_HZ).astype(np.int64)
    return [(change.stamp_ns / 1e9, change.scene) for change in changes_of(stamps_ns, scenes)]


def test_an_excursion_of_less_than_a_second_is_no_scene() -> None:
    assert changes(["Bright"] * 50 + ["Dark"] * 9 + ["Bright"] * 50) == [(0.0, "Bright")]


def test_an_excursion_of_a_second_is_a_scene() -> None:
    told = changes(["Bright"] * 50 + ["Dark"] * 10 + ["Bright"] * 50)
    assert told == [(0.0, "Bright"), (5.0, "Dark"), (6.0, "Bright")]


def odometry_settings(**changes: Any) -> OdometrySettings:
    perfect = {"scale_error_ratio": 0.0, "unequal_ratio": 0.0, "noise_ratio": 0.0}
    rest = {"wheel_base_m": 0.23, "slips_per_minute": 0.0, "slip_m": 0.05}
    honest = {"lie": "none", "lies_per_minute": 1.0, "lie_s": 2.0}
    return OdometrySettings(**(perfect | rest | honest | changes))


def gyro_settings(**changes: float) -> GyroSettings:
    perfect = {"bias_radps": 0.0, "noise_radps": 0.0, "bias_walk_radps_per_sqrt_s": 0.0}
    return GyroSettings(**({"rate_hz": 100.0} | perfect | changes))


def test_perfect_wheels_give_the_true_motion() -> None:
    path = path_of("bright_to_dark")
    odometry = WheelOdometry(path, odometry_settings(), np.random.default_rng(0))
    T_gt_odom = path.pose(0.0) @ se3.inverse(odometry.pose(0.0))
    for time_s in (0.0, 5.0, 12.34, 20.0):
        assert np.allclose(T_gt_odom @ odometry.pose(time_s), path.pose(time_s), atol=1e-3)


def test_a_scale_error_stretches_the_way() -> None:
    path = plan((0.0, 0.0, 0.0), (Drive(((4.0, 0.0),)),))
    settings = odometry_settings(scale_error_ratio=0.01)
    odometry = WheelOdometry(path, settings, np.random.default_rng(0))
    way_m = odometry.pose(path.duration_s)[0, 3] / path.pose(path.duration_s)[0, 3]
    assert way_m == pytest.approx(1.01, abs=1e-6)


def test_slips_make_odometry_jump_ahead_of_the_robot() -> None:
    path = plan((0.0, 0.0, 0.0), (Drive(((4.0, 0.0),)),))
    settings = odometry_settings(slips_per_minute=60.0)
    odometry = WheelOdometry(path, settings, np.random.default_rng(0))
    assert odometry.pose(path.duration_s)[0, 3] > path.pose(path.duration_s)[0, 3] + 0.05


def test_the_gyro_integrates_to_the_true_turn_but_for_its_bias() -> None:
    path = path_of("there_and_back")
    settings = gyro_settings(noise_radps=0.003)
    samples = SimulatedGyro(path, settings, np.random.default_rng(0)).samples(-1.0, path.duration_s)
    turned_rad = samples[:, 3].sum() / 100.0
    assert turned_rad == pytest.approx(path.x_y_yaw[-1, 2] - path.x_y_yaw[0, 2], abs=0.02)
