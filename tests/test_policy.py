"""The confirmation window, as a pure function of votes."""

import itertools
from pathlib import Path

import pytest
import yaml
from driving import policy
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.bus.scene.scene_filter import WindowFilter
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, SceneVote

PERIOD_NS = 33_333_333


def confirm(scenes, *, window_s=2.0, first_window_s=0.0, period_ns=PERIOD_NS):
    """Return what the filter confirms at each vote."""
    scene_filter = WindowFilter(window_s=window_s, first_window_s=first_window_s)
    votes = (SceneVote(stamp_ns=i * period_ns, scene=scene) for i, scene in enumerate(scenes))
    return [scene_filter.update(vote) for vote in votes]


def test_first_scene_is_confirmed_at_once_without_a_first_window():
    assert confirm(["Bright"])[0].scene == "Bright"


def test_first_scene_waits_for_its_window():
    confirmed = confirm(["Bright"] * 90, first_window_s=2.0)
    first = next(change for change in confirmed if change)
    assert first.stamp_ns >= 2_000_000_000 > first.stamp_ns - PERIOD_NS
    assert first.since_ns == 0 and first.previous is None


def test_change_is_confirmed_within_a_frame_of_the_window():
    confirmed = confirm(["Bright"] * 10 + ["Dark"] * 90)
    change = [item for item in confirmed if item][1]
    assert change.since_ns == 10 * PERIOD_NS
    assert 2_000_000_000 <= change.stamp_ns - change.since_ns < 2_000_000_000 + PERIOD_NS


def test_silence_longer_than_the_window_is_no_agreement():
    scene_filter = WindowFilter(window_s=2.0, first_window_s=0.0)
    scene_filter.update(SceneVote(stamp_ns=0, scene="Bright"))
    for stamp_s in (1, 4, 7):
        vote = SceneVote(stamp_ns=stamp_s * 10**9, scene="Dark")
        assert scene_filter.update(vote) is None


@given(st.lists(st.sampled_from(["Bright", "Dark", UNSURE]), min_size=1, max_size=300))
def test_every_confirmed_window_is_unanimous(scenes):
    for index, change in enumerate(confirm(scenes, window_s=0.5)):
        if change is None or change.previous is None:
            continue
        first = round(change.since_ns / PERIOD_NS)
        window = {scene for scene in scenes[first : index + 1] if scene != UNSURE}
        assert window == {change.scene}
        assert (index - first) * PERIOD_NS >= 500_000_000


@given(st.lists(st.sampled_from(["Bright", "Dark"]), min_size=1, max_size=300))
def test_confirmed_scenes_alternate(scenes):
    changes = [change for change in confirm(scenes, window_s=0.2) if change]
    assert changes[0].previous is None
    for before, after in itertools.pairwise(changes):
        assert after.previous == before.scene != after.scene


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("confirm_window_s", -1.0),
        ("confirm_window_s", float("nan")),
        ("lost_patience_s", float("inf")),
        ("handover", "teleport"),
    ],
)
def test_impossible_policy_is_refused_with_its_key(key, value):
    with pytest.raises(ConfigError) as caught:
        policy(**{key: value})
    assert caught.value.key == key


def test_policy_has_few_keys():
    path = Path(__file__).resolve().parents[1] / "conf" / "policy" / "default.yaml"

    def leaves(node):
        if not isinstance(node, dict) or not node:
            return 1
        return sum(leaves(value) for key, value in node.items() if key != "_target_")

    assert leaves(yaml.safe_load(path.read_text())) <= 12
