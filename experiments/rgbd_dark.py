"""Print what the rgbd module tells where the light of a simulated story really ends.

    python experiments/rgbd_dark.py [OVERRIDES]

The overrides choose a story as for a run; several seeds are given as `seed=0,1,2`. Images are told
apart by their median grey value: the door, the dark beyond it, and the light where it comes back.
No odometry, no gyro. Errors are of the motion since the last image at least as bright as LIT.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass, field

import cv2
import numpy as np
from rgbd_loop import build, camera_only
from rgbd_nees import seeds_of

from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.se3 import Transform

LIT = 40  # grey values
EDGES = (LIT, 20, 10, 5, 0)


@dataclass(slots=True)
class Told:
    """What was told of images of one brightness."""

    statuses: list[TrackingStatus] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)  # of poses that are TRACKING
    guesses_m: list[tuple[float, float]] = field(default_factory=list)  # DEGRADED: error, claimed

    def row(self, name: str) -> str:
        """Return a line of the table."""
        counts = ", ".join(str(self.statuses.count(status)) for status in TrackingStatus)
        tracking = f"{max(self.errors_m):.3f}" if self.errors_m else "-"
        degraded = "{:.3f}, {:.3f}".format(*max(self.guesses_m)) if self.guesses_m else "-"
        return f"| {name} | {len(self.statuses)} | {counts} | {tracking} | {degraded} |"


def run(overrides: list[str], told: dict[int, Told]) -> None:
    """Add what is told along a story."""
    source, module, truth = build(overrides)
    T_local_gt: Transform | None = None  # by the last lit image
    for image in map(camera_only, source):
        answer = module.track(image)
        grey = np.median(image.image_bgr) if image.image_bgr is not None else 0.0
        T_gt_base = interpolated(truth, np.array([answer.stamp_ns])).T_world_base[0]
        here = told[next(edge for edge in EDGES if grey >= edge)]
        here.statuses.append(answer.status)
        if answer.status is TrackingStatus.LOST:
            continue
        if T_local_gt is not None:
            T_true = T_local_gt @ T_gt_base
            error_m = float(np.linalg.norm(answer.T_local_base[:3, 3] - T_true[:3, 3]))
            if answer.status is TrackingStatus.TRACKING:
                here.errors_m.append(error_m)
            else:
                here.guesses_m.append((error_m, sigma_m(answer)))
        if grey >= LIT:
            T_local_gt = answer.T_local_base @ se3.inverse(T_gt_base)
    module.shutdown()


def sigma_m(answer: Tracking) -> float:
    """Return how unsure a position is said to be [m], NaN where that is not said."""
    covariance = answer.covariance
    return float("nan") if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3])))


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    words = sys.argv[1:]
    others = [word for word in words if not word.startswith("seed=")]
    told: dict[int, Told] = defaultdict(Told)
    for seed in seeds_of(words) or ["0"]:
        run([*others, f"seed={seed}"], told)
    statuses = ", ".join(status.name for status in TrackingStatus)
    print(
        f"| median grey | images | {statuses} | worst error, TRACKING [m] | DEGRADED, claimed [m] |"
    )
    print("|---" * 5 + "|")
    for edge in EDGES:
        if edge in told:
            print(told[edge].row(f"{edge} and more"))


if __name__ == "__main__":
    main()
