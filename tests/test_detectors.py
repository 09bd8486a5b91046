"""Detectors: the paper's formula to its rounding, and the manual bus."""

import os
import threading

import numpy as np
import pytest

from sceneslam.modules.detectors.grey_mean import GreyMean, grey_mean
from sceneslam.modules.detectors.manual import Manual
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, Observation
from sceneslam.types.rig import Rig

RIG = Rig(sensors=frozenset())
NAMES = ("Bright", "Dark")


def image_of(grey):
    return np.full((4, 6, 3), grey, np.uint8)


@pytest.mark.parametrize("shape", [(480, 640, 3), (1, 1, 3), (7, 13, 3), (1080, 1920, 3)])
def test_mean_is_exact_to_the_formula(shape):
    image_bgr = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    blue, green, red = (image_bgr[..., i].astype(np.float64) for i in range(3))
    expected = (0.299 * red + 0.587 * green + 0.114 * blue).mean()
    assert grey_mean(image_bgr) == pytest.approx(expected, rel=1e-12)


def test_mean_knows_blue_from_red():
    red = np.zeros((2, 2, 3), np.uint8)
    red[..., 2] = 255
    assert grey_mean(red) == pytest.approx(0.299 * 255)


def test_mean_of_a_view_is_that_of_its_copy():
    image_bgr = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    view = image_bgr[3:17:1, 5:25]
    assert grey_mean(view) == grey_mean(view.copy())


@pytest.mark.parametrize(("grey", "scene"), [(101, "Bright"), (100, "Dark"), (99, "Dark")])
def test_bright_is_above_the_threshold(grey, scene):
    detector = GreyMean(threshold=100.0, hysteresis=0.0, scenes=NAMES)
    detector.activate(RIG)
    vote = detector.get_scene(Observation(stamp_ns=5, image_bgr=image_of(grey)))
    assert (vote.scene, vote.stamp_ns) == (scene, 5)
    assert vote.value == pytest.approx(grey)


def test_no_image_is_an_unsure_vote():
    vote = GreyMean(threshold=100.0, hysteresis=0.0, scenes=NAMES).get_scene(
        Observation(stamp_ns=5)
    )
    assert vote.scene == UNSURE


@pytest.mark.parametrize("threshold", [-1.0, 256.0, float("nan")])
def test_threshold_out_of_range_is_refused(threshold):
    with pytest.raises(ConfigError) as caught:
        GreyMean(threshold=threshold, hysteresis=0.0, scenes=NAMES)
    assert caught.value.key == "threshold"


def test_hysteresis_leaves_a_scene_only_far_beyond_the_threshold():
    detector = GreyMean(threshold=100.0, hysteresis=10.0, scenes=NAMES)
    greys = [101, 95, 91, 90, 105, 110, 111, 99, 90]
    expected = ["Bright"] * 3 + ["Dark"] * 3 + ["Bright"] * 2 + ["Dark"]
    for _ in range(2):  # activation starts anew
        detector.activate(RIG)
        observations = [Observation(stamp_ns=0, image_bgr=image_of(grey)) for grey in greys]
        assert [detector.get_scene(one).scene for one in observations] == expected


@pytest.mark.parametrize("hysteresis", [-1.0, 101.0, float("nan")])
def test_hysteresis_that_never_lets_a_scene_go_is_refused(hysteresis):
    with pytest.raises(ConfigError) as caught:
        GreyMean(threshold=100.0, hysteresis=hysteresis, scenes=NAMES)
    assert caught.value.key == "hysteresis"


def test_scenes_have_the_names_that_they_are_given():
    detector = GreyMean(threshold=100.0, hysteresis=0.0, scenes=["Hall", "Tunnel"])
    bright, dark = (Observation(stamp_ns=0, image_bgr=image_of(grey)) for grey in (200, 20))
    assert [detector.get_scene(bright).scene, detector.get_scene(dark).scene] == ["Hall", "Tunnel"]


@pytest.mark.parametrize("names", [["Hall"], ["Hall", "Hall"], ["Hall", UNSURE], ["a", "b", "c"]])
def test_scenes_are_two_different_names(names):
    with pytest.raises(ConfigError) as caught:
        GreyMean(threshold=100.0, hysteresis=0.0, scenes=names)
    assert caught.value.key == "scenes"


def test_schedule_counts_from_the_first_observation():
    detector = Manual(
        schedule=[[0, "Bright"], [1.5, "Dark"], [3, "Bright"]], operator=False, scenes=None
    )
    detector.activate(RIG)
    start_ns = 10**18
    scenes = [
        detector.get_scene(Observation(stamp_ns=start_ns + offset_ns)).scene
        for offset_ns in (0, 1_499_999_999, 1_500_000_000, 3_000_000_000)
    ]
    assert scenes == ["Bright", "Bright", "Dark", "Bright"]
    assert detector.scenes == ("Bright", "Dark")


@pytest.mark.parametrize(
    "schedule", [[], [[1.0, "Bright"]], [[0, "Bright"], [0, "Dark"]], [["x", "Bright"]], [[0]]]
)
def test_impossible_schedule_is_refused(schedule):
    with pytest.raises(ConfigError):
        Manual(schedule=schedule, operator=False, scenes=None)


def test_operator_takes_over_from_the_schedule(monkeypatch):
    import io

    monkeypatch.setattr("sys.stdin", io.StringIO("nonsense\nDark\n"))
    detector = Manual(schedule=[[0, "Bright"]], operator=True, scenes=["Dark"])
    detector.activate(RIG)
    for thread in __import__("threading").enumerate():
        if thread.name == "operator":
            thread.join(5.0)
    assert detector.get_scene(Observation(stamp_ns=0)).scene == "Dark"


def test_operator_is_heard_by_one_thread_for_the_detector_activated_last(monkeypatch):
    reading, writing = os.pipe()
    with os.fdopen(reading) as stdin, os.fdopen(writing, "w") as operator:
        monkeypatch.setattr("sys.stdin", stdin)
        before = threading.active_count()
        detector = Manual(schedule=[[0, "Bright"]], operator=True, scenes=["Dark"])
        for _ in range(3):
            detector.activate(RIG)
            detector.shutdown()
        assert threading.active_count() == before + 1
        later = Manual(schedule=[[0, "Bright"]], operator=True, scenes=["Dark"])
        later.activate(RIG)
        detector.shutdown()
        operator.write("Dark\n")
        operator.close()
        for thread in threading.enumerate():
            if thread.name == "operator":
                thread.join(5.0)
        assert later.get_scene(Observation(stamp_ns=0)).scene == "Dark"
        assert detector.get_scene(Observation(stamp_ns=0)).scene == "Bright"
