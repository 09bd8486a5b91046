"""Print how the rgbd module bridges a stretch without depth, on what it knows of the scene's size.

    python experiments/rgbd_mono.py [OVERRIDES]

The overrides choose a recording as for a run. Depth is taken away for 1, 3 and 10 s, from the
middle on outwards, and all along but the first second. One line of a Markdown table each. The
scale is that of the way within the gap against the true one, after a similarity alignment; the
deviation claimed is the largest from the gap's beginning on.
"""

from __future__ import annotations

import sys

import numpy as np
from rgbd_loop import MAX_GAP_S, build, camera_only, follow, poses_of

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.association import interpolated
from sceneslam.sources.changes.failing_sensor import FailingSensor
from sceneslam.types import se3
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.trajectory import Trajectory

LENGTHS_S = (0.0, 1.0, 3.0, 10.0, float("inf"))
MAPPED_S = 1.0  # with depth, before a gap that never ends


def gap_of(length_s: float, duration_s: float) -> list[float]:
    """Return the gap [from, to] in seconds."""
    if not np.isfinite(length_s):
        return [MAPPED_S, duration_s + 1.0]
    since_s = max(MAPPED_S, 0.5 * (duration_s - length_s))
    return [since_s, since_s + max(length_s, 1e-9)]


def scale_of(told: Trajectory, truth: Trajectory) -> float:
    """Return by how much the way told is longer than the true one (Umeyama 1991)."""
    true_m = interpolated(truth, told.stamps_ns).positions_m
    told_m = told.positions_m - told.positions_m.mean(axis=0)
    true_m = true_m - true_m.mean(axis=0)
    singular = np.linalg.svd(true_m.T @ told_m, compute_uv=False)
    return float((told_m**2).sum() / singular.sum())


def honesty(held: list[Tracking], truth: Trajectory, gap_from_s: float) -> tuple[float, float]:
    """Return the largest deviation claimed of a position after a time, and its error [mm].

    The error is that of the motion since the gap began.
    """
    after = [answer for answer in held if answer.stamp_ns * 1e-9 >= gap_from_s]
    variances = [0.0 if a.covariance is None else np.trace(a.covariance[:3, :3]) for a in after]
    worst = int(np.argmax(variances))
    T_told = se3.inverse(after[0].T_local_base) @ after[worst].T_local_base
    T_gt_base = interpolated(truth, np.array([a.stamp_ns for a in (after[0], after[worst])]))
    T_true = se3.inverse(T_gt_base.T_world_base[0]) @ T_gt_base.T_world_base[1]
    off_m = float(np.linalg.norm(T_told[:3, 3] - T_true[:3, 3]))
    return 1e3 * float(np.sqrt(variances[worst])), 1e3 * off_m


def bridge(overrides: list[str], length_s: float) -> str:
    """Return one line: a run with one gap."""
    source, module, truth = build(overrides)
    stamps_ns = [observation.stamp_ns for observation in source]
    gap_s = gap_of(length_s, (stamps_ns[-1] - stamps_ns[0]) * 1e-9)
    blind = FailingSensor(
        source, "depth_blinded", [gap_s], names_scene=False, otherwise="Bright", seed=0
    )
    answers, cost = follow(module, (camera_only(observation) for observation in blind))
    revised = module.get_trajectory()
    module.shutdown()
    held = [answer for answer in answers if answer.status is not TrackingStatus.LOST]
    told = poses_of(held)
    times_s = (told.stamps_ns - stamps_ns[0]) * 1e-9
    inside = (times_s >= gap_s[0]) & (times_s < gap_s[1])
    within = Trajectory(stamps_ns=told.stamps_ns[inside], T_world_base=told.T_world_base[inside])
    degraded = sum(answer.status is TrackingStatus.DEGRADED for answer in answers)
    scale = f"{scale_of(within, truth):.3f}" if inside.sum() > 10 else "-"
    errors = absolute_errors(told, truth, MAX_GAP_S)
    claimed_mm, off_mm = honesty(held, truth, gap_s[0] + stamps_ns[0] * 1e-9)
    return (
        f"| {gap_s[0]:.1f} to {min(gap_s[1], times_s[-1]):.1f} s | {len(answers) - len(held)} "
        f"| {degraded} | {1e3 * errors.rmse_m:.1f} ({1e3 * errors.max_m:.0f}) "
        f"| {1e3 * absolute_errors(revised, truth, MAX_GAP_S).rmse_m:.1f} | {scale} "
        f"| {claimed_mm:.0f}, {off_mm:.0f} | {cost['median [ms]']}, {cost['p95 [ms]']} |"
    )


def main() -> None:
    """Print the table."""
    head = "gap | lost | degraded | ATE online (max) [mm] | revised [mm] | scale in it "
    head += "| sigma claimed (most), error then [mm] | CPU ms"
    print(f"| {head} |\n" + "|---" * 8 + "|")
    for length_s in LENGTHS_S:
        print(bridge(sys.argv[1:], length_s), flush=True)


if __name__ == "__main__":
    main()
