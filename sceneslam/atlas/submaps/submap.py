"""Submaps: a few metres of a session's path with the floor plan of their scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import FloorPlan, draw
from sceneslam.atlas.uncertainty import Covariance, Drift, motions
from sceneslam.scans.key_scan import KeyScan
from sceneslam.types import planar, se3
from sceneslam.types.covariance import grown
from sceneslam.types.planar import Planar
from sceneslam.types.se3 import Transform
from sceneslam.views.view import Landmarks, LandmarkView, PlacedView

LENGTH_M = 2.5  # length of path in a submap: by MAPPED it drifts 1 cm
TURN_RAD = 2 * np.pi  # or this much turning, after which everything around was seen
STEP_M, STEP_RAD = 0.1, 0.1  # between two scans of a submap
LEAST = np.repeat([0.003, 0.002], 3)  # m, rad: least standard deviations between two submaps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyPose:
    """A pose of the path with its scan, and the uncertainty of the motion to it."""

    stamp_ns: int
    scan: KeyScan | None  # None: no sensor saw walls, or it was tilted
    T_map_base: Transform  # as estimated when it was added
    session: int
    module: str
    drift: Drift  # of the motion from the one before
    reported: Covariance | None  # (6, 6) of T_local_base, as the module reported it
    up_base: NDArray[np.float64] | None = None  # (3,), the measured vertical direction, if known
    view: LandmarkView | None = None  # that the camera saw, of those to be kept
    landmarks: Landmarks | None = None  # the corners in it that are located from this pose
    # (6, 6) of the drift of the module's map
    of_map: Covariance = field(default_factory=lambda: np.zeros((6, 6)))


class Drawing:
    """A floor plan, drawn on first access, as most runs do not need it."""

    def __init__(
        self, plan: FloorPlan | None = None, scans: Sequence[tuple[Planar, KeyScan]] = ()
    ) -> None:
        self._plan, self._scans = plan, tuple(scans)
        self._lock = Lock()  # a live run saves, and draws, in another thread

    @property
    def plan(self) -> FloorPlan:
        """Return the plan; the scans are released once it is drawn."""
        with self._lock:
            if self._plan is None:
                self._plan, self._scans = draw(self._scans), ()
            return self._plan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Submap:
    """A node of the graph. Its frame is base at its first pose.

    What is planar is in that pose without its roll and pitch in the run, as `planar` places it.
    """

    run: int  # index of the run, by age, in a saved map
    session: int
    module: str
    stamps_ns: NDArray[np.int64]  # (K,) of its poses
    T_submap_base: NDArray[np.float64]  # (K, 3), planar
    drawing: Drawing  # of its plan
    views: tuple[PlacedView, ...] = ()
    up: NDArray[np.float64] | None = None  # (3,), the vertical direction, if it was measured

    @property
    def plan(self) -> FloorPlan:
        """Return the floor plan, in the submap's frame."""
        return self.drawing.plan


def make_submap(poses: Sequence[KeyPose], run: int, T_base_cam: Transform) -> Submap:
    """Return the submap of consecutive poses of one session, and what a camera saw there."""
    first = poses[0]
    on_plane = planar.from_transforms([pose.T_map_base for pose in poses])
    T_submap_base = [planar.between(on_plane[0], each) for each in on_plane]
    placed = zip(T_submap_base, (pose.scan for pose in poses), strict=True)
    return Submap(
        run=run,
        session=first.session,
        module=first.module,
        stamps_ns=np.array([pose.stamp_ns for pose in poses], np.int64),
        T_submap_base=np.array(T_submap_base),
        drawing=Drawing(scans=[(T, scan) for T, scan in placed if scan is not None]),
        views=tuple(
            PlacedView(
                stamp_ns=pose.stamp_ns,
                T_submap_cam=se3.inverse(first.T_map_base) @ pose.T_map_base @ T_base_cam,
                landmarks=pose.landmarks,
            )
            for pose in poses
            if pose.landmarks is not None
        ),
        up=first.up_base,
    )


@dataclass(slots=True, eq=False)
class OpenSubmap:
    """The poses of a submap that grows, of one session, up to LENGTH_M and TURN_RAD."""

    poses: list[KeyPose] = field(default_factory=list)
    _length_m: float = 0.0
    _turn_rad: float = 0.0

    def take(self, pose: KeyPose) -> bool:
        """Add a pose if it belongs to the submap; return whether it does."""
        if self.poses:
            if self.poses[-1].session != pose.session:
                return False
            length_m, turned_rad = _moved([self.poses[-1], pose])[0]
            self._length_m += length_m
            self._turn_rad += turned_rad
            if self._length_m > LENGTH_M or self._turn_rad > TURN_RAD:
                return False
        self.poses.append(pose)
        return True


def motion_covariance(poses: Sequence[KeyPose]) -> Covariance:
    """Return the covariance (6, 6), axes of the last, of the motion from the first to the last.

    Errors of one kind are systematic: standard deviations add up. The error of a map's rotation is
    random: variances add up.
    """
    along_m, turned = _moved(poses).T
    kinds = [pose.drift for pose in poses[1:]]
    per_m = np.array([kind.per_m for kind in kinds])
    rad_per_m = np.array([kind.rad_per_m for kind in kinds])
    rad_per_rad = np.array([kind.rad_per_rad for kind in kinds])
    rad_per_root = np.array([kind.rad_per_root for kind in kinds])
    turn = float(rad_per_m @ along_m + rad_per_rad @ turned)
    turn = float(np.hypot(turn, np.sqrt(rad_per_root**2 @ (along_m + turned))))
    lever_m = 0.5 * float(_moved([poses[0], poses[-1]])[0, 0])
    shift_m = float(np.hypot(per_m @ along_m, turn * lever_m))
    variances = np.repeat([shift_m**2, turn**2], 3) + LEAST**2
    return np.diag(variances) + _grown(poses)


def _grown(poses: Sequence[KeyPose]) -> Covariance:
    """Return the growth (6, 6) of a module's covariances over its poses, in axes of the last.

    Beyond the end of its session, it is what is known of the next one's map.
    """
    first, end = poses[0], poses[-1]
    last = [pose for pose in poses if pose.session == first.session][-1]
    T_last_first = se3.inverse(last.T_map_base) @ first.T_map_base
    growth = grown(first.of_map, last.of_map, T_last_first)
    if last is end and first.reported is not None and last.reported is not None:
        growth = growth + grown(first.reported, last.reported, T_last_first)
    carried = se3.carried(growth, se3.inverse(end.T_map_base) @ last.T_map_base)
    return carried if last is end else carried + end.of_map


def _moved(poses: Sequence[KeyPose]) -> NDArray[np.float64]:
    """Return the length and the angle (K - 1, 2) [m, rad] of the motions between K poses."""
    return motions(np.array([pose.T_map_base for pose in poses]))
