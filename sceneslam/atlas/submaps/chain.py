"""The submaps of a run in their order, and the motions from each to the next."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.graph import connected
from sceneslam.atlas.submaps.own_loops import Path
from sceneslam.atlas.submaps.path_drift import summed
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_GUESSED_M = 0.4  # as after half a second of unknown motion: nothing else errs by so much

# m^2, rad^2: a robot that was carried may be anywhere, but a piece that nothing joins has to stay.
_NOTHING = np.diag(np.repeat([100.0, 10.0], 3)) ** 2


@dataclass(slots=True, kw_only=True, eq=False)
class Chain:
    """Grows by one submap at a time; node i is submap i."""

    submaps: list[Submap] = field(default_factory=list)
    T_run_node: list[Transform] = field(default_factory=list)
    motions: list[Edge] = field(default_factory=list)
    drift: list[NDArray[np.float64]] = field(default_factory=list)  # (2, 3) each: `summed`
    T_base_cam: Transform = field(default_factory=se3.identity)  # of the camera that saw the views

    def __len__(self) -> int:
        return len(self.submaps)

    @property
    def is_upright(self) -> bool:
        """Tell whether the vertical direction was measured, anywhere."""
        return any(submap.up is not None for submap in self.submaps)

    @property
    def starts(self) -> list[int]:
        """Return the submaps with which a piece begins: nothing measured the motion to it."""
        seams = [motion for motion in self.motions if motion.kind is EdgeKind.HANDOVER]
        return [0, *(seam.second for seam in seams if is_guessed(seam.covariance))]

    @property
    def ties(self) -> list[Edge]:
        """Return the motions, of which those to where a piece begins hold nothing in its place."""
        seams = set(self.starts)
        return [
            replace(motion, covariance=_NOTHING) if motion.second in seams else motion
            for motion in self.motions
        ]

    def parts(self, loops: Sequence[Edge]) -> list[list[int]]:
        """Return the submaps of each part that motions or loops join, the largest part first."""
        seams = set(self.starts)
        known = [motion for motion in self.motions if motion.second not in seams]
        return sorted(connected(range(len(self)), [*known, *loops]), key=len, reverse=True)

    def append(self, submap: Submap, T_run_node: Transform, motion: Edge | None) -> None:
        """Add a submap with the motion to it, None for the first."""
        self.submaps.append(submap)
        self.T_run_node.append(T_run_node)
        if motion is None:
            self.drift.append(np.zeros((2, 3)))
            return
        self.motions.append(motion)
        self.drift.append(summed(self.drift[-1], motion))

    def cut(self, count: int) -> None:
        """Leave the first `count` submaps."""
        del self.submaps[count:], self.T_run_node[count:], self.drift[count:]
        del self.motions[max(count - 1, 0) :]

    def copy(self) -> Chain:
        """Return the chain as it is now."""
        return Chain(
            submaps=list(self.submaps),
            T_run_node=list(self.T_run_node),
            motions=list(self.motions),
            drift=list(self.drift),
            T_base_cam=self.T_base_cam,
        )

    def node_at(self, stamp_ns: int) -> int:
        """Return the index of the submap at a stamp, or of the last before it."""
        after = bisect_right(self.submaps, stamp_ns, key=lambda submap: int(submap.stamps_ns[0]))
        return max(after - 1, 0)

    def remeasure(self, path: Path) -> None:
        """Set the poses of the submaps and their views as revised, and the motions between them.

        Where `path` has no pose, as a hand-over took it back long after, they stay.
        """
        poses, submaps = [], []
        for submap, before in zip(self.submaps, self.T_run_node, strict=True):
            now = path(int(submap.stamps_ns[0]))
            pose = before if now is None else now
            views = [(view, path(view.stamp_ns)) for view in submap.views]
            moved = tuple(
                view
                if T is None
                else replace(view, T_submap_cam=se3.inverse(pose) @ T @ self.T_base_cam)
                for view, T in views
            )
            poses.append(pose)
            submaps.append(replace(submap, views=moved))
        self.submaps = submaps
        self.T_run_node = poses
        self.motions = [
            replace(edge, T_first_second=se3.inverse(poses[edge.first]) @ poses[edge.second])
            for edge in self.motions
        ]


def is_guessed(covariance: NDArray[np.float64]) -> bool:
    """Tell whether a motion with this covariance (6, 6) is hardly known.

    In more than one direction, as one may be open along a corridor.
    """
    return bool(np.linalg.eigvalsh(covariance[:3, :3])[1] > _GUESSED_M**2)
