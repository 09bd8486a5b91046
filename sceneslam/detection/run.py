"""Runs without SLAM: the scenes that detector and policy find in a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sceneslam.bus.policy import Policy
from sceneslam.bus.scene.scene_filter import ConfirmedScene
from sceneslam.bus.scene.watch import log_vote
from sceneslam.config.build import (
    check_detector,
    check_mode,
    check_no_map,
    make_evaluation,
    opened_source,
)
from sceneslam.config.check import check_keys, check_no_reference
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.provenance import save_config
from sceneslam.config.settings import DETECT_ONLY, RunSettings
from sceneslam.detection.decide import Filtered, filtered, vote
from sceneslam.detection.features import RecordingFeatures
from sceneslam.detection.recall import recall
from sceneslam.evaluation.detection import score_detection
from sceneslam.evaluation.metrics import Metrics, write_metrics
from sceneslam.evaluation.report.summary import number
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.evaluation.switches import true_scene
from sceneslam.interfaces import FeatureDetector
from sceneslam.storage.events import EventLog
from sceneslam.types.observation import UNSURE, SceneVote
from sceneslam.types.rig import Rig
from sceneslam.types.truth import GroundTruth


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """A recording's features, on which other settings of the detector can be tried."""

    rig: Rig
    features: RecordingFeatures


def watch(config: Mapping[str, Any]) -> Watched:
    """Return the features for a configuration; raises ConfigError or InputError."""
    check_keys(config)
    check_no_map(config)
    check_no_reference(config, f"where run.mode is {DETECT_ONLY}: it has no trajectory")
    builder = ComponentBuilder(config)
    run = builder.make("run", RunSettings)
    detector = builder.make("detector", FeatureDetector)
    make_evaluation(builder, detector)  # before the recording is read
    with opened_source(config, builder) as source:
        check_mode(run, source)
        rig = source.rig
        check_detector(config, detector, rig)
        features = recall(config, detector, source, run)
    return Watched(rig=rig, features=features)


def detect(
    config: Mapping[str, Any], folder: Path, say: Callable[[str], None] = lambda text: None
) -> tuple[str, ...]:
    """Write events, metrics and configuration to a folder; return the faults.

    `say` receives a summary in short lines.
    """
    watched = watch(config)
    builder = ComponentBuilder(config)
    detector = builder.make("detector", FeatureDetector)
    votes = vote(detector, watched.rig, watched.features)
    scene_filter = builder.make("policy", Policy).make_scene_filter(detector.scenes)
    results = list(filtered(votes, scene_filter))
    confirmed = [one.confirmed for one in results if one.confirmed is not None]
    folder.mkdir(parents=True, exist_ok=True)
    fault = _write_events(folder / "events.jsonl", results)
    save_config(config, folder / "config.yaml")
    evaluation = make_evaluation(builder, detector)
    metrics = score(watched.features, confirmed, evaluation)
    write_metrics(folder / "metrics.json", metrics)
    names = {scene: evaluation.scenes.get(scene, scene) for scene in detector.scenes}
    scores = metrics["detection"]
    lines = [
        f"{metrics['observations']} observations, {scores['confirmed']} scenes confirmed",
        f"votes: {_shares(votes, watched.features.truth, names)}",
        f"false {number(scores['false'], 0)}, missed {number(scores['missed'], 0)}, "
        f"found {number(scores['delay_s'], 2, ' s')} after the change "
        f"(at most {number(scores['delay_max_s'], 2, ' s')}), "
        f"wrong for {number(scores['wrong_s'], 2, ' s')}",
    ]
    say("\n".join(lines))
    return (*watched.features.faults, *([fault] if fault else []))


def score(
    features: RecordingFeatures, confirmed: Sequence[ConfirmedScene], settings: EvaluationSettings
) -> Metrics:
    """Return the metrics of confirmed scenes, with the names of a run with SLAM."""
    stamps_ns = features.stamps_ns
    end_ns = int(stamps_ns[-1]) if len(stamps_ns) else 0
    events = [asdict(scene) for scene in confirmed]
    return {
        "detection": score_detection(events, features.truth, end_ns, settings.scenes),
        "observations": len(stamps_ns),
    }


def _shares(votes: Sequence[SceneVote], truth: GroundTruth | None, names: Mapping[str, str]) -> str:
    """Return a text with each scene's share of votes, and the share of correct votes.

    `names` maps the detector's scenes to the truth's. The correct votes are left out if the truth
    contains none of the names: it is about other scenes.
    """
    counts = Counter(one.scene for one in votes)
    shares = [f"{scene} {100 * count / len(votes):.1f} %" for scene, count in counts.most_common()]
    cast = [one for one in votes if one.scene != UNSURE]
    true = {change.scene for change in truth.scenes} if truth else set()
    if truth is not None and cast and true & set(names.values()):
        right = sum(true_scene(truth, one.stamp_ns) == names.get(one.scene) for one in cast)
        shares.append(f"{100 * right / len(cast):.1f} % right")
    return ", ".join(shares) or "none"


def _write_events(path: Path, results: Sequence[Filtered]) -> str:
    """Write votes and scenes as a run with SLAM does; return the fault, "" without one."""
    log = EventLog(path)
    for one in results:
        log_vote(log, one.vote, one.confirmed, one.posterior)
    log.close()
    return log.fault
