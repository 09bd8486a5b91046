"""A sensor fails when it is told to, and nothing else changes; the detector names it."""

from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from test_effects import DEPTH, film
from test_source_ordered import Listed

from sceneslam.modules.detectors.lens import Dirt
from sceneslam.modules.detectors.rules import Rules
from sceneslam.sources.changes.failing_sensor import FailingSensor
from sceneslam.sources.changes.failures import FAILURES, scene_of
from sceneslam.testing.room import RIG, observation_at
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor

SENSOR = {
    "camera": "image_bgr",
    "depth": "depth_m",
    "laser": "scan",
    "wheels": "T_odom_base",
}
FAILS_S = [2.0, 4.0]


def failing(source, failure, spans_s=(FAILS_S,), *, names_scene=True, seed=3):
    return FailingSensor(
        source, failure, list(spans_s), names_scene=names_scene, otherwise="Bright", seed=seed
    )


@cache
def drive():
    """Return six seconds at 10 Hz of a robot that drives and turns; every image has noise."""
    rng = np.random.default_rng(0)
    found = []
    for index in range(60):
        t_s = index / 10
        T_room_base = se3.from_xy_yaw(-1.0 + 0.3 * t_s, 0.1 * t_s, 0.3 * t_s)
        one = observation_at(T_room_base, t_s)
        noise = rng.integers(-2, 3, one.image_bgr.shape)
        image_bgr = np.clip(one.image_bgr.astype(int) + noise, 0, 255).astype(np.uint8)
        depth_m = one.depth_m + rng.normal(0, 0.002, one.depth_m.shape) * (one.depth_m > 0)
        ranges_m = one.scan.ranges_m + rng.normal(0, 0.01, one.scan.ranges_m.shape)
        scan = replace(one.scan, ranges_m=ranges_m.astype(np.float32))
        found.append(
            replace(
                one,
                image_bgr=image_bgr,
                depth_m=depth_m.astype(np.float32),
                scan=scan,
                points_lidar=None,
                gyro_base=None,
            )
        )
    return tuple(found)


def detector():
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        node = compose("config", overrides=["detector=failures"]).detector
    made = instantiate(node, _convert_="all")
    made.activate(RIG)
    return made


def differs(one, other, name):
    first, second = (getattr(each, name) for each in (one, other))
    if name == "scan" and first is not None and second is not None:
        first, second = first.ranges_m, second.ranges_m
    return not np.array_equal(first, second)


@pytest.mark.parametrize("failure", FAILURES)
def test_one_sensor_changes_within_the_span_and_no_other(failure):
    source = Listed(list(drive()), rig=RIG)
    found = list(failing(source, failure))
    own = SENSOR[failure.split("_")[0]]
    changed = [
        field.name
        for field in fields(Observation)
        if any(differs(one, other, field.name) for one, other in zip(found, drive(), strict=True))
    ]
    assert changed == [own]
    is_changed = [differs(one, other, own) for one, other in zip(found, drive(), strict=True)]
    assert not any(is_changed[:20]) and any(is_changed[20:24]) and sum(is_changed[20:40]) >= 9
    if own != "T_odom_base":  # a sum of motions stays off
        assert not any(is_changed[40:])


@pytest.mark.parametrize("failure", FAILURES)
def test_failure_is_the_same_for_the_same_seed(failure):
    first, second = (list(failing(Listed(list(drive()), rig=RIG), failure)) for _ in range(2))
    own = SENSOR[failure.split("_")[0]]
    assert not any(differs(one, other, own) for one, other in zip(first, second, strict=True))


@pytest.mark.parametrize("failure", sorted(FAILURES.keys() - {"camera_dirty"}))
def test_failure_is_named_within_a_second_and_nothing_before(failure):
    one = detector()
    votes = [one.get_scene(seen).scene for seen in failing(Listed(list(drive()), rig=RIG), failure)]
    assert set(votes[:20]) == {"Bright"}
    assert set(votes[30:40]) == {scene_of(failure)}


def test_dirt_shows_once_the_robot_has_turned():
    dirt = Dirt(RIG)
    ratios = [
        dirt(seen) for seen in failing(Listed(list(drive()), rig=RIG), "camera_dirty", seed=4)
    ]
    assert max(ratios[:20]) < 0.001 and min(ratios[30:40]) > 0.02


def test_truth_names_the_failure_while_it_lasts():
    truth = failing(film(), "depth_noisy").ground_truth()
    named = [((change.stamp_ns - 5 * 10**9) / 1e9, change.scene) for change in truth.scenes]
    assert named == [(0.0, "Bright"), (2.0, "DepthNoisy"), (4.0, "Bright")]
    assert failing(film(), "depth_noisy", names_scene=False).ground_truth().scenes == ()


def test_depth_shows_nothing_within_a_gap_and_is_untouched_outside():
    source = film()
    found = list(failing(source, "depth_blinded", [[1.0, 2.0], [9.5, 20.0]], names_scene=False))
    empty = [index for index, one in enumerate(found) if not one.depth_m.any()]
    assert empty == [*range(10, 20), *range(95, 101)]
    assert all(one.depth_m.shape == DEPTH.shape for one in found)
    assert not found[10].depth_m.flags.writeable
    assert all(one.image_bgr is other.image_bgr for one, other in zip(found, source, strict=True))


@pytest.mark.parametrize("spans_s", [[[2.0, 1.0]], [[1.0]], [[-1.0, 2.0]], [[0, 2], [1, 3]]])
def test_invalid_span_is_named(spans_s):
    with pytest.raises(ConfigError, match="spans_s"):
        failing(film(), "camera_black", spans_s)


def test_unknown_failure_is_named_with_those_that_there_are():
    with pytest.raises(ConfigError, match="camera_frozen"):
        failing(film(), "camera_melted")


@pytest.mark.parametrize("failure", FAILURES)
def test_failure_of_a_sensor_that_the_source_lacks_is_refused(failure):
    sensors = frozenset(one for one in Sensor if one.field != SENSOR[failure.split("_")[0]])
    with pytest.raises(ConfigError, match=f"failure: got '{failure}', allowed: with a source"):
        failing(Listed([], rig=Rig(sensors=sensors)), failure)


def test_rules_on_sensors_that_the_rig_lacks_are_left_out():
    one = detector()
    one.activate(replace(RIG, sensors=frozenset({Sensor.IMAGE}), laser=None))
    for seen in drive()[:20]:
        vote = one.get_scene(Observation(stamp_ns=seen.stamp_ns, image_bgr=seen.image_bgr))
        assert vote.scene == "Bright" and "scan_silent_s" not in vote.features


def test_sensors_that_never_measure_at_the_same_stamp_are_judged_together():
    one = Rules(
        features=["grey_mean", "scan_near_ratio"],
        rules=RULES,
        otherwise="Bright",
        hysteresis_ratio=0.0,
        hold_s=0.5,
        values={},
        skip_absent_sensors=False,
    )
    one.activate(RIG)
    votes = []
    for number, seen in enumerate(drive()[:10]):
        silent = {"scan": None} if number % 2 else {"image_bgr": None}
        votes.append(one.get_scene(replace(seen, **silent)).scene)
    assert votes == ["Unsure", *["Bright"] * 9]


RULES = {
    "laser_covered": {"scene": "LaserCovered", "when": {"scan_near_ratio": [0.6, None]}},
    "no_light": {"scene": "Dark", "when": {"grey_mean": [None, 55.0]}},
}
