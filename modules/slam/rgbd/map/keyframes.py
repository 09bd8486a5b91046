"""The keyframe store: poses, features, and covisibility of keyframes."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from ..see.features import Features
from ..see.shutter import Turning, straightened

NO_LANDMARK = -1
_SMALL = 1e-8  # [m^2] and [rad^2], so that a robot at rest has a finite information


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthView:
    """The part of a depth image that is kept for the map layers."""

    points_base: NDArray[np.float32]  # (M, 3) [m]
    colors_bgr: NDArray[np.uint8]  # (M, 3)
    pixels: int  # that were read, with valid depth or without
    scan: LaserScan | None  # None if the camera does not see the scan's band of heights


def nothing_seen() -> DepthView:
    """Return the empty view, for an observation without a depth image."""
    nothing = np.zeros((0, 3))
    points_base, colors_bgr = nothing.astype(np.float32), nothing.astype(np.uint8)
    return DepthView(points_base=points_base, colors_bgr=colors_bgr, pixels=0, scan=None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdometryPose:
    """A pose by odometry and gyro alone."""

    T_odom_base: Transform  # never corrected
    stretch: int  # number of the section of odometry without a gap
    variance: NDArray[np.float64]  # (2,) [m^2, rad^2]: distance and turn, summed up since the start

    def to(self, later: OdometryPose) -> OdometryMotion | None:
        """Return the motion to a later pose, None if odometry does not cover it."""
        if later.stretch != self.stretch:
            return None
        variance = np.abs(later.variance - self.variance) + _SMALL
        return OdometryMotion(
            T_here_there=se3.inverse(self.T_odom_base) @ later.T_odom_base, variance=variance
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdometryMotion:
    """A motion by odometry and gyro alone."""

    T_here_there: Transform
    variance: NDArray[np.float64]  # (2,) [m^2, rad^2]: distance and turn

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of se3.log order."""
        return np.diag(self.variance.repeat(3))


@dataclass(slots=True, kw_only=True, eq=False)
class Keyframe:
    """One image in the map. Pose and landmarks may be corrected later."""

    stamp_ns: int
    T_local_base: Transform
    features: Features
    landmark_ids: NDArray[np.int64]  # (N,), per feature, or NO_LANDMARK
    view: DepthView
    turning: Turning
    is_monocular: bool = False
    odometry: OdometryPose | None = None

    def straighten(self, camera: Camera, readout_s: float) -> None:
        """Correct the keyframe for a readout that is longer by `readout_s`."""
        self.features = straightened(camera, self.features, self.turning.rate_cam, readout_s)
        self.T_local_base = self.T_local_base @ se3.exp(readout_s * self.turning.twist_per_s)


def motion_between(one: Keyframe, other: Keyframe) -> OdometryMotion | None:
    """Return the motion from one keyframe to another by odometry, None if that is unknown."""
    if one.odometry is None or other.odometry is None:
        return None
    return one.odometry.to(other.odometry)


class KeyframeStore:
    """Keyframes ordered by id, with the landmarks that they share."""

    def __init__(self) -> None:
        self._keyframes: dict[int, Keyframe] = {}
        self._next_id = 0
        self._id_limit = 1  # above all landmark ids used so far

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, keyframe_id: int) -> Keyframe:
        return self._keyframes[keyframe_id]

    @property
    def ids(self) -> list[int]:
        """Return the ids, oldest keyframe first."""
        return list(self._keyframes)

    def all(self) -> Iterable[Keyframe]:
        """Return the keyframes, oldest first."""
        return self._keyframes.values()

    def insert(self, keyframe: Keyframe) -> int:
        """Store a keyframe and return its id."""
        keyframe_id, self._next_id = self._next_id, self._next_id + 1
        self._keyframes[keyframe_id] = keyframe
        self._id_limit = max(self._id_limit, int(keyframe.landmark_ids.max(initial=0)) + 1)
        return keyframe_id

    def show(
        self, keyframe_id: int, rows: NDArray[np.int64], landmark_ids: NDArray[np.int64]
    ) -> None:
        """Assign landmarks (N,) to features of a keyframe, by row (N,)."""
        self._keyframes[keyframe_id].landmark_ids[rows] = landmark_ids
        self._id_limit = max(self._id_limit, int(landmark_ids.max(initial=0)) + 1)

    def remove(self, keyframe_id: int) -> None:
        """Forget a keyframe."""
        del self._keyframes[keyframe_id]

    def covisible(self, landmark_ids: NDArray[np.int64], *, limit: int) -> list[int]:
        """Return up to `limit` keyframes that share most of the landmarks (N,), most first."""
        ids, shared = np.array(self.ids), self.shared(landmark_ids, self.ids)
        order = np.argsort(-shared, kind="stable")[:limit]
        return [int(keyframe_id) for keyframe_id in ids[order][shared[order] > 0]]

    def shared(
        self, landmark_ids: NDArray[np.int64], keyframe_ids: Iterable[int]
    ) -> NDArray[np.int64]:
        """Return (K,) how many of the landmarks (N,) each of the keyframes shows."""
        wanted = self._marked(landmark_ids)
        shows = [self._keyframes[keyframe_id].landmark_ids for keyframe_id in keyframe_ids]
        return np.array([np.count_nonzero(wanted[ids]) for ids in shows], np.int64)

    def landmarks_of(self, keyframe_ids: Iterable[int]) -> NDArray[np.int64]:
        """Return the ids (N,) of all landmarks in these keyframes, ascending."""
        seen = [self._keyframes[keyframe_id].landmark_ids for keyframe_id in keyframe_ids]
        marks = self._marked(np.concatenate([*seen, np.array([NO_LANDMARK])]))
        return np.flatnonzero(marks)

    def owned_landmarks(self) -> dict[int, NDArray[np.int64]]:
        """Return for every keyframe the ids (N,) of the landmarks that it saw first."""
        taken, owned = np.zeros(self._id_limit + 1, bool), {}
        taken[NO_LANDMARK] = True
        for keyframe_id, keyframe in self._keyframes.items():
            ids = keyframe.landmark_ids[~taken[keyframe.landmark_ids]]
            owned[keyframe_id], taken[ids] = ids, True
        return owned

    def forget_landmarks(self, landmark_ids: NDArray[np.int64]) -> None:
        """Remove the landmarks (N,) from all keyframes."""
        gone = self._marked(landmark_ids)
        for keyframe in self.all():
            keyframe.landmark_ids[gone[keyframe.landmark_ids]] = NO_LANDMARK

    def rename_landmarks(self, old_ids: NDArray[np.int64], new_ids: NDArray[np.int64]) -> None:
        """Replace landmarks `old_ids` (N,) by `new_ids` (N,) in all keyframes."""
        names = np.arange(NO_LANDMARK, self._id_limit)
        names[old_ids + 1] = new_ids
        for keyframe in self.all():
            keyframe.landmark_ids[:] = names[keyframe.landmark_ids + 1]

    def show_both(self, some: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return for pairs of landmarks (N,) whether any keyframe shows both."""
        both = np.zeros(len(some), bool)
        for keyframe in self.all():
            marks = self._marked(keyframe.landmark_ids)
            both |= marks[some] & marks[others]
        return both

    def nearest(
        self,
        T_local_base: Transform,
        *,
        per_m: float,
        per_rad: float,
        but_latest: int = 0,
        among: Collection[int] | None = None,
    ) -> float:
        """Return the distance of the nearest keyframe: weighted sum of metres and radians.

        Only keyframes `among` these (None: all) without the `but_latest` newest ones count;
        infinity if there are none.
        """
        ids = self.ids[: max(len(self) - but_latest, 0)]
        asked = [self._keyframes[k] for k in ids if among is None or k in among]
        if not asked:
            return float("inf")
        T_keyframes = np.stack([keyframe.T_local_base for keyframe in asked])
        T_keyframe_base = se3.inverse(T_keyframes) @ T_local_base
        distances_m = np.linalg.norm(T_keyframe_base[:, :3, 3], axis=1)
        return float(
            (per_m * distances_m + per_rad * se3.rotation_angle_rad(T_keyframe_base)).min()
        )

    def most_redundant(self) -> int:
        """Return the keyframe that is closest to another, except for the first and the latest."""
        ids = self.ids
        positions_m = np.stack([keyframe.T_local_base[:3, 3] for keyframe in self.all()])
        axes = np.stack([keyframe.T_local_base[:3, :3] for keyframe in self.all()])
        gaps_m = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
        turns = np.sqrt(np.maximum(3.0 - np.einsum("aij,bij->ab", axes, axes), 0.0))
        closeness = gaps_m + turns + 1e9 * np.eye(len(ids))
        return ids[1 + int(np.argmin(closeness.min(axis=1)[1:-1]))]

    def _marked(self, landmark_ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a table that is true at these ids; its last row answers for NO_LANDMARK."""
        marks = np.zeros(self._id_limit + 1, bool)
        marks[landmark_ids] = True
        marks[NO_LANDMARK] = False
        return marks
