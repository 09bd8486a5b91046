"""Print whether the rgbd module's poses are as far off as their covariance says.

    python experiments/rgbd_nees.py IMAGES [OVERRIDES]

The overrides choose a recording as for a run; several seeds of a story are given as
`seed=0,1,2,3,4`. The covariance is that of a pose beside the map around it: the keyframes that
share landmarks with it are laid on their true poses, and the error of the pose is what is left.
NEES: normalised estimation error squared (Bar-Shalom, Li, Kirubarajan 2001, Sec. 5.4), 3 for
position and for rotation where a covariance is right. Camera alone; IMAGES from the beginning.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray
from rgbd_loop import build, camera_only

from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import interpolated
from sceneslam.modules.slam.rgbd.module import RgbdSlam
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

PARTS = {"position": slice(0, 3), "rotation": slice(3, 6)}
UNITS = {"position": "mm", "rotation": "mrad"}
BAND = (0.216, 9.348)  # 95 % of chi-squared with 3 degrees of freedom
AROUND, FEWEST = 12, 3  # keyframes that a pose is held against; where there are fewer it is not
LEVER_M = 1.0  # what a radian counts as where keyframes are laid on the truth


def true_pose(module: RgbdSlam, truth: Trajectory, stamp_ns: int) -> Transform | None:
    """Return where in `local` the truth has the camera, by the keyframes around it."""
    keyframes = module._parts.map.keyframes
    near = [keyframes[k] for k in keyframes.covisible(module._held_ids, limit=AROUND)]
    if len(near) < FEWEST:
        return None
    stamps_ns = np.array([stamp_ns, *(keyframe.stamp_ns for keyframe in near)])
    T_gt_base = interpolated(truth, stamps_ns).T_world_base
    T_local_keyframe = np.stack([keyframe.T_local_base for keyframe in near])
    T_local_gt = align(T_gt_base[1:], T_local_keyframe, lever_m=LEVER_M)
    return np.asarray(T_local_gt @ T_gt_base[0])


def run(images: int, overrides: list[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return errors (N, 6) and covariances (N, 6, 6) of the poses that are TRACKING."""
    source, module, truth = build(overrides)
    errors, covariances = [], []
    for image in islice(source, images):
        answer = module.track(camera_only(image))
        if answer.status is not TrackingStatus.TRACKING or answer.covariance is None:
            continue
        T_true = true_pose(module, truth, answer.stamp_ns)
        if T_true is not None:
            errors.append(se3.log(se3.inverse(answer.T_local_base) @ T_true))
            covariances.append(answer.covariance)
    module.shutdown()
    return np.array(errors), np.array(covariances)


def rows(name: str, errors: NDArray[np.float64], covariances: NDArray[np.float64]) -> list[str]:
    """Return a line of the table for position and one for rotation."""
    lines = []
    for part, axes in PARTS.items():
        error, covariance = errors[:, axes], covariances[:, axes, axes]
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
        sigma = 1e3 * np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        off = 1e3 * np.linalg.norm(error, axis=1)
        sure, unsure = (nees > BAND[1]).mean(), (nees < BAND[0]).mean()
        lines.append(
            f"| {name} | {part} | {len(nees)} | {np.median(sigma):.1f}, {np.median(off):.1f} "
            f"{UNITS[part]} | {nees.mean():.2f}, {np.median(nees):.2f} "
            f"| {100 * (1 - sure - unsure):.0f} % | {100 * sure:.0f} % | {100 * unsure:.0f} % |"
        )
    return lines


def seeds_of(overrides: Sequence[str]) -> list[str]:
    """Return the seeds of `seed=0,1,2`, or none."""
    return [s for word in overrides if word.startswith("seed=") for s in word[5:].split(",")]


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    images, words = int(sys.argv[1]), sys.argv[2:]
    print(
        "| run | of | poses | claimed, error: median | NEES: mean, median | in the 95 % band "
        "| too certain | too uncertain |\n" + "|---" * 8 + "|"
    )
    others = [word for word in words if not word.startswith("seed=")]
    found = []
    for seed in seeds_of(words) or [""]:
        found.append(run(images, [*others, f"seed={seed}"] if seed else others))
        print(*rows(f"seed {seed}" if seed else "-", *found[-1]), sep="\n", flush=True)
    if len(found) > 1:
        print(*rows("all", *map(np.concatenate, zip(*found, strict=True))), sep="\n")


if __name__ == "__main__":
    main()
