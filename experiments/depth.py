"""Print how the depth module does on recordings, by depth alone: the images are not shown to it.

    python experiments/depth.py ../shared/data/tum_fr1_rpy ../shared/data/7scenes_redkitchen

Each recording is played as it is, backwards, and with every second (third) frame only. `--profile`
prints where the time goes instead. Times are CPU time of one core, reading left out.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.experiments.scripts import backwards, settings
from sceneslam.modules.slam.depth.module import DepthSlam
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types.observation import Observation
from sceneslam.types.trajectory import Trajectory

KINECT_7SCENES = {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0}
COLUMNS = (
    "recording, frames",
    "ATE [m]",
    "online [m]",
    "max [m]",
    "ms median (95 %)",
    "keyframes",
    "status",
)


@dataclass(frozen=True)
class Play:
    """How a recording is played."""

    name: str
    step: int = 1
    is_reversed: bool = False


PLAYS = (
    Play("all"),
    Play("backwards", is_reversed=True),
    Play("every 2nd", 2),
    Play("every 3rd", 3),
)


def open_source(folder: Path) -> TumRgbd:
    """Return the recording; 7-Scenes does not say its camera in the folder's name."""
    is_7scenes = folder.name.startswith("7scenes")
    camera = KINECT_7SCENES if is_7scenes else {}
    return TumRgbd(str(folder), camera, 1000.0 if is_7scenes else 5000.0, [0.3, 8.0], 0.02)


def arranged(observations: Sequence[Observation], play: Play) -> list[Observation]:
    """Return the depth images alone, in the order and at the rate of the play."""
    chosen = observations[:: play.step]
    dark = [replace(one, image_bgr=None) for one in chosen]
    return backwards(dark) if play.is_reversed else dark


def errors(poses: Trajectory, truth: Trajectory, play: Play) -> tuple[float, float]:
    """Return RMSE and largest error [m] after alignment."""
    stamps_ns = poses.stamps_ns
    T_local_base = poses.T_world_base
    if play.is_reversed:
        stamps_ns = (stamps_ns[0] + stamps_ns[-1] - stamps_ns)[::-1]
        T_local_base = T_local_base[::-1]
    found = absolute_errors(Trajectory(stamps_ns=stamps_ns, T_world_base=T_local_base), truth, 0.02)
    return found.rmse_m, found.max_m


def row(folder: Path, source: TumRgbd, observations: Sequence[Observation], play: Play) -> str:
    """Return one line of the table."""
    module = DepthSlam(**settings("slam/depth.yaml"))
    module.activate(source.rig)
    told, spent_ms = [], []
    for observation in arranged(observations, play):
        start_s = time.process_time()
        told.append(module.track(observation))
        spent_ms.append(1e3 * (time.process_time() - start_s))
    online = Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in told]),
        T_world_base=np.array([one.T_local_base for one in told]),
    )
    truth = source.ground_truth()
    assert truth is not None
    revised_m, worst_m = errors(module.get_trajectory(), truth.trajectory, play)
    online_m, _ = errors(online, truth.trajectory, play)
    statuses = Counter(one.status.value for one in told)
    return (
        f"| {folder.name}, {play.name} | {revised_m:.4f} | {online_m:.4f} | {worst_m:.3f} "
        f"| {np.median(spent_ms):.1f} ({np.quantile(spent_ms, 0.95):.1f}) "
        f"| {module.keyframe_count} | {', '.join(f'{v} {k}' for k, v in statuses.items())} |"
    )


def main() -> None:
    """Print the table, or a profile of the first recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--profile", action="store_true")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if not arguments.profile:
        print("| " + " | ".join(COLUMNS) + " |")
        print("|---" * len(COLUMNS) + "|")
    for folder in arguments.folders:
        source = open_source(folder)
        observations = list(source)
        if arguments.profile:
            with cProfile.Profile() as profile:
                row(folder, source, observations, PLAYS[0])
            pstats.Stats(profile).sort_stats("tottime").print_stats(15)
            return
        for play in PLAYS:
            print(row(folder, source, observations, play), flush=True)


if __name__ == "__main__":
    main()
