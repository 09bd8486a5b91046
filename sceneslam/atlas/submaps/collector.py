"""Collect the poses and scans of a run, and group them into submaps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.chain import Chain, is_guessed
from sceneslam.atlas.submaps.submap import (
    STEP_M,
    STEP_RAD,
    KeyPose,
    OpenSubmap,
    make_submap,
    motion_covariance,
)
from sceneslam.atlas.uncertainty import MAPPED, VELOCITY, of_wheels
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.scans.key_scan import KeyScan
from sceneslam.types import se3
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import BRIDGED
from sceneslam.types.se3 import Transform
from sceneslam.views.view import Landmarks, LandmarkView

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
    # (6, 6) of the drift of its map
    of_map: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    begun_ns: int = 0  # first pose of the session


# Stamp, scan, the measured vertical direction (3,) in base, and a view to be kept.
_Step = tuple[int, KeyScan | None, NDArray[np.float64] | None, LandmarkView | None]
# The corners that are located in a step's view, if it has one, by its stamp and pose (4, 4).
Locate = Callable[[LandmarkView | None, int, Transform], Landmarks | None]


class Collector:
    """The submaps of one run so far, and the motions between them."""

    def __init__(
        self, rig: Rig, known: Callable[[int], Known | None], run: int, locate: Locate
    ) -> None:
        """Begin; `known` returns the current estimate of the pose at a stamp.

        Views are located once their poses are known, and again when others replace these.
        """
        self.chain = Chain() if rig.camera is None else Chain(T_base_cam=rig.camera.T_base_cam)
        self._known, self._run, self._locate = known, run, locate
        wheels = of_wheels(rig.wheels, has_gyro=Sensor.GYRO in rig.sensors)
        self._bridge = VELOCITY if rig.odometry is None else wheels
        self._open = OpenSubmap()
        self._recent: list[list[KeyPose]] = []  # of the newest submaps, oldest first
        self._waiting: list[_Step] = []  # for their poses
        self._last: Transform | None = None  # pose of the last step
        self._session: int | None = None  # of the last pose; -1: bridged, before the first
        self._up = np.zeros(3)  # of the base, the mean over the last steps
        self._level = self._count = 0

    @property
    def is_level(self) -> bool:
        """Tell whether the base moves on a floor."""
        return self._level >= _LEVEL_RATIO * self._count

    def has_begun(self, known: Known) -> bool:
        """Tell whether a piece of the run begins: nothing measured the motion to this pose.

        None does where bridged poses replaced a session: they belong to the one before it, whose
        piece goes on.
        """
        before, self._session = self._session, known.session
        if before is None or known.session <= before:
            return False
        first = self._known(known.begun_ns)
        return is_guessed((known if first is None else first).of_map)

    def has_moved(self, known: Known) -> bool:
        """Tell whether it is time for a step."""
        if self._last is None:
            return True
        step = se3.inverse(self._last) @ known.T_map_base
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
        view: LandmarkView | None = None,
    ) -> None:
        """Add a step with its scan; that completes the submap before, if it is long enough.

        `up_base` (3,) is the measured vertical direction, None if unknown; `view` is kept.
        """
        self._waiting.append((stamp_ns, scan, up_base, view))
        self._take()

    def rewind(self, stamp_ns: int) -> None:
        """Remove the submaps with poses from a stamp on; their steps wait for new poses.

        The first pose after a submap completed it: the submap is removed with that pose.
        """
        growing = self._open.poses
        if growing and growing[-1].stamp_ns < stamp_ns:
            return
        firsts_ns = [part[0].stamp_ns for part in [*self._recent, growing] if part]
        firsts_ns += [step[0] for step in self._waiting[:1]]
        kept = sum(ns < stamp_ns for ns in firsts_ns[1 : len(self._recent) + 1])
        if len(self._recent) < len(self.chain):
            kept = max(kept, 1)  # older ones stay as they are
        gone = [pose for part in [*self._recent[kept:], growing] for pose in part]
        steps = [(pose.stamp_ns, pose.scan, pose.up_base, pose.view) for pose in gone]
        self._waiting = [*steps, *self._waiting]
        self.chain.cut(len(self.chain) - (len(self._recent) - kept))
        del self._recent[kept:]
        self._open = OpenSubmap()

    def finish(self) -> None:
        """Complete the newest submap."""
        self._take()
        if self._open.poses:
            self._complete()

    def _take(self) -> None:
        """Add the waiting steps that have poses."""
        steps, self._waiting = self._waiting, []
        for step in steps:
            pose = self._posed(*step)
            if pose is not None and not self._open.take(pose):
                self._complete()
                self._open.take(pose)

    def _complete(self) -> None:
        """Make a submap of the open one."""
        part, self._open = self._open.poses, OpenSubmap()
        self._append(part)
        settled_ns = part[-1].stamp_ns - _SETTLED_NS
        while len(self._recent) > 1 and self._recent[1][-1].stamp_ns < settled_ns:
            del self._recent[0]
        self._recent.append(part)

    def _posed(
        self,
        stamp_ns: int,
        scan: KeyScan | None,
        up_base: NDArray[np.float64] | None,
        view: LandmarkView | None,
    ) -> KeyPose | None:
        known = self._known(stamp_ns)
        if known is None:
            return None
        T_map_base = known.T_map_base
        landmarks = self._locate(view, stamp_ns, T_map_base)
        return KeyPose(
            stamp_ns=stamp_ns,
            scan=scan,
            T_map_base=T_map_base,
            session=known.session,
            module=known.module,
            drift=self._bridge if known.module == BRIDGED else MAPPED,
            reported=known.covariance,
            of_map=known.of_map,
            up_base=up_base,
            view=view,
            landmarks=landmarks,
        )

    def _append(self, part: list[KeyPose]) -> None:
        chain, motion = self.chain, None
        if self._recent:
            before = self._recent[-1]
            motion = Edge(
                first=len(chain) - 1,
                second=len(chain),
                T_first_second=se3.inverse(before[0].T_map_base) @ part[0].T_map_base,
                covariance=motion_covariance([*before, part[0]]),
                kind=_kind(before, part[0]),
            )
        submap = make_submap(part, self._run, chain.T_base_cam)
        chain.append(submap, part[0].T_map_base, motion)


def _kind(part: list[KeyPose], pose: KeyPose) -> EdgeKind:
    """Return which source measured the motion from a submap to the pose after it."""
    if part[0].session != pose.session:
        return EdgeKind.HANDOVER
    bridged = sum(each.module == BRIDGED for each in [*part, pose])
    return EdgeKind.BRIDGE if 2 * bridged > len(part) else EdgeKind.MOTION
