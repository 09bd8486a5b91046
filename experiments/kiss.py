"""Print how the `kiss_icp` adapter does on a KITTI drive, and what it adds to the library's cost.

    python experiments/kiss.py ../shared/data/kitti_raw_2011_09_26_drive_0001

Times are CPU time of one core. The library's share is what is spent inside its voxelisation,
registration and map update; the rest is the adapter's. `--profile` prints where that goes.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from kiss_icp.kiss_icp import KissICP
from kiss_icp.mapping import VoxelHashMap
from kiss_icp.registration import Registration

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.experiments.scripts import settings
from sceneslam.modules.slam.kiss_icp import KissIcp
from sceneslam.sources.kitti import Kitti
from sceneslam.types.trajectory import Trajectory

LIBRARY = (
    (KissICP, "voxelize"),
    (Registration, "align_points_to_map"),
    (VoxelHashMap, "update"),
)


def timed(function: Callable[..., Any], spent_s: list[float]) -> Callable[..., Any]:
    """Return the function, adding its CPU time to the list."""

    def call(*args: Any, **kwargs: Any) -> Any:
        start_s = time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            spent_s.append(time.process_time() - start_s)

    return call


def main() -> None:
    """Print one table, or a profile."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--profile", action="store_true")
    arguments = parser.parse_args()
    source = Kitti(**{**settings("source/kitti.yaml"), "path": arguments.folder})
    observations = list(source)
    module = KissIcp(**settings("slam/kiss_icp.yaml"))
    module.activate(source.rig)
    if arguments.profile:
        with cProfile.Profile() as profile:
            for observation in observations:
                module.track(observation)
        pstats.Stats(profile).sort_stats("tottime").print_stats(15)
        return
    library_s: list[float] = []
    for owner, name in LIBRARY:
        setattr(owner, name, timed(getattr(owner, name), library_s))
    start_s = time.process_time()
    told = [module.track(observation) for observation in observations]
    total_s = time.process_time() - start_s
    estimate = Trajectory(
        stamps_ns=np.array([one.stamp_ns for one in told]),
        T_world_base=np.array([one.T_local_base for one in told]),
    )
    truth = source.ground_truth()
    assert truth is not None
    found = absolute_errors(estimate, truth.trajectory, 0.05)
    statuses = Counter(one.status.value for one in told)
    print("| scans | ATE [m] | max [m] | library [ms/scan] | adapter [ms/scan] | ratio | status |")
    print("|---|---|---|---|---|---|---|")
    library_ms = 1e3 * sum(library_s) / len(told)
    adapter_ms = 1e3 * total_s / len(told) - library_ms
    print(
        f"| {len(told)} | {found.rmse_m:.3f} | {found.max_m:.3f} | {library_ms:.1f} "
        f"| {adapter_ms:.1f} | {adapter_ms / library_ms:.1%} | {dict(statuses)} |"
    )


if __name__ == "__main__":
    main()
