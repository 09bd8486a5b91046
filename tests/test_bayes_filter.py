"""The Bayes filter over scenes, as a pure function of votes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from sceneslam.bus.scene.bayes_filter import BayesFilter, BayesSettings
from sceneslam.bus.scene.scene_filter import WindowFilter
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, SceneVote

SCENES = ("Bright", "Dark", "Plain")
CONF = Path(__file__).parents[1] / "conf" / "policy" / "bayes.yaml"


def settings(**changes: float) -> BayesSettings:
    """Return what the YAML that is shipped says, with some values changed."""
    node = OmegaConf.to_container(OmegaConf.load(CONF)["scene_filter"])
    assert isinstance(node, dict)
    node.pop("_target_")
    return BayesSettings(**{**node, **changes})


def votes(scenes, rate_hz=30.0, start_s=0.0):
    return [
        SceneVote(stamp_ns=round((start_s + k / rate_hz) * 1e9), scene=scene)
        for k, scene in enumerate(scenes)
    ]


def confirmed(filter_, cast):
    return [one for one in map(filter_.update, cast) if one is not None]


@pytest.mark.parametrize("rate_hz", [5.0, 30.0, 90.0])
def test_change_is_confirmed_within_two_seconds_at_any_rate_of_images(rate_hz):
    count = round(20 * rate_hz)
    cast = votes(["Bright"] * count + ["Dark"] * count, rate_hz)
    first, change = confirmed(BayesFilter(("Bright", "Dark"), settings()), cast)
    assert first.scene == "Bright" and first.previous is None
    assert change.scene == "Dark" and change.previous == "Bright"
    delay_s = (change.stamp_ns - cast[count].stamp_ns) * 1e-9
    assert 0.79 < delay_s < 2.0  # no drop-out of the story `flicker` is as long
    assert change.since_ns == cast[count].stamp_ns


def test_change_is_found_though_every_fifth_vote_is_wrong_where_the_window_never_agrees():
    rng = np.random.default_rng(0)
    true = ["Bright"] * 600 + ["Dark"] * 600
    other = {"Bright": "Dark", "Dark": "Bright"}
    cast = votes([other[s] if rng.random() < 0.2 else s for s in true])
    found = confirmed(BayesFilter(("Bright", "Dark"), settings()), cast)
    assert [one.scene for one in found] == ["Bright", "Dark"]
    assert (found[1].stamp_ns - cast[600].stamp_ns) * 1e-9 < 4.0
    window = confirmed(WindowFilter(window_s=2.0, first_window_s=0.0), cast)
    assert len(window) == 1


def test_drop_outs_below_a_second_change_nothing():
    cast = votes((["Bright"] * 150 + ["Dark"] * 24) * 10)
    assert len(confirmed(BayesFilter(("Bright", "Dark"), settings()), cast)) == 1


def test_posterior_is_that_of_the_forward_algorithm():
    ours = settings(mean_dwell_s=10.0, error_ratio=0.2, correlation_s=0.5)
    filter_ = BayesFilter(("A", "B"), ours)
    belief = np.array([0.5, 0.5])
    generator = np.array([[-0.1, 0.1], [0.1, -0.1]])  # a scene lasts 10 s
    transition = np.linalg.matrix_power(np.eye(2) + generator * 1e-6, 250_000)  # exp(Q 0.25 s)
    for k, told in enumerate([(0.9, 0.1), (0.9, 0.1), (0.2, 0.6)]):
        likelihoods = dict(zip("AB", told, strict=True))
        vote = SceneVote(stamp_ns=k * 250_000_000, scene="A", likelihoods=likelihoods)
        filter_.update(vote)
        mixed = 0.8 * np.array(told) / sum(told) + 0.1
        belief = mixed * belief if k == 0 else mixed**0.5 * (belief @ transition)
        belief /= belief.sum()
        assert list(filter_.posterior.values()) == pytest.approx(belief.tolist(), abs=1e-6)


def test_silence_lets_the_filter_forget():
    filter_ = BayesFilter(SCENES, settings())
    confirmed(filter_, votes(["Dark"] * 100))
    assert filter_.posterior["Dark"] > 0.95
    filter_.update(SceneVote(stamp_ns=10**12, scene=UNSURE))
    assert filter_.posterior["Dark"] > 0.95  # that was no vote
    same = dict.fromkeys(SCENES, 1.0)  # measured something that speaks for none of them
    vote = SceneVote(stamp_ns=10**12, scene="Dark", likelihoods=same)
    assert filter_.update(vote) is None  # the scene stays until another is confirmed
    assert filter_.posterior["Dark"] == pytest.approx(1 / 3)


@given(st.lists(st.sampled_from([*SCENES, UNSURE]), max_size=200), st.floats(1.0, 60.0))
def test_what_is_confirmed_is_probable_and_another_scene_each_time(cast, rate_hz):
    filter_ = BayesFilter(SCENES, settings())
    before = None
    for vote in votes(cast, rate_hz):
        found = filter_.update(vote)
        assert sum(filter_.posterior.values()) == pytest.approx(1.0)
        if found is not None:
            assert filter_.posterior[found.scene] >= settings().confirm_probability
            assert found.previous == before != found.scene and found.since_ns <= found.stamp_ns
            before = found.scene


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mean_dwell_s", 0.0),
        ("correlation_s", -1.0),
        ("error_ratio", 0.0),
        ("error_ratio", 1.0),
        ("confirm_probability", 0.5),
        ("confirm_probability", 1.0),
    ],
)
def test_setting_that_makes_no_sense_is_named(name, value):
    with pytest.raises(ConfigError, match=rf"^{name}: got {value}"):
        settings(**{name: value})
