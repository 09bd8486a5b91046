"""Print how late and how wrongly scenes are confirmed: the paper's window beside the Bayes filter.

Votes are drawn, not taken from images: scenes of 8 s and more change at random, and votes are wrong
now and then, or for a while. Each filter's setting is chosen on one drive and scored on others.

Run it by: python experiments/scene_filters.py
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from sceneslam.bus.scene.bayes_filter import BayesFilter, BayesSettings
from sceneslam.bus.scene.scene_filter import SceneFilter, WindowFilter
from sceneslam.evaluation.detection import score_detection
from sceneslam.types.observation import SceneVote
from sceneslam.types.truth import GroundTruth, SceneChange

SCENES = ("Bright", "Dark")
RATE_HZ, LASTING_S = 10.0, 1200.0
DWELL_MIN_S, DWELL_S = 8.0, 30.0
FALSE_MAX = 1  # in 20 minutes, on the drive that a setting is chosen on
SEEDS = (1, 2, 3)  # of the drives that it is scored on
WINDOWS_S = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0)
CORRELATIONS_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
ERROR_RATIOS = (0.1, 0.3)


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """How votes go wrong."""

    name: str
    error_ratio: float = 0.0  # of the votes, each by itself
    bursts_hz: float = 0.0  # how often all votes of 0.2 to 0.8 s are wrong


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Votes, and the true scenes."""

    votes: Sequence[SceneVote]
    truth: GroundTruth


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """What a filter made of a drive."""

    false: float
    missed: float
    delay_s: float
    wrong_ratio: float


WORLDS = (
    World(name="no wrong vote"),
    World(name="5 % wrong", error_ratio=0.05),
    World(name="10 % wrong", error_ratio=0.1),
    World(name="20 % wrong", error_ratio=0.2),
    World(name="drop-outs", bursts_hz=0.1),
    World(name="drop-outs, 10 % wrong", error_ratio=0.1, bursts_hz=0.1),
)


def drive(world: World, seed: int) -> Drive:
    """Return 20 minutes of votes."""
    rng = np.random.default_rng([seed, WORLDS.index(world)])
    stamps_s = np.arange(0.0, LASTING_S, 1 / RATE_HZ)
    turns_s = [0.0]
    while turns_s[-1] < LASTING_S:
        turns_s.append(turns_s[-1] + DWELL_MIN_S + rng.exponential(DWELL_S - DWELL_MIN_S))
    true = np.searchsorted(turns_s, stamps_s, side="right") % 2
    is_wrong = rng.random(len(stamps_s)) < world.error_ratio
    for start_s in rng.uniform(0, LASTING_S, round(world.bursts_hz * LASTING_S)):
        is_wrong |= (stamps_s >= start_s) & (stamps_s < start_s + rng.uniform(0.2, 0.8))
    voted = np.where(is_wrong, 1 - true, true)
    stamps_ns = np.round(stamps_s * 1e9).astype(np.int64).tolist()
    return Drive(
        votes=[
            SceneVote(stamp_ns=at, scene=SCENES[k])
            for at, k in zip(stamps_ns, voted.tolist(), strict=True)
        ],
        truth=GroundTruth(
            scenes=tuple(
                SceneChange(stamp_ns=round(at_s * 1e9), scene=SCENES[(number + 1) % 2])
                for number, at_s in enumerate(turns_s)
            )
        ),
    )


def window_filters() -> Iterator[tuple[str, SceneFilter]]:
    """Yield a new filter per window."""
    for window_s in WINDOWS_S:
        yield f"{window_s:g} s", WindowFilter(window_s=window_s, first_window_s=0.0)


def bayes_filters() -> Iterator[tuple[str, SceneFilter]]:
    """Yield a new filter per setting."""
    for correlation_s, error_ratio in product(CORRELATIONS_S, ERROR_RATIOS):
        settings = BayesSettings(
            mean_dwell_s=DWELL_S,
            error_ratio=error_ratio,
            correlation_s=correlation_s,
            confirm_probability=0.99,
        )
        yield f"{correlation_s:g} s, {error_ratio:g}", BayesFilter(SCENES, settings)


def score(filter_: SceneFilter, one: Drive) -> Score:
    """Return what a filter makes of a drive."""
    found = [scene for scene in map(filter_.update, one.votes) if scene is not None]
    events = [{"stamp_ns": scene.stamp_ns, "scene": scene.scene} for scene in found]
    end_ns = one.votes[-1].stamp_ns
    scores = score_detection(events, one.truth, end_ns, {})
    first_ns = found[0].stamp_ns if found else end_ns  # until then no scene is known
    return Score(
        false=scores["false"],
        missed=scores["missed"],
        delay_s=np.nan if scores["delay_s"] is None else scores["delay_s"],
        wrong_ratio=(scores["wrong_s"] + first_ns * 1e-9) / LASTING_S,
    )


def main() -> None:
    """Print a table: per kind of votes and filter, the chosen setting and its scores."""
    print("| votes | filter | chosen | delay [s] | missed | false | wrong |")
    print("|---|---|---|---|---|---|---|")
    for world in WORLDS:
        chosen_on = drive(world, 0)
        drives = [drive(world, seed) for seed in SEEDS]
        for kind, make in (("window", window_filters), ("Bayes", bayes_filters)):
            tried = {name: score(filter_, chosen_on) for name, filter_ in make()}
            calm = {name: one for name, one in tried.items() if one.false <= FALSE_MAX}
            name = min(calm, key=lambda name: calm[name].wrong_ratio)
            scores = [score(dict(make())[name], one) for one in drives]
            mean = {
                field: float(np.nanmean([getattr(one, field) for one in scores]))
                for field in ("delay_s", "missed", "false", "wrong_ratio")
            }
            print(
                f"| {world.name} | {kind} | {name} | {mean['delay_s']:.2f} | {mean['missed']:.1f} "
                f"| {mean['false']:.1f} | {100 * mean['wrong_ratio']:.1f} % |",
                flush=True,
            )


if __name__ == "__main__":
    main()
