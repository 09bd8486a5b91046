"""Print what the 2D laser module and the atlas make of a CARMEN log, beside wheel odometry.

    python experiments/laser.py LOG RELATIONS                     # odometry, no loops, loops
    python experiments/laser.py LOG RELATIONS harder              # the same log made harder
    python experiments/laser.py LOG RELATIONS pieces LIE SEED     # without loops, wheels that lie
    python experiments/laser.py LOG RELATIONS profile             # where time goes (4,000 scans)
    python experiments/laser.py LOG RELATIONS maps FOLDER         # pictures of the map

Errors are over all relations (Kuemmerle et al., 2009), time is CPU time of the whole run.
"""

from __future__ import annotations

import cProfile
import pstats
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from time import process_time

import cv2
import numpy as np
import yaml

from sceneslam.atlas.atlas import Atlas
from sceneslam.evaluation.relations import Relations, motion_errors, relation_errors
from sceneslam.experiments.scripts import CONF, settings
from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.sources.carmen import Carmen
from sceneslam.sources.changes.spoilt_odometry import SpoiltOdometry
from sceneslam.types.errors import InputError
from sceneslam.types.maps import GridLayer
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.trajectory import Trajectory

PIECE = 300  # scans, each piece begins anew
CAP_M, LOST_M = 1.0, 0.25  # an error counts at most so much; a relation is lost with more
HEAD = "| run | trans [m] | rot [deg] | online: trans, rot | x real time | ms: median, p99, max |"


def by_wheels(observations: list[Observation]) -> Trajectory:
    """Return the trajectory by odometry alone."""
    return Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in observations]),
        T_world_base=np.stack([one.T_odom_base for one in observations]),
    )


def backwards(observations: list[Observation]) -> Iterator[Observation]:
    """Yield the log from its end; stamps are mirrored, and mirrored back by `unmirror`."""
    last_ns = observations[-1].stamp_ns
    for observation in reversed(observations):
        yield restamped(observation, 2 * last_ns - observation.stamp_ns)


def restamped(observation: Observation, stamp_ns: int) -> Observation:
    """Return an observation at another stamp."""
    return replace(
        observation, stamp_ns=stamp_ns, scan=replace(observation.scan, stamp_ns=stamp_ns)
    )


def seen_by_less(observations: Iterable[Observation], fov_deg: float, range_m: float):
    """Yield scans of a narrower and shorter view."""
    for observation in observations:
        ranges_m = observation.scan.ranges_m.copy()
        outside = np.abs(observation.scan.angles_rad) > np.radians(fov_deg / 2)
        ranges_m[outside | (ranges_m > range_m)] = np.nan
        yield replace(observation, scan=replace(observation.scan, ranges_m=ranges_m))


@dataclass(frozen=True, kw_only=True)
class Log:
    """A log with the relations that its poses are compared with."""

    source: Carmen
    relations: Relations

    def errors(self, trajectory: Trajectory) -> dict[str, float]:
        """Return the errors of a trajectory; relations name scans by the log's own stamps."""
        stamps_ns = self.source.logged_ns(trajectory.stamps_ns)
        return relation_errors(trajectory.stamped(stamps_ns), self.relations)


class Run:
    """One pass of the laser module over a log, with or without loops by the atlas."""

    def __init__(
        self, rig: Rig, observations: Iterable[Observation], *, has_loops: bool = True
    ) -> None:
        module, atlas = LaserSlam(**settings("slam/laser.yaml")), Atlas(voxel_m=0.05)
        module.activate(rig)
        atlas.open(rig, self._note)
        session = atlas.begin_session("laser", np.eye(4))
        self.costs_ms: list[float] = []
        began_s = process_time()
        for observation in observations:
            before_s = process_time()
            tracking = module.track(observation)
            atlas.add_local(tracking.stamp_ns, tracking.T_local_base)
            atlas.add(tracking.stamp_ns, tracking.T_local_base, "laser", tracking.covariance)
            if has_loops:
                atlas.observe(observation, None)
            else:
                atlas.report(tracking.stamp_ns)
            self.costs_ms.append((process_time() - before_s) * 1e3)
        atlas.close_session(session, module.get_map(), module.get_trajectory())
        faults = atlas.finish()
        assert not faults, faults
        self.online, self.revised, self.map = atlas.online, atlas.trajectory, atlas.fuse_maps()
        self.cpu_s = process_time() - began_s

    def _note(self, event: str, stamp_ns: int, **fields: object) -> None:
        """Ignore an event."""

    def row(self, name: str, log: Log, mirror_ns: int = 0) -> str:
        """Return a line of the table."""
        revised, online = (
            log.errors(unmirrored(one, mirror_ns)) for one in (self.revised, self.online)
        )
        span_s = np.ptp(self.online.stamps_ns) * 1e-9
        costs = np.array(self.costs_ms)
        return (
            f"| {name} | {spread(revised, 'trans', 'm')} | {spread(revised, 'rot', 'deg')} "
            f"| {online['trans_mean_m']:.3f}, {online['rot_mean_deg']:.2f} "
            f"| {span_s / self.cpu_s:.0f} "
            f"| {np.median(costs):.1f}, {np.percentile(costs, 99):.1f}, {costs.max():.0f} |"
        )


def unmirrored(trajectory: Trajectory, mirror_ns: int) -> Trajectory:
    """Return a trajectory with the stamps of the log."""
    if not mirror_ns:
        return trajectory
    return Trajectory(
        stamps_ns=2 * mirror_ns - trajectory.stamps_ns[::-1],
        T_world_base=trajectory.T_world_base[::-1],
    )


def spread(errors: dict[str, float], kind: str, unit: str) -> str:
    """Return mean and deviation."""
    return f"{errors[f'{kind}_mean_{unit}']:.4f} +- {errors[f'{kind}_std_{unit}']:.4f}"


def draw(grid: GridLayer, path: Path) -> None:
    """Write a grid as a picture at two cells per pixel."""
    shade = np.where(grid.log_odds > 0, 0, np.where(grid.log_odds < 0, 255, 205)).astype(np.uint8)
    rows, columns = np.nonzero(grid.log_odds)
    shade = shade[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1][::-1]
    half = cv2.erode(shade, np.ones((2, 2), np.uint8))[::2, ::2]
    cv2.imwrite(str(path), half, [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_BILEVEL, 0])


def compare(log: Log) -> None:
    """Print odometry, the laser without loops, and with them; and what memory it took."""
    source, observations = log.source, list(log.source)
    odometry = log.errors(by_wheels(observations))
    print(f"{HEAD}\n|---|---|---|---|---|---|")
    print(
        f"| wheel odometry | {spread(odometry, 'trans', 'm')} "
        f"| {spread(odometry, 'rot', 'deg')} | | | |"
    )
    print(Run(source.rig, observations, has_loops=False).row("no loops", log))
    before_mb = getrusage(RUSAGE_SELF).ru_maxrss / 1e3
    run = Run(source.rig, observations)
    print(run.row("with loops", log))
    graph = run.map.pose_graph
    print(
        f"\n{odometry['matched']} of {odometry['total']} relations matched; "
        f"{len(graph.stamps_ns)} submaps, {graph.is_loop.sum()} loops; peak memory "
        f"{getrusage(RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB, {before_mb:.0f} MB before closing loops"
    )


def harder(log: Log) -> None:
    """Print how the module does where it sees less, or the same from the other end."""
    source, observations = log.source, list(log.source)
    last_ns = observations[-1].stamp_ns
    print(f"{HEAD}\n|---|---|---|---|---|---|")
    print(Run(source.rig, observations[::3]).row("every third scan", log), flush=True)
    print(Run(source.rig, backwards(observations)).row("backwards", log, last_ns), flush=True)
    for fov_deg, range_m in ((90, 8), (57, 4)):
        view = seen_by_less(observations, fov_deg, range_m)
        print(Run(source.rig, view).row(f"{fov_deg} deg, {range_m} m", log), flush=True)


def pieces(log: Log, lie: str, seed: int) -> None:
    """Print the errors of relations within pieces of the log, driven one by one, without loops."""
    lies = yaml.safe_load((CONF / "experiment/liars.yaml").read_text())["liars"]["lies"]
    lies["none"] = {"lie": "none"}
    if lie not in lies:
        raise InputError(f"lie: got {lie!r}, allowed: {', '.join(map(repr, lies))}")
    source = SpoiltOdometry(
        log.source, **{**settings("effects/liars.yaml"), "seed": seed, **lies[lie]}
    )
    observations, found = list(source), []
    for first in range(0, len(observations), PIECE):
        run = Run(source.rig, observations[first : first + PIECE], has_loops=False)
        stamps_ns = log.source.logged_ns(run.online.stamps_ns)
        found.append(motion_errors(run.online.stamped(stamps_ns), log.relations))
    away_m, turned_deg = np.concatenate(found).T
    print(f"| wheels, seed | relations | trans [m] | rot [deg] | > {LOST_M} m |")
    print("|---|---|---|---|---|")
    print(
        f"| {lie}, {seed} | {len(away_m)} | {np.minimum(away_m, CAP_M).mean():.4f} "
        f"| {turned_deg.mean():.3f} | {(away_m > LOST_M).sum()} |"
    )


def main() -> None:
    """Run one of the commands above."""
    cv2.setNumThreads(1)
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    path, relations, *words = sys.argv[1:]
    source = Carmen(**{**settings("source/carmen.yaml"), "path": path})
    log = Log(source=source, relations=Relations.read(Path(relations)))
    if words == ["harder"]:
        harder(log)
    elif len(words) == 3 and words[0] == "pieces" and words[2].isdigit():
        pieces(log, words[1], int(words[2]))
    elif words == ["profile"]:
        with cProfile.Profile() as profile:
            Run(source.rig, islice(source, 4000))
        pstats.Stats(profile).sort_stats("tottime").print_stats(12)
    elif words[:1] == ["maps"]:
        for name, has_loops in (("laser_loops", True), ("laser_no_loops", False)):
            grid = Run(source.rig, source, has_loops=has_loops).map.grid
            draw(grid, Path(words[1]) / f"{name}.png")
    elif words:
        sys.exit(__doc__)
    else:
        compare(log)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
