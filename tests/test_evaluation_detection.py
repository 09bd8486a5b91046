"""How well confirmed scenes follow the true ones."""

import pytest

from sceneslam.evaluation.detection import score_detection
from sceneslam.types.truth import GroundTruth, SceneChange

S = 10**9
TRUTH = GroundTruth(
    scenes=tuple(
        SceneChange(stamp_ns=at * S, scene=scene)
        for at, scene in [(0, "Bright"), (10, "Dark"), (20, "Bright")]
    )
)


def score(*seen, truth=TRUTH, scenes=None):
    events = [{"stamp_ns": round(at * S), "scene": scene} for at, scene in seen]
    return score_detection(events, truth, 30 * S, scenes or {})


def test_every_change_found_late_by_the_window():
    scores = score((0, "Bright"), (12, "Dark"), (21, "Bright"))
    assert scores == {
        "confirmed": 3,
        "false": 0,
        "missed": 0,
        "delay_s": 1.5,
        "delay_max_s": 2.0,
        "wrong_s": 3.0,
    }


def test_scene_that_never_was_is_false_and_wrong_until_it_is_taken_back():
    scores = score((0, "Bright"), (5, "Dark"), (6, "Bright"), (10, "Dark"), (20, "Bright"))
    assert (scores["false"], scores["missed"], scores["wrong_s"]) == (1, 0, 1.0)


def test_change_that_is_confirmed_after_the_next_one_is_missed():
    scores = score((0, "Bright"))
    assert (scores["missed"], scores["delay_s"], scores["wrong_s"]) == (1, 0.0, 10.0)


def test_detector_that_always_says_one_scene_is_false_once_and_never_late_for_it():
    scores = score((0, "Dark"))
    assert (scores["false"], scores["missed"], scores["delay_s"]) == (1, 1, 0.0)
    assert scores["wrong_s"] == 20.0


@pytest.mark.parametrize("truth", [None, GroundTruth()])
def test_without_true_scenes_only_confirmations_are_counted(truth):
    scores = score((0, "Dark"), (3, "Bright"), truth=truth)
    assert scores["confirmed"] == 2
    assert {value for name, value in scores.items() if name != "confirmed"} == {None}


def test_nothing_confirmed_finds_nothing():
    scores = score()
    assert (scores["confirmed"], scores["missed"], scores["delay_s"]) == (0, 2, None)


def test_truth_that_speaks_of_other_scenes_says_nothing():
    scores = score((0, "Light"), (12, "Night"))
    assert scores["confirmed"] == 2 and scores["false"] is None


def test_own_names_of_scenes_count_as_those_of_the_truth():
    seen = ((0, "Hall"), (12, "Tunnel"), (14, "Corridor"), (21, "Hall"))
    names = {"Hall": "Bright", "Tunnel": "Dark", "Corridor": "Dark"}
    scores = score(*seen, scenes=names)
    assert scores["confirmed"] == 4
    assert (scores["false"], scores["missed"], scores["delay_max_s"]) == (0, 0, 2.0)
    assert score(*seen)["false"] is None
