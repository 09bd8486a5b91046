"""What every detector in `conf/detector` must do: the contract of `interfaces.Detector`."""

from functools import partial
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from networks import SIZE_WH, write_network

from sceneslam.interfaces import FeatureDetector
from sceneslam.testing import DETECTOR_CHECKS, ContractError, check_detector
from sceneslam.types.observation import SceneVote

COMPONENTS = sorted((Path(__file__).parents[1] / "conf" / "detector").glob("*.yaml"))


@pytest.fixture(params=COMPONENTS, ids=lambda path: path.stem)
def make(request, tmp_path):
    """Give a function that builds the detector anew from its YAML."""
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        node = compose("config", overrides=[f"detector={request.param.stem}"]).detector
    if "rate_hz" in node:  # a network: it votes on every image here
        node.path, node.rate_hz = str(write_network(tmp_path / "network.onnx")), None
        node.probability_min, node.size_wh = 0.0, SIZE_WH
        node.scenes = {"Indoor": [0], "Outdoor": [1], "Dark": [2]}
    return partial(instantiate, node, _convert_="all")


@pytest.mark.parametrize("check", DETECTOR_CHECKS, ids=lambda check: check.__name__)
def test_detector_keeps_its_contract(make, check):
    check(make)


def test_all_that_are_shipped_vote_by_features(make):
    assert isinstance(make(), FeatureDetector)


def test_a_detector_that_votes_for_what_it_does_not_name_is_found(make):
    detector = make()
    detector.get_scene = lambda observation: SceneVote(
        stamp_ns=observation.stamp_ns, scene="Twilight"
    )
    with pytest.raises(ContractError, match="Twilight"):
        check_detector(lambda: detector)
