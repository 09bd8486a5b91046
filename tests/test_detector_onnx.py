"""Scenes by an image classifier, a small one that is trained and exported here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_module
from networks import SIZE_WH, footage, write_network

from sceneslam.config.check import check_keys
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.resolve import resolved
from sceneslam.interfaces import FeatureDetector
from sceneslam.modules.detectors.onnx import Onnx
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import UNSURE, Observation
from sceneslam.types.rig import Rig, Sensor

KINDS = ("Indoor", "Outdoor", "Dark")
RIG = Rig(sensors=frozenset({Sensor.IMAGE}))


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> Path:
    return write_network(tmp_path_factory.mktemp("network") / "scenes.onnx", KINDS)


@pytest.fixture
def make(network):
    def made(*words: str, name: str = "indoor_outdoor"):
        given = [f"detector={name}", f"detector.path={network}", f"detector.size_wh={[*SIZE_WH]}"]
        with initialize_config_module("sceneslam.conf", version_base="1.3"):
            config = resolved(compose("config", overrides=[*given, *words]))
        check_keys({**config, "source": {}})
        detector = ComponentBuilder(config).make("detector", FeatureDetector)
        detector.activate(RIG)
        return detector

    return made


def seen(kind: str, seed: int, stamp_s: float = 0.0) -> Observation:
    return Observation(stamp_ns=round(stamp_s * 1e9), image_bgr=footage(kind, seed))


@pytest.mark.parametrize("kind", KINDS)
def test_images_that_it_was_not_trained_on_get_their_scene(make, kind):
    detector = make("detector.rate_hz=null")
    assert detector.scenes == KINDS
    for seed in range(100, 110):
        vote = detector.get_scene(seen(kind, seed))
        assert vote.scene == kind and vote.value > 0.5
        assert sum(vote.likelihoods.values()) == pytest.approx(1.0)


def test_it_votes_at_its_own_rate(make):
    detector = make()
    votes = [detector.get_scene(seen("Indoor", k, k / 10)) for k in range(25)]
    cast = [k for k, vote in enumerate(votes) if vote.scene != UNSURE]
    assert cast == [0, 10, 20]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_classes_are_found_by_patterns_of_their_labels(make, tmp_path, encoding):
    text = "living_room\nprairie fleurie \u00e9t\u00e9\ncellar\n"
    (tmp_path / "labels.txt").write_text(text, encoding)
    labels = f"detector.labels={tmp_path / 'labels.txt'}"
    scenes = "+detector.scenes={Inside:['living_*',cellar],Outside:[1]}"
    detector = make("~detector.scenes", scenes, labels, "detector.rate_hz=null")
    assert detector.get_scene(seen("Dark", 7)).scene == "Inside"
    assert detector.get_scene(seen("Outdoor", 7)).scene == "Outside"


def test_network_and_labels_in_the_home_folder_are_found(make, network, monkeypatch):
    monkeypatch.setenv("HOME", str(network.parent))
    (network.parent / "labels.txt").write_text("room\nmeadow\ncellar\n")
    scenes = "+detector.scenes={Inside:[room,cellar],Outside:[meadow]}"
    words = (f"detector.path='~/{network.name}'", "detector.labels='~/labels.txt'", scenes)
    assert make("~detector.scenes", *words).scenes == ("Inside", "Outside")


def test_image_that_fits_no_scene_well_enough_is_unsure(make):
    detector = make("detector.probability_min=1.0")
    assert detector.get_scene(seen("Indoor", 1)).scene == UNSURE
    assert detector.get_scene(Observation(stamp_ns=1)).scene == UNSURE


def test_probabilities_of_a_network_are_taken_as_they_are(make, network):
    scores = make("detector.output=probabilities").get_features(seen("Indoor", 1))
    shares = make().get_features(seen("Indoor", 1))
    assert np.allclose(np.exp(scores) / np.exp(scores).sum(), shares)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["detector.path=nothing.onnx"], "network not found.*nothing.onnx"),
        (["detector.path=pyproject.toml"], "OpenCV cannot read it.*pyproject.toml"),
        (["detector.size_wh=[16,16]"], r"detector\.size_wh: got \[16, 16\]"),
        (["detector.scenes.Dark=[3]"], r"detector\.scenes\.Dark: got 3, allowed: numbers from 0"),
        (["detector.scenes.Dark=[attic]"], r"detector\.scenes\.Dark: got 'attic'.*file of labels"),
        (["detector.scenes.Dark=[1]"], r"detector\.scenes: .*no class in two"),
        (["detector.rate_hz=0"], r"detector\.rate_hz: got 0"),
        (["detector.probability_min=1.1"], r"detector\.probability_min: got 1.1"),
        (["detector.probability_min=-0.1"], r"detector\.probability_min: got -0.1"),
        (["detector.size_wh=[32,0]"], r"detector\.size_wh: got \[32, 0\]"),
        (["detector.standard_deviation=[1,0,1]"], r"detector\.standard_deviation: got \[1"),
        (["detector.labels=nothing.txt"], "labels not found.*nothing.txt"),
        (["detector.labels=tests/test_detector_onnx.py"], r"detector\.labels: .*3 lines"),
        (["detector.output=odds"], r"detector\.output: got 'odds'"),
    ],
)
def test_mistake_is_one_sentence(make, monkeypatch, words, told):
    monkeypatch.chdir(Path(__file__).parents[1])
    with pytest.raises((ConfigError, InputError), match=told) as error:
        make(*words)
    assert "\n" not in str(error.value)


def test_a_rate_is_finite():
    with pytest.raises(ConfigError, match="rate_hz: got inf"):
        Onnx(
            path="nothing.onnx",
            scenes={},
            labels=None,
            size_wh=SIZE_WH,
            colour_order="RGB",
            mean=(0.0, 0.0, 0.0),
            standard_deviation=(1.0, 1.0, 1.0),
            output="logits",
            rate_hz=np.inf,
            probability_min=0.0,
        )


def test_scenes_have_to_be_given_where_no_preset_does(make):
    with pytest.raises(ConfigError, match=r"detector\.scenes: got nothing"):
        make(name="onnx")
