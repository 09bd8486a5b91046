"""Print how soon each sensor that fails is named, and how often one is named that does not fail.

Run it by: python experiments/failing_sensors.py
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_module

from sceneslam.bus.policy import Policy
from sceneslam.bus.scene.scene_filter import ConfirmedScene
from sceneslam.config.build import make_source
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.resolve import resolved
from sceneslam.detection.decide import confirm
from sceneslam.interfaces import FeatureDetector, Source
from sceneslam.sources.changes.failing_sensor import FailingSensor
from sceneslam.sources.changes.failures import FAILURES, scene_of
from sceneslam.sources.simulator.stories import STORIES
from sceneslam.types.observation import Observation, SceneVote
from sceneslam.types.truth import GroundTruth

SEEDS = (100, 101, 102, 103, 104)
SPANS_S = ((4.0, 8.0), (8.0, 12.0))  # of a failure, one drive each: straight on, and in a bend
CAMERA = ("source.camera.size_wh=[320,240]", "source.camera.rate_hz=15", "source.laser=true")
STORY_SEEDS = (100, 101)
SUNNY = "depth_dropout"  # where the sun does blind the depth camera
DATA = Path("../shared/data")
RECORDINGS: Mapping[str, Sequence[str]] = {
    "tum_fr1_rpy": ("source=tum_rgbd", f"source.path={DATA / 'tum_fr1_rpy'}"),
    "7scenes_redkitchen": (
        "source=tum_rgbd",
        f"source.path={DATA / '7scenes_redkitchen'}",
        *(f"source.camera.{key}" for key in ("fx=585", "fy=585", "cx=320", "cy=240")),
        "source.depth_scale=1000",
    ),
    "carmen_aces": ("source=carmen", f"source.path={DATA / 'carmen_aces/aces.clf'}"),
    "carmen_mit_csail": (
        "source=carmen",
        f"source.path={DATA / 'carmen_mit_csail/mit-csail.clf'}",
    ),
}


SCENES = frozenset(map(scene_of, FAILURES))


class Kept:
    """A recording in memory, so that it is read once for all failures."""

    def __init__(self, source: Source) -> None:
        self.rig, self.length = source.rig, source.length
        self.faults: Sequence[str] = ()
        self.observations = list(source)
        self.truth = source.ground_truth()

    def __iter__(self) -> Iterator[Observation]:
        """Yield the observations."""
        return iter(self.observations)

    def ground_truth(self) -> GroundTruth | None:
        """Return what is known to be true."""
        return self.truth


class Seen:
    """What the scenario `failing_sensors` makes of a source: votes and confirmed scenes."""

    def __init__(self, source: Source, builder: ComponentBuilder) -> None:
        detector = builder.make("detector", FeatureDetector)
        detector.activate(source.rig)
        self.votes = [detector.get_scene(observation) for observation in source]
        self.confirmed = confirm(self.votes, builder.make("policy", Policy), detector.scenes)

    def first_named_s(self, scene: str) -> float | None:
        """Return when a scene was confirmed first, after the first observation."""
        stamps_ns = [one.stamp_ns for one in self.confirmed if one.scene == scene]
        return (stamps_ns[0] - self.votes[0].stamp_ns) * 1e-9 if stamps_ns else None

    def count_false(
        self, named: Sequence[SceneVote | ConfirmedScene], expected: Collection[str]
    ) -> int:
        """Return how many votes or confirmed scenes name a failure that there is not."""
        return sum(one.scene in SCENES and one.scene not in expected for one in named)


def build(words: Sequence[str]) -> tuple[Source, ComponentBuilder]:
    """Return a source of the scenario, and what builds its detector and policy."""
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        overrides = ["+scenario=failing_sensors", "run.progress=false", "effects=none", *words]
        config: dict[str, Any] = resolved(compose("config", overrides=overrides))
    builder = ComponentBuilder(config)
    return make_source(config, builder), builder


def failing(failure: str, drives: Mapping[int, tuple[Source, ComponentBuilder]]) -> str:
    """Return a line: one failure in the drives of all seeds."""
    delays_s, others = [], 0
    for (seed, (drive, builder)), span_s in product(drives.items(), SPANS_S):
        source = FailingSensor(
            drive, failure, [list(span_s)], names_scene=True, otherwise="Bright", seed=seed
        )
        seen = Seen(source, builder)
        named_s = seen.first_named_s(scene_of(failure))
        if named_s is not None:
            delays_s.append(named_s - span_s[0])
        others += len({one.scene for one in seen.confirmed} & SCENES - {scene_of(failure)})
    in_time = sum(0 <= delay_s <= 2.0 for delay_s in delays_s)
    median = f"{np.median(delays_s):.2f} | {max(delays_s):.2f}" if delays_s else "- | -"
    return f"| {failure} | {in_time} of {len(SEEDS) * len(SPANS_S)} | {median} | {others} |"


def calm(name: str, runs: Sequence[Sequence[str]]) -> str:
    """Return a line: recordings in which no sensor was made to fail."""
    seen = [Seen(*build(words)) for words in runs]
    expected = {"DepthBlinded"} if name == SUNNY else set()
    votes = sum(len(one.votes) for one in seen)
    false = sum(one.count_false(one.votes, expected) for one in seen)
    scenes = sum(one.count_false(one.confirmed, expected) for one in seen)
    return f"| {name} | {votes} | {false} ({100 * false / votes:.2f} %) | {scenes} |"


def main() -> None:
    """Print two tables."""
    drives: dict[int, tuple[Source, ComponentBuilder]] = {}
    for seed in SEEDS:
        source, builder = build([*CAMERA, f"seed={seed}"])
        kept = Kept(source)
        end_ns = kept.observations[0].stamp_ns + round(SPANS_S[-1][1] * 1e9)
        kept.observations = [one for one in kept.observations if one.stamp_ns < end_ns]
        drives[seed] = kept, builder
    print("| failure | named within 2 s | delay [s], median | at most | other failures named |")
    print("|---|---|---|---|---|")
    for failure in FAILURES:
        print(failing(failure, drives), flush=True)
    print("\n| recording without failures | votes | for a failure | confirmed |\n|---|---|---|---|")
    for story in STORIES:
        runs = [[*CAMERA, f"story={story}", "lights=story", f"seed={seed}"] for seed in STORY_SEEDS]
        print(calm(story, runs), flush=True)
    for name, words in RECORDINGS.items():
        print(calm(name, [words]), flush=True)


if __name__ == "__main__":
    main()
