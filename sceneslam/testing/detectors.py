"""Contract checks of scene detectors; each takes a function that makes a new detector."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from sceneslam.interfaces import Detector, FeatureDetector
from sceneslam.testing.promise import expect
from sceneslam.testing.room import RIG, room_observation
from sceneslam.types.observation import UNSURE, Observation

Make = Callable[[], Detector]


def check_detector(make: Make) -> None:
    """Raise ContractError if a detector violates the contract of `Detector`."""
    for check in DETECTOR_CHECKS:
        check(make)


def fulfils_the_protocol(make: Make) -> None:
    """Check that the detector has all members, and names its scenes."""
    with _active(make) as detector:
        expect(isinstance(detector, Detector), "all members of Detector")
        is_named = detector.scenes and UNSURE not in detector.scenes
        expect(is_named, f"scenes: some, without {UNSURE}", detector.scenes)


def votes_at_the_stamp_for_its_scenes(make: Make) -> None:
    """Check that a vote has the observation's stamp, and a scene of the detector or UNSURE."""
    with _active(make) as detector:
        for index in range(3):
            observation = room_observation(index)
            vote = detector.get_scene(observation)
            is_now = vote.stamp_ns == observation.stamp_ns
            expect(is_now, f"stamp_ns {observation.stamp_ns}", vote.stamp_ns)
            known = (*detector.scenes, UNSURE)
            expect(vote.scene in known, f"one of {known}", vote.scene)


def repeats_itself(make: Make) -> None:
    """Check that the same observation gets the same vote."""
    with _active(make) as one, _active(make) as two:
        first, second = (each.get_scene(room_observation(0)).scene for each in (one, two))
        expect(first == second, f"{first} again", second)


def survives_an_empty_observation(make: Make) -> None:
    """Check that the detector votes without any measurement, UNSURE or not."""
    with _active(make) as detector:
        vote = detector.get_scene(Observation(stamp_ns=1))
        expect(vote.scene in (*detector.scenes, UNSURE), "a known scene", vote.scene)


def votes_by_features_that_can_be_kept(make: Make) -> None:
    """Check that the vote depends on the detector's features only, if it has any."""
    observations = [room_observation(index) for index in range(3)]
    observations.insert(2, Observation(stamp_ns=observations[1].stamp_ns + 1))
    with _active(make) as detector:
        if not isinstance(detector, FeatureDetector):
            return
        kept = [(one.stamp_ns, detector.get_features(one)) for one in observations]
    with _active(make) as detector:
        votes = [repr(detector.get_scene(one)) for one in observations]
    with _active(make) as detector:
        assert isinstance(detector, FeatureDetector)
        again = [repr(detector.decide(stamp_ns, features)) for stamp_ns, features in kept]
        expect(again == votes, f"decide: {votes}", again)


DETECTOR_CHECKS: Sequence[Callable[[Make], None]] = (
    fulfils_the_protocol,
    votes_at_the_stamp_for_its_scenes,
    repeats_itself,
    survives_an_empty_observation,
    votes_by_features_that_can_be_kept,
)


@contextmanager
def _active(make: Make) -> Iterator[Detector]:
    detector = make()
    detector.activate(RIG)
    try:
        yield detector
    finally:
        detector.shutdown()
        detector.shutdown()
