"""Votes and confirmed scenes from features: what the bus does, without the images and the SLAM."""

from __future__ import annotations

from collections.abc import Iterable

from sceneslam.bus.policy import Policy
from sceneslam.bus.scene_filter import ConfirmedScene, SceneFilter
from sceneslam.detection.features import Features
from sceneslam.interfaces import FeatureDetector
from sceneslam.types.observation import SceneVote
from sceneslam.types.rig import Rig


def vote(detector: FeatureDetector, rig: Rig, features: Features) -> list[SceneVote]:
    """Return the detector's votes on every observation."""
    detector.activate(rig)
    told = zip(
        features.stamps_ns.tolist(), features.values, features.is_there.tolist(), strict=True
    )
    votes = [detector.decide(at, row if is_there else None) for at, row, is_there in told]
    detector.shutdown()
    return votes


def confirm(votes: Iterable[SceneVote], policy: Policy) -> list[ConfirmedScene]:
    """Return the scenes that the policy confirms by votes."""
    scenes = SceneFilter(
        window_s=policy.confirm_window_s, first_window_s=policy.first_confirm_window_s
    )
    return [found for found in map(scenes.update, votes) if found is not None]
