"""Print whose error it is that the rgbd module's motions differ from the true ones.

    python experiments/rgbd_truth.py IMAGES [OVERRIDES]

The overrides choose a recording as for a run. Three witnesses of the same motions, between images
1 s apart: rgbd, the `depth` module, which registers surfaces and sees no colours, and the truth.
Where two of them agree and the third differs from both, the error is the third's.
"""

from __future__ import annotations

import sys
from itertools import combinations, islice

import cv2
import numpy as np
from numpy.typing import NDArray
from rgbd_loop import build, camera_only

from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

APART_NS = 1_000_000_000


def way(images: int, overrides: list[str], module_name: str) -> tuple[Trajectory, Trajectory]:
    """Return a module's way, as revised at the end, and the true one."""
    source, module, truth = build(overrides, module_name)
    answers = [module.track(camera_only(image)) for image in islice(source, images)]
    revised = module.get_trajectory()
    module.shutdown()
    if len(revised):
        return revised, truth
    stamps_ns = np.array([answer.stamp_ns for answer in answers])
    return Trajectory(
        stamps_ns=stamps_ns, T_world_base=np.stack([answer.T_local_base for answer in answers])
    ), truth


def motions(known: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return T_then_later (N, 4, 4) from each stamp on."""
    T_then, T_later = (
        interpolated(known, at_ns).T_world_base for at_ns in (stamps_ns, stamps_ns + APART_NS)
    )
    return np.asarray(se3.inverse(T_then) @ T_later)


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    images, overrides = int(sys.argv[1]), sys.argv[2:]
    rgbd, truth = way(images, overrides, "rgbd")
    depth, _ = way(images, overrides, "depth")
    known = {"rgbd": rgbd, "depth": depth, "truth": truth}
    stamps_ns = rgbd.stamps_ns[rgbd.stamps_ns + APART_NS <= rgbd.stamps_ns[-1]]
    moved = {name: motions(trajectory, stamps_ns) for name, trajectory in known.items()}
    print("| motions of 1 s | turned, median [mrad] | difference: median [mm] | [mrad] |")
    print("|---" * 4 + "|")
    for one, other in combinations(known, 2):
        T_error = se3.inverse(moved[one]) @ moved[other]
        gap_m = np.median(np.linalg.norm(T_error[:, :3, 3], axis=1))
        turned, turn = (np.median(se3.rotation_angle_rad(T)) for T in (moved[other], T_error))
        print(f"| {one}, {other} | {1e3 * turned:.0f} | {1e3 * gap_m:.1f} | {1e3 * turn:.1f} |")


if __name__ == "__main__":
    main()
