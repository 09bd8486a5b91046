"""The simulator's stories: the drive, the light and what is true of them."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.sources.two_rooms.camera import Eye
from sceneslam.sources.two_rooms.lighting import LightMap
from sceneslam.sources.two_rooms.motion import (
    STEP_HZ,
    Drive,
    Face,
    Path,
    Shift,
    Wait,
    advance,
    plan,
)
from sceneslam.sources.two_rooms.place import Place
from sceneslam.sources.two_rooms.rays import RayCaster
from sceneslam.sources.two_rooms.settings import CameraSettings, GyroSettings, OdometrySettings
from sceneslam.sources.two_rooms.shot import build_place, light_place
from sceneslam.sources.two_rooms.stories import STORIES
from sceneslam.sources.two_rooms.truth import scenes_of
from sceneslam.sources.two_rooms.wheels import Gyro, WheelOdometry
from sceneslam.types import se3

_RATE_HZ = 10.0
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
def place_of(kind: str) -> Place:
    return build_place(kind, seed=0)


@cache
def light_of(kind: str) -> LightMap:
    return light_place(place_of(kind), seed=0)


@cache
def greys_of(story: str, lights: str = "story") -> np.ndarray:
    """Return the true grey means at a low rate, by a small camera."""
    kind = STORIES[story].place
    camera = CameraSettings(
        size_wh=(48, 36),
        fov_deg=57.0,
        rate_hz=_RATE_HZ,
        depth_range_m=(0.4, 4.5),
        height_m=0.45,
        forward_m=0.0,
        tilt_deg=3.0,
    ).camera()
    eye = Eye(place_of(kind), light_of(kind), RayCaster(place_of(kind).panels), camera)
    path = path_of(story)
    greys = []
    for time_s in np.arange(0.0, path.duration_s, 1.0 / _RATE_HZ).tolist():
        levels = STORIES[story].levels(time_s, lights)
        image = eye.look(path.pose(time_s) @ camera.T_base_cam, levels).image_bgr
        greys.append(float((image @ [0.114, 0.587, 0.299]).mean()))
    return np.array(greys)


def scenes(greys: list[float] | np.ndarray, rate_hz: float = _RATE_HZ) -> list[str]:
    stamps_ns = (np.arange(len(greys)) * 1e9 / rate_hz).astype(np.int64)
    return [change.scene for change in scenes_of(stamps_ns, list(greys))]


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


@pytest.mark.slow
@pytest.mark.parametrize("story", STORIES)
def test_the_light_makes_the_scenes_that_the_story_tells(story: str) -> None:
    assert scenes(greys_of(story)) == _CHANGES[story]


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


@pytest.mark.slow
def test_with_all_lights_on_the_whole_way_is_bright() -> None:
    assert scenes(greys_of("there_and_back", "on")) == ["Bright"]


@pytest.mark.slow
def test_with_all_lights_off_the_whole_way_is_dark() -> None:
    assert scenes(greys_of("bright_to_dark", "off")) == ["Dark"]


def test_flicker_never_lasts_a_second() -> None:
    story = STORIES["flicker"]
    levels = [story.levels(time_s, "story")["a"] for time_s in np.arange(0.0, 21.0, 0.01)]
    off = np.diff(np.flatnonzero(np.diff(np.array(levels) < 0.5)))[::2] * 0.01
    assert len(off) >= 4
    assert off.min() >= 0.1
    assert off.max() < 1.0


def test_short_excursions_are_no_scenes() -> None:
    greys = [130.0] * 50 + [20.0] * 9 + [130.0] * 50
    assert scenes(greys) == ["Bright"]


def test_an_excursion_of_a_second_is_a_scene() -> None:
    greys = [130.0] * 50 + [20.0] * 10 + [130.0] * 50
    assert scenes(greys) == ["Bright", "Dark", "Bright"]


def test_the_change_is_stamped_where_the_light_changes() -> None:
    stamps_ns = np.arange(60, dtype=np.int64) * 100_000_000
    (first, second) = scenes_of(stamps_ns, [100.5] * 30 + [99.5] * 30)
    assert (first.stamp_ns, second.stamp_ns) == (0, 3_000_000_000)


def odometry_settings(**changes: float) -> OdometrySettings:
    perfect = {"scale_error_ratio": 0.0, "unequal_ratio": 0.0, "noise_ratio": 0.0}
    rest = {"wheel_base_m": 0.23, "slips_per_minute": 0.0, "slip_m": 0.05}
    return OdometrySettings(**(perfect | rest | changes))


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
    settings = GyroSettings(rate_hz=100.0, bias_radps=0.0, noise_radps=0.003)
    samples = Gyro(path, settings, np.random.default_rng(0)).samples(-1.0, path.duration_s)
    turned_rad = samples[:, 3].sum() / 100.0
    assert turned_rad == pytest.approx(path.x_y_yaw[-1, 2] - path.x_y_yaw[0, 2], abs=0.02)
