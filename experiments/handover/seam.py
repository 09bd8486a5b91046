"""The seam between two modules: what the trajectory lost across a hand-over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.experiment import TrialResult
from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Seam:
    """One hand-over and its errors."""

    kind: str
    startup_s: float
    lost_s: float
    error_m: float  # of the motion from where the scene changed to the new module's live poses
    drift_m: float  # what the new module's own motion, as far as it covers that, is off by
    online_m: float  # the error of the motion as it was reported online
    gap_s: float  # the longest time without a pose, beyond the usual period

    @property
    def beyond_m(self) -> float:
        """Return what the hand-over itself lost [m]."""
        return max(0.0, self.error_m - self.drift_m)


def measure(
    outcome: TrialResult,
    kind: str,
    startup_s: float,
    lost_s: float,
    *,
    since_s: float,
    after_s: float,
) -> Seam:
    """Return the seam of a run with one hand-over.

    The motion is taken from `since_s` after the first pose, where the scene changed, to `after_s`
    after the hand-over.
    """
    truth = Trajectory.read_tum(outcome.folder / "groundtruth.tum")
    own = Trajectory.read_tum(outcome.folder / "trajectory_1_dark.tum")
    (switch,) = outcome.metrics["switches"]
    from_ns = int(outcome.trajectory.stamps_ns[0]) + round(since_s * 1e9)
    until_ns = switch["stamp_ns"] + round(after_s * 1e9)
    return Seam(
        kind=kind,
        startup_s=startup_s,
        lost_s=lost_s,
        error_m=_error_m(outcome.trajectory, truth, from_ns, until_ns),
        drift_m=_error_m(own, truth, max(from_ns, int(own.stamps_ns[0])), until_ns),
        online_m=_error_m(outcome.online, truth, from_ns, until_ns),
        gap_s=_gap_s(outcome.trajectory),
    )


def _error_m(estimate: Trajectory, truth: Trajectory, from_ns: int, until_ns: int) -> float:
    """Return how far the estimated motion between two instants is off [m]."""
    stamps_ns = estimate.stamps_ns
    first = int(np.searchsorted(stamps_ns, from_ns, side="right")) - 1
    last = int(np.searchsorted(stamps_ns, until_ns, side="right")) - 1
    ends = [max(first, 0), last]
    T_map_first, T_map_last = estimate.T_world_base[ends]
    T_gt_first, T_gt_last = interpolated(truth, stamps_ns[ends]).T_world_base
    T_true = se3.inverse(T_gt_first) @ T_gt_last
    T_error = se3.inverse(T_true) @ se3.inverse(T_map_first) @ T_map_last
    return float(np.linalg.norm(T_error[:3, 3]))


def _gap_s(trajectory: Trajectory) -> float:
    """Return the longest step beyond the usual one [s]; half a period is no gap."""
    steps_ns = np.diff(trajectory.stamps_ns)
    period_ns, longest_ns = float(np.median(steps_ns)), float(steps_ns.max())
    return (longest_ns - period_ns) * 1e-9 if longest_ns > 1.5 * period_ns else 0.0
