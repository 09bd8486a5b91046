"""Collect the poses and scans of a run, and group them into submaps once the poses are final."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.own_loops import Path
from sceneslam.atlas.submaps.submap import (
    STEP_M,
    STEP_RAD,
    KeyPose,
    Submap,
    make_submap,
    motion_covariance,
    split,
)
from sceneslam.atlas.uncertainty import GYRO, MAPPED, VELOCITY, WHEELS
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.scans.key_scan import KeyScan
from sceneslam.types import planar, se3
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import BRIDGED
from sceneslam.types.se3 import Transform
from sceneslam.views.view import Landmarks

_SETTLED_NS = 20_000_000_000  # a hand-over does not replace older poses (policy.buffer_s)
_LEVEL_COS = np.cos(np.radians(3.0))  # at this tilt a wall 4 m away is seen 0.2 m higher or lower
_USUAL_STEPS = 50  # 5 m: over less, no module's tilt drifts by a degree
_SLOPE = 0.2  # m per m: steeper than any ramp on a floor
_LEVEL_RATIO = 0.5  # least share of level steps; less with a hand-held sensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """The pose of a run at a stamp."""

    T_map_base: Transform  # frame of the run
    session: int
    module: str  # BRIDGED if no module gave the pose
    covariance: NDArray[np.float64] | None  # (6, 6), as the module reported it


# Stamp, scan, the measured vertical direction (3,) in base, and landmarks.
_Step = tuple[int, KeyScan | None, NDArray[np.float64] | None, Landmarks | None]


class Collector:
    """The submaps of one run so far, and the motions between them."""

    def __init__(self, rig: Rig, known: Callable[[int], Known | None], run: int) -> None:
        """Begin; `known` returns the current estimate of the pose at a stamp."""
        self.submaps: list[Submap] = []
        self.T_run_node: list[Transform] = []
        self.motions: list[Edge] = []
        self.up_node: dict[int, NDArray[np.float64]] = {}  # vertical directions (3,), by submap
        self.drift = [np.zeros(3)]  # per submap: summed standard deviations [m, m, rad]
        self._known, self._run = known, run
        wheels = GYRO if Sensor.GYRO in rig.sensors else WHEELS
        self._bridge = wheels if Sensor.ODOMETRY in rig.sensors else VELOCITY
        self._steps: list[_Step] = []  # not yet in a submap
        self._part: list[KeyPose] = []  # of the newest submap
        self._last: Transform | None = None  # pose of the last step
        self._up = np.zeros(3)  # of the base, the mean over the last steps
        self._level = self._count = 0

    @property
    def is_level(self) -> bool:
        """Tell whether the base moves on a floor."""
        return self._level >= _LEVEL_RATIO * self._count

    def has_moved(self, T_run_base: Transform) -> bool:
        """Tell whether it is time for a step."""
        if self._last is None:
            return True
        step = se3.inverse(self._last) @ T_run_base
        is_far = np.linalg.norm(step[:3, 3]) >= STEP_M
        return bool(is_far or se3.rotation_angle_rad(step) >= STEP_RAD)

    def step_to(self, T_run_base: Transform) -> bool:
        """Record a step; return whether the new pose is level, as of a robot on a floor.

        Level is how the base stood on the mean of the last metres, as modules drift in tilt.
        """
        self._count += 1
        self._up += (T_run_base[:3, 2] - self._up) / min(self._count, _USUAL_STEPS)
        up = self._up / np.linalg.norm(self._up)
        is_level = bool(T_run_base[:3, 2] @ up >= _LEVEL_COS)
        if self._last is not None:
            step_m = T_run_base[:3, 3] - self._last[:3, 3]
            climbed_m = float(step_m @ up)
            ahead_m = float(np.linalg.norm(step_m - climbed_m * up))
            is_level &= abs(climbed_m) <= _SLOPE * max(ahead_m, STEP_M)
        self._last = T_run_base
        self._level += is_level
        return is_level

    def add(
        self,
        stamp_ns: int,
        scan: KeyScan | None,
        up_base: NDArray[np.float64] | None = None,
        landmarks: Landmarks | None = None,
    ) -> None:
        """Add a step with its scan, and make submaps of steps with final poses.

        `up_base` (3,) is the measured vertical direction, None if unknown, as are the `landmarks`
        in view.
        """
        self._steps.append((stamp_ns, scan, up_base, landmarks))
        settled = bisect_right(self._steps, stamp_ns - _SETTLED_NS, key=lambda each: each[0])
        if 2 * settled > len(self._steps):
            self._cut(settled, is_end=False)

    def finish(self) -> None:
        """Make submaps of the remaining steps."""
        self._cut(len(self._steps), is_end=True)

    def remeasure(self, path: Path) -> None:
        """Set the poses of the submaps and their views as revised, and the motions between them.

        `path` has a pose at every stamp of a step.
        """
        poses = [_at(path, int(submap.stamps_ns[0])) for submap in self.submaps]
        self.submaps = [
            replace(
                submap,
                views=tuple(
                    replace(view, T_submap_base=se3.inverse(pose) @ _at(path, view.stamp_ns))
                    for view in submap.views
                ),
            )
            for submap, pose in zip(self.submaps, poses, strict=True)
        ]
        self.T_run_node = poses
        self.motions = [
            replace(edge, T_first_second=se3.inverse(poses[edge.first]) @ poses[edge.second])
            for edge in self.motions
        ]

    def node_at(self, stamp_ns: int) -> int:
        """Return the index of the submap at a stamp, or of the last before it."""
        starts = [int(submap.stamps_ns[0]) for submap in self.submaps]
        return max(bisect_right(starts, stamp_ns) - 1, 0)

    def _cut(self, count: int, *, is_end: bool) -> None:
        """Make submaps of the oldest steps; the last may still grow, unless `is_end`."""
        poses = [pose for step in self._steps[:count] if (pose := self._posed(*step)) is not None]
        parts = split(poses)
        for part in parts if is_end else parts[:-1]:
            self._append(part)
        done_ns = -1 if not self._part else self._part[-1].stamp_ns
        self._steps = [step for step in self._steps if step[0] > done_ns]

    def _posed(
        self,
        stamp_ns: int,
        scan: KeyScan | None,
        up_base: NDArray[np.float64] | None,
        landmarks: Landmarks | None,
    ) -> KeyPose | None:
        known = self._known(stamp_ns)
        if known is None:
            return None
        return KeyPose(
            stamp_ns=stamp_ns,
            scan=scan,
            T_map_base=known.T_map_base,
            session=known.session,
            module=known.module,
            drift=self._bridge if known.module == BRIDGED else MAPPED,
            reported=known.covariance,
            up_base=up_base,
            landmarks=landmarks,
        )

    def _append(self, part: list[KeyPose]) -> None:
        if self._part:
            covariance = motion_covariance([*self._part, part[0]])
            self.motions.append(
                Edge(
                    first=len(self.submaps) - 1,
                    second=len(self.submaps),
                    T_first_second=se3.inverse(self._part[0].T_map_base) @ part[0].T_map_base,
                    covariance=covariance,
                    kind=self._kind(part[0]),
                )
            )
            deviations = np.sqrt(np.diag(planar.planar_covariance(covariance)))
            self.drift.append(self.drift[-1] + deviations)
        if part[0].up_base is not None:
            self.up_node[len(self.submaps)] = part[0].up_base
        self.submaps.append(make_submap(part, self._run))
        self.T_run_node.append(part[0].T_map_base)
        self._part = part

    def _kind(self, pose: KeyPose) -> EdgeKind:
        """Return which source measured the motion from the newest submap to a pose."""
        if self._part[0].session != pose.session:
            return EdgeKind.HANDOVER
        bridged = sum(each.module == BRIDGED for each in [*self._part, pose])
        return EdgeKind.BRIDGE if 2 * bridged > len(self._part) else EdgeKind.MOTION


def _at(path: Path, stamp_ns: int) -> Transform:
    pose = path(stamp_ns)
    assert pose is not None, "a step has a pose"
    return pose
