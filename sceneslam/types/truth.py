"""What is known to be true of a recording, for evaluation only."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

TRUTH_GAP_S = 0.5  # ground truth is not interpolated over more
_ENDS_NS = 50_000_000  # of the truth: its first and last pose hold so long before and after


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneChange:
    """From `stamp_ns` on, the scene is `scene`."""

    stamp_ns: int
    scene: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundTruth:
    """The true poses and scenes; either may be empty. Frame `gt` need not be `map`."""

    trajectory: Trajectory = field(default_factory=Trajectory.empty)  # T_gt_base
    scenes: tuple[SceneChange, ...] = ()  # by rising stamp; the first names the initial scene


def placed_by_pose(truth: Trajectory, stamp_ns: int, T_map_base: Transform) -> Transform | None:
    """Return T_map_gt (4, 4) [m] by one pose of the robot, None if its true pose is not known.

    The true pose is interpolated between poses at most `TRUTH_GAP_S` away on both sides.
    """
    stamps_ns = truth.stamps_ns
    if not len(stamps_ns):
        return None
    at_ns = np.clip(stamp_ns, stamps_ns[0], stamps_ns[-1])
    after = int(np.searchsorted(stamps_ns, at_ns))
    before = after if stamps_ns[after] == at_ns else after - 1
    since_ns, until_ns = at_ns - stamps_ns[before], stamps_ns[after] - at_ns
    if abs(at_ns - stamp_ns) > _ENDS_NS or max(since_ns, until_ns) > TRUTH_GAP_S * 1e9:
        return None
    ratio = float(since_ns / max(since_ns + until_ns, 1))
    T_gt_base = se3.interpolate(truth.T_world_base[before], truth.T_world_base[after], ratio)
    return T_map_base @ se3.inverse(T_gt_base)
