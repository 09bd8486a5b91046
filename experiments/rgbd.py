"""Print how well and how fast the RGB-D module follows recordings in the TUM layout.

    export OPENBLAS_NUM_THREADS=1  # as `python -m sceneslam` sets it; two threads are slower
    python experiments/rgbd.py FOLDER [FX FY CX CY DEPTH_SCALE]  # the table below
    python experiments/rgbd.py FOLDER [...] sweep  # seeds and feature counts
    python experiments/rgbd.py FOLDER [...] thinned  # every second to fourth image
    python experiments/rgbd.py FOLDER [...] profile  # where the time goes

Every recording is also run backwards and with every second image, since one ATE says little.
`told` is what `track` returned, `revised` what `get_trajectory` did. Times are per image, reading
excluded; CPU times of tracking are of all threads, those in all of the side process too.
"""

from __future__ import annotations

import cProfile
import pstats
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from time import perf_counter, process_time, sleep

import cv2
import numpy as np
from rgbd_loop import poses_of

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.experiments.scripts import backwards, settings
from sceneslam.modules.slam.rgbd.module import RgbdSlam
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.trajectory import Trajectory

COUNTS = (700, 940, 970, 1030, 1060, 1500)
GAP_S = 0.01  # between a pose and its truth
HEAD = (
    "| run | ATE online (max) [mm] | revised [mm] | no pose | keyframes "
    "| CPU ms: median, p95 | wall ms: median, p95 | CPU in all, per image [ms] |"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """What one pass over a recording gave."""

    answers: list[Tracking]
    told: Trajectory
    revised: Trajectory
    keyframes: int
    cpu_ms: list[float]
    wall_ms: list[float]
    side_cpu_s: float


def recording(words: list[str]) -> TumRgbd:
    """Return the recording that the command line names."""
    numbers = [float(word) for word in words[1:6]]
    known = dict.fromkeys(("fx", "fy", "cx", "cy", "distortion"))
    camera = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=False)) | {"distortion": None}
    return TumRgbd(
        path=words[0],
        camera=camera if numbers else known,
        depth_scale=numbers[4] if numbers else 5000.0,
        depth_range_m=[0.3, 8.0],
        sync_tolerance_s=0.02,
    )


def follow(
    rig: Rig,
    observations: Iterator[Observation] | list[Observation],
    *,
    period_s: float = 0.0,
    **changes,
) -> Run:
    """Run the module over observations, of which one comes every period at most."""
    shipped = settings("slam/rgbd.yaml") | {"seed": 0, "is_repeatable": True}
    module = RgbdSlam(**(shipped | changes))
    module.activate(rig)
    side_cpu_s = children_cpu_s()
    answers, cpu_ms, wall_ms = [], [], []
    for observation in observations:
        if wall_ms:
            sleep(max(0.0, period_s - 1e-3 * wall_ms[-1]))
        cpu_s, wall_s = process_time(), perf_counter()
        answers.append(module.track(observation))
        cpu_ms.append(1e3 * (process_time() - cpu_s))
        wall_ms.append(1e3 * (perf_counter() - wall_s))
    held = [answer for answer in answers if answer.status is not TrackingStatus.LOST]
    told = poses_of(held)
    revised, graph = module.get_trajectory(), module.get_map().pose_graph
    module.shutdown()
    return Run(
        answers=answers,
        told=told,
        revised=revised,
        keyframes=0 if graph is None else len(graph.stamps_ns),
        cpu_ms=cpu_ms,
        wall_ms=wall_ms,
        side_cpu_s=children_cpu_s() - side_cpu_s,
    )


def children_cpu_s() -> float:
    """Return the CPU time of the processes that have ended."""
    usage = getrusage(RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def row(name: str, run: Run, truth: Trajectory) -> str:
    """Return one line of the table."""
    told = absolute_errors(run.told, truth, GAP_S)
    revised = absolute_errors(run.revised, truth, GAP_S)
    cpu, wall = ([np.percentile(ms, q) for q in (50, 95)] for ms in (run.cpu_ms, run.wall_ms))
    return (
        f"| {name} | {1e3 * told.rmse_m:.1f} ({1e3 * told.max_m:.0f}) | {1e3 * revised.rmse_m:.1f}"
        f" | {len(run.answers) - len(run.told)} of {len(run.answers)} | {run.keyframes}"
        f" | {cpu[0]:.1f}, {cpu[1]:.1f} | {wall[0]:.1f}, {wall[1]:.1f}"
        f" | {(sum(run.cpu_ms) + 1e3 * run.side_cpu_s) / len(run.answers):.1f} |"
    )


def mirrored(truth: Trajectory, observations: list[Observation]) -> Trajectory:
    """Return the true poses of the observations backwards."""
    ends_ns = observations[0].stamp_ns + observations[-1].stamp_ns
    return Trajectory(
        stamps_ns=(ends_ns - truth.stamps_ns)[::-1].copy(),
        T_world_base=truth.T_world_base[::-1].copy(),
    )


def table(source: TumRgbd, truth: Trajectory) -> None:
    """Print the recording as it is, backwards, and with every second image."""
    print(HEAD + "\n" + "|---" * 8 + "|")
    print(row("as it is", follow(source.rig, iter(source)), truth), flush=True)
    peaks_mb = [getrusage(who).ru_maxrss / 1024 for who in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    observations = list(source)
    turned = follow(source.rig, backwards(observations))
    print(row("backwards", turned, mirrored(truth, observations)), flush=True)
    print(row("every second image", follow(source.rig, observations[::2]), truth), flush=True)
    print(row("as it is, at 30 Hz", follow(source.rig, observations, period_s=1 / 30), truth))
    shown = " + ".join(f"{mb:.0f}" for mb in peaks_mb)
    print(f"\npeak memory of the first and its side process, reading included: {shown} MB")


def sweep(source: TumRgbd, truth: Trajectory) -> None:
    """Print what seeds and feature counts change."""
    print(HEAD + "\n" + "|---" * 8 + "|")
    for changes in [{"seed": s} for s in range(3)] + [{"feature_count": c} for c in COUNTS]:
        name = ", ".join(f"{key} {value}" for key, value in changes.items())
        print(row(name, follow(source.rig, iter(source), **changes), truth), flush=True)


def thinned(source: TumRgbd, truth: Trajectory) -> None:
    """Print the recording with every second to fourth image, from several first ones."""
    print(HEAD + "\n" + "|---" * 8 + "|")
    observations = list(source)
    for first, step in ((1, 2), (0, 3), (1, 3), (2, 3), (0, 4)):
        run = follow(source.rig, observations[first::step])
        print(row(f"every {step}. image from {first}", run, truth), flush=True)


def profile(source: TumRgbd, truth: Trajectory) -> None:
    """Print the functions that take most time of their own, of all but the worker."""
    profiler = cProfile.Profile()
    observations = list(source)
    profiler.runcall(follow, source.rig, observations)
    pstats.Stats(profiler).sort_stats("tottime").print_stats(25)


def main() -> None:
    """Run the command in the first lines of this file."""
    cv2.setNumThreads(1)
    words = sys.argv[1:]
    modes = {"sweep": sweep, "thinned": thinned, "profile": profile}
    mode = modes.get(words[-1], table)
    source = recording([word for word in words if word not in modes])
    truth = source.ground_truth()
    if truth is None:
        raise SystemExit(f"no groundtruth.txt: {words[0]}")
    mode(source, truth.trajectory)


if __name__ == "__main__":
    main()
