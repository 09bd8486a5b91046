"""Scenes by rules: what each feature measures, and which rule speaks."""

import cv2
import numpy as np
import pytest

from sceneslam.modules.detectors.features import (
    corner_count,
    depth_ratio,
    scan_hold,
    usable_ratio,
)
from sceneslam.modules.detectors.rules import Rules
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, LaserScan, Observation
from sceneslam.types.rig import Rig, Sensor

FEATURES = ["grey_mean", "depth_ratio"]
RULES = {
    "dark": {"scene": "Dark", "when": {"grey_mean": [None, 50.0]}},
    "blinded": {
        "scene": "Blinded",
        "when": {"depth_ratio": [None, 0.2], "grey_mean": [100.0, None]},
    },
}


def detector(rules=RULES, features=FEATURES, hysteresis_ratio=0.0, otherwise="Bright", **settings):
    settings = {"hold_s": 0.0, "values": {}, "skip_absent_sensors": False, **settings}
    found = Rules(features, rules, otherwise, hysteresis_ratio, **settings)
    found.activate(Rig(sensors=frozenset()))
    return found


def seen(grey, depth_m=1.0):
    return Observation(
        stamp_ns=3,
        image_bgr=None if grey is None else np.full((40, 60, 3), grey, np.uint8),
        depth_m=None if depth_m is None else np.broadcast_to(np.float32(depth_m), (40, 60)),
    )


def scan_of(points):
    """Return a scan of points (N, 2) at beams of one degree."""
    angles = np.arctan2(points[:, 1], points[:, 0])
    step = float(np.radians(1.0))
    ranges = np.full(360, np.nan, np.float32)
    ranges[np.round((angles + np.pi) / step).astype(int) % 360] = np.hypot(*points.T)
    return LaserScan(
        stamp_ns=0,
        ranges_m=ranges,
        angle_min_rad=-np.pi,
        angle_step_rad=step,
        range_min_m=0.0,
        range_max_m=10.0,
    )


@pytest.mark.parametrize(
    ("grey", "depth_m", "scene"),
    [
        (49, 1.0, "Dark"),
        (50, 1.0, "Bright"),
        (120, 0.0, "Blinded"),
        (90, 0.0, "Bright"),
        (101, 0.0, "Blinded"),
        (99, 0.0, "Bright"),
    ],
)
def test_first_rule_that_holds_names_the_scene(grey, depth_m, scene):
    vote = detector().get_scene(seen(grey, depth_m))
    assert (vote.scene, vote.stamp_ns) == (scene, 3)


def test_a_limit_holds_at_its_low_end_and_not_at_its_high_end():
    half = {"scene": "Half", "when": {"depth_ratio": [0.5, 1.0]}}
    rules = detector(rules={"half": half}, otherwise=None)
    depths_m = [np.repeat([0.0, 1.0], [missing, 60 - missing]) for missing in (31, 30, 1, 0)]
    votes = [rules.get_scene(seen(120, np.tile(row, (40, 1)))).scene for row in depths_m]
    assert votes == [UNSURE, "Half", "Half", UNSURE]


def test_what_was_not_measured_is_no_vote_where_it_matters():
    rules = detector()
    assert rules.get_scene(seen(None, 1.0)).scene == UNSURE
    assert rules.get_scene(seen(20, None)).scene == "Dark"  # told by the first rule already
    assert rules.get_scene(seen(120, None)).scene == UNSURE
    assert detector(otherwise=None).get_scene(seen(90)).scene == UNSURE  # no rule holds


def test_rule_that_is_null_is_left_out():
    rules = detector(rules={**RULES, "dark": None})
    assert rules.scenes == ("Blinded", "Bright")
    assert rules.get_scene(seen(20)).scene == "Bright"


def test_hysteresis_widens_the_limits_of_the_scene_voted_last():
    rules = detector(hysteresis_ratio=0.1)
    assert [rules.get_scene(seen(grey)).scene for grey in (54, 49, 54, 56, 54)] == [
        "Bright",
        "Dark",
        "Dark",
        "Bright",
        "Bright",
    ]


def test_sensors_and_scenes_follow_from_the_rules():
    assert detector().requires == (frozenset({Sensor.IMAGE, Sensor.DEPTH}),)
    assert detector().scenes == ("Dark", "Blinded", "Bright")


def test_usable_pixels_are_neither_black_nor_white():
    image_bgr = np.zeros((10, 10, 3), np.uint8)
    image_bgr[:, 5:] = 128
    image_bgr[:2, 5:] = 255
    assert usable_ratio(image_bgr) == 0.4


def test_corners_are_found_on_texture_and_not_on_a_plain_wall():
    coarse = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    textured = cv2.resize(coarse, (200, 200), interpolation=cv2.INTER_CUBIC)
    assert corner_count(textured) > 20
    assert corner_count(np.full((200, 200, 3), 180, np.uint8)) == 0


def test_depth_that_is_missing_or_broken_is_none():
    depth_m = np.array([[0.0, 1.0], [np.nan, 2.0]], np.float32)
    assert depth_ratio(depth_m) == 0.5


def test_corner_holds_a_scan_and_a_bare_wall_does_not():
    along = np.linspace(-1.0, 1.0, 60)
    wall = np.column_stack([np.ones(60), along])
    corner = np.concatenate([wall, np.column_stack([along[::-1], np.ones(60)])])
    assert scan_hold(scan_of(wall)) < 0.01
    assert scan_hold(scan_of(corner)) > 0.5
    assert scan_hold(scan_of(np.array([[1.0, 0.0]]))) == 0.0


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("features", {"features": ["grey_mean", "smell"]}),
        ("features", {"features": []}),
        ("hysteresis_ratio", {"hysteresis_ratio": 1.0}),
        ("hysteresis_ratio", {"hysteresis_ratio": -0.1}),
        ("hold_s", {"hold_s": -0.1}),
        ("hold_s", {"hold_s": np.inf}),
        ("rules", {"rules": {}}),
        ("rules", {"rules": {"dark": None}}),
        ("otherwise", {"otherwise": UNSURE}),
        ("rules.a", {"rules": {"a": {"scene": UNSURE, "when": {}}}}),
        ("rules.a", {"rules": {"a": {"scene": "Dark"}}}),
        ("rules.a", {"rules": {"a": {"scene": "Dark", "when": {"depth_ratio": [0, 1]}, "if": {}}}}),
        ("rules.a.when", {"rules": {"a": {"scene": "Dark", "when": {}}}}),
        ("rules.a.when", {"rules": {"a": {"scene": "Dark", "when": {"corner_count": [0, 1]}}}}),
    ],
)
def test_impossible_rules_are_refused_by_their_key(key, change):
    with pytest.raises(ConfigError) as caught:
        detector(**change)
    assert caught.value.key == key


@pytest.mark.parametrize(
    "limits",
    [
        50.0,
        None,
        "ab",
        {"a": 1.0, "b": 2.0},
        [],
        [20.0],
        [20.0, 50.0, 80.0],
        [50.0, 20.0],
        [50.0, 50.0],
        [None, None],
        ["a", "c"],
        [20.0, np.inf],
        [np.nan, 50.0],
        [[20.0], 50.0],
    ],
)
def test_limits_are_a_pair_of_finite_rising_numbers_names_or_null(limits):
    rules = {"a": {"scene": "Dark", "when": {"grey_mean": limits}}}
    with pytest.raises(ConfigError) as caught:
        detector(rules=rules, values={"a": 1.0, "b": 2.0})
    assert caught.value.key == "rules.a.when.grey_mean"


def test_rules_share_a_named_value():
    rules = {
        "dark": {"scene": "Dark", "when": {"grey_mean": [None, "dim"]}},
        "light": {"scene": "Light", "when": {"grey_mean": ["dim", None]}},
    }
    for dim, scene in ((50.0, "Light"), (80.0, "Dark")):
        found = detector(rules=rules, otherwise=None, values={"dim": dim})
        assert found.get_scene(seen(60, 0.0)).scene == scene
    with pytest.raises(ConfigError, match="one of values: dam"):
        detector(rules=rules, otherwise=None, values={"dam": 1.0})


def test_votes_tell_what_was_measured():
    vote = detector().get_scene(seen(120, None))
    assert vote.features["grey_mean"] == 120 and np.isnan(vote.features["depth_ratio"])
