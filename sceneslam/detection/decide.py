"""Votes and confirmed scenes from features: what the bus does, without the images and the SLAM."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from sceneslam.bus.policy import Policy
from sceneslam.bus.scene_filter import ConfirmedScene, SceneFilter
from sceneslam.detection.features import RecordingFeatures
from sceneslam.interfaces import FeatureDetector
from sceneslam.types.observation import SceneVote
from sceneslam.types.rig import Rig


@dataclass(frozen=True, slots=True, kw_only=True)
class Filtered:
    """A vote, and what was made of it."""

    vote: SceneVote
    confirmed: ConfirmedScene | None
    posterior: Mapping[str, float] | None


def vote(detector: FeatureDetector, rig: Rig, features: RecordingFeatures) -> list[SceneVote]:
    """Return the detector's votes on every observation."""
    detector.activate(rig)
    told = zip(
        features.stamps_ns.tolist(), features.values, features.is_there.tolist(), strict=True
    )
    votes = [detector.decide(at, row if is_there else None) for at, row, is_there in told]
    detector.shutdown()
    return votes


def filtered(votes: Iterable[SceneVote], scenes: SceneFilter) -> Iterator[Filtered]:
    """Yield what a filter makes of each vote."""
    for one in votes:
        confirmed = scenes.update(one)
        yield Filtered(vote=one, confirmed=confirmed, posterior=scenes.posterior)


def confirm(
    votes: Iterable[SceneVote], policy: Policy, scenes: Sequence[str]
) -> list[ConfirmedScene]:
    """Return the scenes that the policy confirms by votes for `scenes`."""
    found = map(policy.make_scene_filter(scenes).update, votes)
    return [scene for scene in found if scene is not None]
