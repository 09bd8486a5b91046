"""The experiment `one_map`: what a map of all modules and runs promises, and what holds.

`conf/experiment/one_map.yaml` says how it is called, `README.md` beside this what was found.
"""

from __future__ import annotations

import filecmp
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import yaml

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting.map_files import load_map_files, save_map_files
from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.config.build import make_source
from sceneslam.config.component import ComponentBuilder
from sceneslam.evaluation.association import interpolated
from sceneslam.experiments.one_map.drive import Drive, Odometry, map_of
from sceneslam.experiments.one_map.relocalization import (
    Starts,
    StoryStarts,
    random_starts,
    together,
)
from sceneslam.testing.floor_plans import (
    CUPBOARD,
    DEPTH_LIKE,
    FLAT_TOUR,
    TWINS_FIRST,
    TWINS_SECOND,
    Scanner,
    World,
    box,
    flat,
    niches,
    through,
    twins,
)
from sceneslam.types import planar, se3
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_least, check_some
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_VOXEL_M = 0.05
_SCANNERS = {"laser": Scanner(), "depth": DEPTH_LIKE}
_TURN_DEVIATION = 0.005  # that odometry off by 0.003 rad per metre states
_WRONG_M = 1.0  # places that look alike are 3 m apart or more


class OneMapExperiment:
    """Runs stories on the map of another, and floor plans where many drives are wanted."""

    def __init__(
        self,
        *,
        mapped_story: str,
        stories: Sequence[str],
        seeds: Sequence[int],
        starts: int,
        story_seeds: Sequence[int],
        within_s: float,
        found_min: float,
        error_max_m: float,
        error_max_deg: float,
        alike_turn_deviation: float,
        drift_ratio: float,
        laps: int,
        kills: int,
    ) -> None:
        check_some(stories=stories, seeds=seeds, story_seeds=story_seeds)
        check_least(1, starts=starts, laps=laps, kills=kills)
        check_above(0, within_s=within_s, error_max_m=error_max_m, error_max_deg=error_max_deg)
        check_above(0, alike_turn_deviation=alike_turn_deviation)
        self._mapped, self._stories, self._seeds = mapped_story, tuple(stories), tuple(seeds)
        self._starts, self._within_s, self._found_min = starts, within_s, found_min
        self._story_seeds = tuple(story_seeds)
        self._error_max_m, self._error_max_rad = error_max_m, float(np.radians(error_max_deg))
        self._alike_turn_deviation = alike_turn_deviation
        self._drift_ratio, self._laps, self._kills = drift_ratio, laps, kills
        self._rows: list[list[str | float | None]] = []

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return what holds of the nine promises that can be run in minutes."""
        maps = folder / "maps"
        maps.mkdir(parents=True, exist_ok=True)
        figures = [
            *self._stories_on_a_map(run_trials, maps),
            *self._saved(maps),
            *self._relocalized(),
            *self._relocalized_in_stories(run_trials, maps),
            *self._alike(),
            *self._updated(maps),
            *self._drifting(),
        ]
        table = Table(columns=("what", "measured"), rows=self._rows)
        return Verdict(figures=figures, table=table)

    def _stories_on_a_map(self, run_trials: RunTrials, maps: Path) -> Iterator[Figure]:
        """Run a story, and others on its map; their poses must lie in it."""
        saving = Trial(
            name="mapped",
            overrides=(f"story={self._mapped}",),
            values={"atlas": {"save": str((maps / "story").resolve())}},
        )
        (first,) = run_trials([saving])
        trials = [
            Trial(
                name=f"in_it/{story}",
                overrides=(f"story={story}",),
                values={"atlas": {"load": str((maps / "story").resolve()), "mode": "localize"}},
            )
            for story in self._stories
        ]
        T_map_gt = _map_of(first)
        for outcome in run_trials(trials):
            truth, name = _truth(outcome), outcome.trial.overrides[0]
            _, own, true = np.intersect1d(
                outcome.trajectory.stamps_ns, truth.stamps_ns, return_indices=True
            )
            due_m = (T_map_gt @ truth.T_world_base[true])[:, :2, 3]
            off_m = np.linalg.norm(outcome.trajectory.positions_m[own, :2] - due_m, axis=1)
            rmse_m, worst_m = float(np.sqrt((off_m**2).mean())), float(off_m.max())
            self._rows.append([f"{name} in the map of {self._mapped}: RMSE [m]", rmse_m])
            yield Figure.at_most(f"{name}: worst pose in the map", worst_m, self._error_max_m, "m")

    def _saved(self, maps: Path) -> Iterator[Figure]:
        """Save what was loaded; kill processes that save."""
        again = maps / "again"
        save_map_files(load_map_files(maps / "story"), again)
        names = sorted(path.name for path in (maps / "story").iterdir())
        same, other, missing = filecmp.cmpfiles(maps / "story", again, names, shallow=False)
        changed = len(other) + len(missing) + (len(same) == 0)
        yield Figure.at_most("save, load, save: files that differ", changed, 0)
        broken = _killed(maps / "story", maps / "killed", self._kills, self._seeds[0])
        yield Figure.at_most(f"killed {self._kills} times while saving: broken maps", broken, 0)

    def _relocalized(self) -> Iterator[Figure]:
        """Start at random places of a map, every scanner in every other's."""
        for mapper, finder in ((m, f) for m in _SCANNERS for f in _SCANNERS):
            found = random_starts(
                flat(),
                _SCANNERS[mapper],
                _SCANNERS[finder],
                count=self._starts,
                within_s=self._within_s,
                seed=self._seeds[0],
            )
            yield from self._judged(f"{finder} in the map of {mapper}", found)

    def _relocalized_in_stories(self, run_trials: RunTrials, maps: Path) -> Iterator[Figure]:
        """Start anywhere in a story, in the map of another story of the same rooms."""
        every = []
        for seed in self._story_seeds:
            folder = maps / f"{self._mapped}_{seed}"
            saves = {self._mapped: {"atlas": {"save": str(folder.resolve())}}}
            trials = [
                Trial(
                    name=f"starts/{story}/{seed}",
                    overrides=(f"story={story}", f"seed={seed}"),
                    values=saves.get(story, {}),
                )
                for story in (self._mapped, *self._stories)
            ]
            first, *others = run_trials(trials)
            saved, T_map_gt = load_map_files(folder), _map_of(first)
            every += [self._started(saved, T_map_gt, outcome, seed) for outcome in others]
        for light, is_lit in (("the light", True), ("the dark", False)):
            shared, others = (
                together([starts.found(is_lit=is_lit, is_shared=is_shared) for starts in every])
                for is_shared in (True, False)
            )
            name = f"story in the map of {self._mapped}, in {light}"
            yield Figure.at_least(f"{name}: starts that share geometry", shared.count, 1)
            yield from self._judged(name, shared)
            yield Figure.at_most(f"{name}: elsewhere, found in a wrong place", others.wrong, 0)
            self._rows += [
                [f"{name}: starts", shared.count],
                [f"{name}: starts where no view of the map was near", others.count],
                [f"{name}: found of these", others.found],
            ]

    def _started(
        self, saved: SavedMap, T_map_gt: Transform, outcome: TrialResult, seed: int
    ) -> StoryStarts:
        """Drive a story again, and start all over in it."""
        config = yaml.safe_load((outcome.folder / "config.yaml").read_text())
        source, truth = make_source(config, ComponentBuilder(config)), _truth(outcome)
        starts = StoryStarts(
            saved,
            source.rig,
            outcome.online,
            lambda ns: T_map_gt @ interpolated(truth, np.array([ns])).T_world_base[0],
            count=self._starts,
            within_s=self._within_s,
            seed=seed,
        )
        for observation in source:
            starts.observe(observation)
        return starts

    def _judged(self, name: str, found: Starts) -> Iterator[Figure]:
        self._rows.append([f"{name}: found", found.found_ratio])
        yield Figure.at_least(
            f"{name}: found in {self._within_s:g} s", found.found_ratio, self._found_min
        )
        yield Figure.at_most(f"{name}: found in a wrong place", found.wrong, 0)
        yield Figure.at_most(f"{name}: worst position", found.worst_m, self._error_max_m, "m")
        worst_deg, most_deg = np.degrees(found.worst_rad), np.degrees(self._error_max_rad)
        yield Figure.at_most(f"{name}: worst heading", float(worst_deg), float(most_deg), "deg")

    def _alike(self) -> Iterator[Figure]:
        """Drive where places look alike, by odometry that drifts."""
        plans = {
            "two rooms alike": (twins(), (*TWINS_FIRST, *TWINS_SECOND, *TWINS_SECOND[::-1][1:])),
            "a corridor of niches": (niches(10), ((0.8, 0.0), (28.0, 0.0), (0.8, 0.1))),
        }
        for name, (walls, corners) in plans.items():
            loops = wrong = 0
            for seed in self._seeds:
                rng, true = np.random.default_rng(seed), through(corners)
                odometry = Odometry(scale=rng.normal(0, 0.02), turn_rad_per_m=rng.normal(0, 0.005))
                atlas = Atlas(voxel_m=_VOXEL_M)
                drive = Drive(atlas, turn_deviation=self._alike_turn_deviation).go(
                    World(walls, rng, Scanner()), true, odometry=odometry, sessions=4
                )
                off_m = drive.loops_off_m(true)
                loops += len(off_m)
                wrong += max(off_m, default=0.0) > _WRONG_M
            self._rows.append([f"{name}: loops over {len(self._seeds)} drives", loops])
            yield Figure.at_most(f"{name}: drives with a wrong loop", wrong, 0)

    def _updated(self, maps: Path) -> Iterator[Figure]:
        """Move a cupboard between two runs."""
        true, old = through(FLAT_TOUR), maps / "flat"
        Drive(Atlas(voxel_m=_VOXEL_M, save=str(old))).go(self._world(), true)
        moved = World(
            [wall for wall in flat() if wall not in CUPBOARD] + box(4.6, 0.1, 5.4, 0.5),
            np.random.default_rng(self._seeds[0] + 1),
            Scanner(),
        )
        atlas = Atlas(voxel_m=_VOXEL_M, load=str(old), save=str(maps / "today"), mode="update")
        Drive(atlas).go(moved, through(FLAT_TOUR))
        plan = load_map_files(maps / "today").plan()
        T_map_world = map_of(true)
        rim = [planar.compose(T_map_world, np.array([*at, 0.0]))[:2] for at in _rim()]
        free = float(plan.is_free(np.array(rim)).mean())
        yield Figure.at_least("furniture moved: its old walls that are free afterwards", free, 1.0)

    def _drifting(self) -> Iterator[Figure]:
        """Drive laps by odometry that drifts, with the loops and without."""
        ratios = []
        for seed in self._seeds[:5]:
            rng = np.random.default_rng(seed)
            true = through(FLAT_TOUR * self._laps)
            turn = float(rng.choice([-1.0, 1.0])) * 0.003
            odometry = Odometry(scale=self._drift_ratio, turn_rad_per_m=turn)
            drive = Drive(Atlas(voxel_m=_VOXEL_M), turn_deviation=_TURN_DEVIATION).go(
                World(flat(), rng, Scanner()), true, odometry=odometry, sessions=4 * self._laps
            )
            with_m = _rmse_m(drive.errors_m(true, map_of(true)))
            without_m = _rmse_m(drive.drifted_m(true, map_of(true)))
            ratios.append(with_m / without_m)
            self._rows.append([f"laps, seed {seed}: RMSE without loops [m]", without_m])
            self._rows.append([f"laps, seed {seed}: RMSE with loops [m]", with_m])
        drift = f"odometry off by {self._drift_ratio:.0%}"
        yield Figure.at_most(f"{drift}: error with loops over that without", max(ratios), 1 / 3)

    def _world(self) -> World:
        return World(flat(), np.random.default_rng(self._seeds[0]), Scanner())


def _truth(outcome: TrialResult) -> Trajectory:
    return Trajectory.read_tum(outcome.folder / "groundtruth.tum")


def _map_of(outcome: TrialResult) -> Transform:
    """Return T_map_gt (4, 4): a map begins at the run's first pose."""
    return se3.inverse(_truth(outcome).T_world_base[0])


def _rmse_m(errors_m: np.ndarray) -> float:
    return float(np.sqrt((errors_m**2).mean()))


def _rim() -> list[tuple[float, float]]:
    """Return points on the walls of the cupboard, every 0.1 m."""
    return [
        (x0 + (x1 - x0) * part, y0 + (y1 - y0) * part)
        for x0, y0, x1, y1 in CUPBOARD
        for part in np.arange(0.05, 1.0, 0.1).tolist()
    ]


_SAVES = """
import sys
from pathlib import Path
from sceneslam.atlas.lasting.map_files import load_map_files, save_map_files
saved = load_map_files(Path(sys.argv[1]))
smaller = saved.of(range(len(saved.submaps) - 1))
print("ready", flush=True)
while True:
    save_map_files(smaller, Path(sys.argv[2]))
    save_map_files(saved, Path(sys.argv[2]))
"""


def _killed(source: Path, target: Path, times: int, seed: int) -> int:
    """Return how many maps cannot be read after their writer was killed."""
    save_map_files(load_map_files(source), target)
    rng, broken = np.random.default_rng(seed), 0
    for _ in range(times):
        command = [sys.executable, "-c", _SAVES, str(source), str(target)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.2))
            writer.send_signal(signal.SIGKILL)
        try:
            load_map_files(target)
        except Exception:
            broken += 1
    return broken
