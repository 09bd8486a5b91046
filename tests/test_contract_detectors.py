"""What every detector in `conf/detector` must do: the contract of `interfaces.Detector`."""

from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf
from scenery import RIG, room_observation

from sceneslam.interfaces import Detector, FeatureDetector
from sceneslam.types.observation import UNSURE, Observation

COMPONENTS = sorted((Path(__file__).parents[1] / "conf" / "detector").glob("*.yaml"))


@pytest.fixture(params=COMPONENTS, ids=lambda path: path.stem)
def detector(request):
    found = instantiate(OmegaConf.load(request.param), _convert_="all")
    found.activate(RIG)
    yield found
    found.shutdown()
    found.shutdown()


def test_detector_fulfils_the_protocol(detector):
    assert isinstance(detector, Detector)
    assert detector.scenes and UNSURE not in detector.scenes


def test_votes_are_known_scenes_at_the_observation_stamp(detector):
    for index in range(3):
        observation = room_observation(index)
        vote = detector.get_scene(observation)
        assert vote.stamp_ns == observation.stamp_ns
        assert vote.scene in detector.scenes


def test_same_observation_gets_the_same_vote(detector):
    observation = room_observation(0)
    assert detector.get_scene(observation).scene == detector.get_scene(observation).scene


def test_empty_observation_is_survived(detector):
    assert detector.get_scene(Observation(stamp_ns=1)).scene in (*detector.scenes, UNSURE)


def test_vote_follows_from_features_that_can_be_kept(detector):
    """What holds for a detector with features holds for all that are shipped."""
    assert isinstance(detector, FeatureDetector)
    observations = [room_observation(index) for index in range(3)]
    observations.insert(2, Observation(stamp_ns=observations[1].stamp_ns + 1))
    kept = [(one.stamp_ns, detector.get_features(one)) for one in observations]
    told = [detector.get_scene(one) for one in observations]
    detector.shutdown()
    detector.activate(RIG)
    again = [detector.decide(stamp_ns, features) for stamp_ns, features in kept]
    assert [repr(vote) for vote in again] == [repr(vote) for vote in told]
