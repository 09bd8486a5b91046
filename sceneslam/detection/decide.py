"""Votes and confirmed scenes from stored features, as the bus computes them during a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from sceneslam.bus.policy import Policy
from sceneslam.bus.scene.scene_filter import ConfirmedScene, SceneFilter
from sceneslam.detection.features import RecordingFeatures, failures_named
from sceneslam.interfaces import FeatureDetector
from sceneslam.types.observation import SceneVote
from sceneslam.types.rig import Rig


@dataclass(frozen=True, slots=True, kw_only=True)
class Filtered:
    """A vote, and the scene that was confirmed after it."""

    vote: SceneVote
    confirmed: ConfirmedScene | None
    posterior: Mapping[str, float] | None


def vote(detector: FeatureDetector, rig: Rig, features: RecordingFeatures) -> list[SceneVote]:
    """Return the detector's vote for each observation of stored features.

    Raises ModuleError if the detector fails.
    """
    rows = zip(
        features.stamps_ns.tolist(), features.values, features.is_there.tolist(), strict=True
    )
    with failures_named():
        detector.activate(rig)
        votes = [detector.decide(at, row if is_there else None) for at, row, is_there in rows]
        detector.shutdown()
    return votes


def filtered(votes: Iterable[SceneVote], scenes: SceneFilter) -> Iterator[Filtered]:
    """Yield the filter's result after each vote."""
    for one in votes:
        confirmed = scenes.update(one)
        yield Filtered(vote=one, confirmed=confirmed, posterior=scenes.posterior)


def confirm(
    votes: Iterable[SceneVote], policy: Policy, scenes: Sequence[str]
) -> list[ConfirmedScene]:
    """Return the confirmed scenes among `scenes`, by the policy."""
    found = map(policy.make_scene_filter(scenes).update, votes)
    return [scene for scene in found if scene is not None]
