"""Somebody walks through the view, nearer than the room, and nothing else changes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_effects import film
from test_source_ordered import Listed

from sceneslam.interfaces import Source
from sceneslam.sources.changes.passer_by import PasserBy
from sceneslam.testing.room import CAMERA, RIG
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation

WIDTH, HEIGHT = CAMERA.size_wh
AWAY_M = 1.0
WALKS = {  # half of the view's height, an eighth of its width
    "width_m": WIDTH / CAMERA.fx / 8,
    "height_m": HEIGHT / CAMERA.fy / 2,
    "distance_m": AWAY_M,
    "speed_mps": WIDTH / CAMERA.fx * 9 / 8,  # crosses the view in one second
    "pause_s": 1.0,
    "seed": 3,
}


def passed(source: Source, **changes: Any) -> list[Observation]:
    return list(PasserBy(source, **WALKS | changes))


def seconds(depth_m: float = 2.0) -> Listed:
    """Return four seconds at 10 Hz before a wall."""
    image_bgr = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    wall_m = np.full((HEIGHT, WIDTH), depth_m, np.float32)
    first = Observation(stamp_ns=10**9, image_bgr=image_bgr, depth_m=wall_m)
    stamps_ns = 10**9 + 10**8 * np.arange(40)
    return Listed([replace(first, stamp_ns=int(stamp_ns)) for stamp_ns in stamps_ns], rig=RIG)


def columns(observation: Observation) -> np.ndarray:
    """Return the columns in which somebody is seen."""
    assert observation.depth_m is not None and observation.image_bgr is not None
    is_near = observation.depth_m == np.float32(AWAY_M)
    assert (is_near == (observation.image_bgr < 255).any(axis=2)).all()
    return np.flatnonzero(is_near.any(axis=0))


def test_somebody_crosses_the_view_and_comes_back() -> None:
    seen = [columns(one) for one in passed(seconds())]
    assert not len(seen[0])
    assert not any(len(one) for one in seen[11:20]) and not any(len(one) for one in seen[31:])
    there, back = ([one.mean() for one in seen[k : k + 7]] for k in (2, 22))
    assert np.diff(there) == pytest.approx(WIDTH * 9 / 80, abs=1.0)
    assert np.diff(back) == pytest.approx(-WIDTH * 9 / 80, abs=1.0)
    assert all(len(one) == pytest.approx(WIDTH / 8, abs=1.0) for one in seen[2:9])


def test_the_room_around_and_what_is_nearer_stay_as_recorded() -> None:
    before, after = list(seconds()), passed(seconds())
    rows = np.flatnonzero((after[5].depth_m == np.float32(AWAY_M)).any(axis=1))
    assert len(rows) == pytest.approx(HEIGHT / 2, abs=1.0)
    assert rows.mean() == pytest.approx(CAMERA.cy, abs=1.0)
    assert (before[5].depth_m == 2.0).all() and (before[5].image_bgr == 255).all()
    assert not any(len(columns(one)) for one in passed(seconds(depth_m=0.9)))


def test_where_depth_is_missing_somebody_is_seen() -> None:
    assert len(columns(passed(seconds(depth_m=0.0))[5]))


def test_without_depth_the_image_alone_is_changed() -> None:
    source = Listed([replace(one, depth_m=None) for one in seconds()], rig=RIG)
    one = passed(source)[5]
    assert one.depth_m is None and one.image_bgr is not None
    assert (one.image_bgr < 255).any()


def test_the_seed_alone_chooses_the_pattern() -> None:
    images = [passed(seconds(), seed=seed)[5].image_bgr for seed in (3, 3, 4)]
    assert (images[0] == images[1]).all()
    assert (images[0] != images[2]).any()


def test_a_picture_of_another_size_is_passed_on() -> None:
    small = replace(next(iter(seconds())), image_bgr=np.zeros((10, 10, 3), np.uint8))
    assert passed(Listed([small], rig=RIG)) == [small]


def test_a_camera_without_intrinsics_is_named() -> None:
    with pytest.raises(InputError, match="intrinsics"):
        passed(Listed([], rig=replace(RIG, camera=None)))


@pytest.mark.parametrize(
    "key, value",
    [
        ("width_m", 0),
        ("height_m", -1),
        ("height_m", float("inf")),
        ("distance_m", 0),
        ("speed_mps", 0),
        ("speed_mps", float("nan")),
        ("pause_s", -1),
        ("seed", -1),
    ],
)
def test_wrong_values_are_named_by_their_key(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key):
        PasserBy(film(), **WALKS | {key: value})
