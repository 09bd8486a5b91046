"""Votes: gaps between them, likelihoods, what cannot be logged, a detector that fails."""

import json
from dataclasses import replace

import hostile
import numpy as np
import pytest
from driving import drive, events
from fakes import ExactModule, ScriptedDetector, observation

from sceneslam.bus.scene.scene_filter import WindowFilter
from sceneslam.bus.scene.watch import Watch
from sceneslam.storage.events import EventLog
from sceneslam.types.observation import SceneVote

S = 10**9


def test_a_gap_as_long_as_the_window_is_bridged_by_two_votes():
    for gap_ns, is_confirmed in ((2 * S, True), (2 * S + 1, False)):
        window = WindowFilter(window_s=2.0, first_window_s=0.0)
        window.update(SceneVote(stamp_ns=0, scene="Bright"))
        window.update(SceneVote(stamp_ns=S, scene="Dark"))
        found = window.update(SceneVote(stamp_ns=S + gap_ns, scene="Dark"))
        assert (found is not None) == is_confirmed


class Votes(ScriptedDetector):
    """Gives a vote with other fields."""

    def __init__(self, **fields):
        super().__init__(lambda index: "Bright")
        self._fields = fields

    def get_scene(self, observation):
        return replace(super().get_scene(observation), **self._fields)


def watched(detector):
    """Return the watch of a detector after one vote, with the log."""
    log, window = EventLog(), WindowFilter(window_s=1.0, first_window_s=0.0)
    watch = Watch(detector, None, log, scene_filter=window)
    watch.look(observation(0))
    return watch, log


@pytest.mark.parametrize(
    ("likelihoods", "is_valid"),
    [
        (None, True),
        ({"Bright": 0.0, "Dark": 1e-9}, True),
        ({"Bright": 7.0}, True),
        ({"Bright": 0.0, "Dark": 0.0}, False),
        ({"Bright": 1.0, "Dark": -1e-9}, False),
        ({"Bright": float("inf"), "Dark": 0.5}, False),
        ({"Bright": 1.0, "Plain": 1.0}, False),
        ({"Bright": 1.0, "Dark": 1.0, "Plain": 1.0}, False),
        ({"Plain": 1.0}, False),
    ],
)
def test_likelihoods_are_finite_of_known_scenes_and_not_all_zero(likelihoods, is_valid):
    watch, log = watched(Votes(likelihoods=likelihoods))
    assert watch.is_working == is_valid and (events(log, "fault") == []) == is_valid


@pytest.mark.parametrize(
    ("fields", "is_valid"),
    [
        ({"stamp_ns": None}, False),
        ({"stamp_ns": "now"}, False),
        ({"stamp_ns": 1}, False),
        ({"stamp_ns": np.int64(0)}, True),
        ({"value": 3}, True),
        ({"value": np.float64(0.5)}, True),
        ({"value": np.float32(0.5)}, True),
        ({"value": "grey"}, False),
        ({"features": {"grey": float("nan"), "lines": 5}}, True),
        ({"features": {"grey": np.float32(0.5)}}, True),
        ({"features": {"grey": "dark"}}, False),
        ({"features": [0.5]}, False),
    ],
)
def test_a_vote_that_cannot_be_logged_stops_the_detector_not_the_run(fields, is_valid):
    watch, log = watched(Votes(**fields))
    log.flush()
    assert watch.is_working == is_valid and (events(log, "fault") == []) == is_valid
    json.dumps(log.events)


@pytest.mark.parametrize("error", ["Exception", "SystemExit", "unheard"])
def test_whatever_a_detector_raises_at_its_end_is_no_more_than_a_warning(error, caplog):
    watch, _ = watched(Votes())
    watch._detector.shutdown = lambda: hostile.throw(error)
    watch.close()
    assert "the detector could not be shut down" in caplog.text


@pytest.mark.parametrize("has_failed", [False, True])
def test_selected_scene_is_voted_for_until_it_is_given_back(has_failed):
    watch, log = watched(Votes(**{"value": "grey" if has_failed else 3.0}))
    for index, scene in enumerate(["Dark", "", "Bright"], start=1):
        watch.selected = scene
        watch.look(observation(10 * index))
    scenes = ["Dark", "Bright"] if has_failed else ["Bright", "Dark", "Bright", "Bright"]
    assert [vote["scene"] for vote in events(log, "vote")] == scenes
    assert len(events(log, "fault")) == has_failed


def test_run_begins_by_a_selected_scene_where_the_detector_failed():
    def failing(index):
        raise ValueError("no light meter")

    for selected, served in (("", ""), ("Dark", "Dark")):
        modules = {"bright": ExactModule(), "dark": ExactModule()}
        bus, _, log, _ = drive(modules, scene_at=failing, selected=selected)
        assert bus.scene == served and len(events(log, "fault")) == 1
