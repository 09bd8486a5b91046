"""The poses of a run as they arrive: the robot's trajectory, and that of each session."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.collector import Known
from sceneslam.atlas.uncertainty import Covariance
from sceneslam.types import se3
from sceneslam.types.covariance import TRIANGLE, semidefinite, symmetric, triangle
from sceneslam.types.maps import MapLayers
from sceneslam.types.rows import Rows
from sceneslam.types.run import BRIDGED, SessionStart
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_NONE = np.full(TRIANGLE, np.nan)  # no covariance was reported
_UNKNOWN = 1e10  # m^2, rad^2, of a robot that may be anywhere; float64 adds 1e-6 to no more


@dataclass(slots=True)
class OpenSession:
    """A session that receives poses."""

    module: str
    T_map_local: Transform
    T_new_told: Transform = field(default_factory=se3.identity)  # of the pose before, at its start
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    poses: Rows = field(default_factory=lambda: Rows(4, 4))  # T_local_base
    layers: MapLayers = field(default_factory=MapLayers)
    revised: Trajectory = field(default_factory=Trajectory.empty)  # T_local_base

    @property
    def online(self) -> Trajectory:
        """Return its poses as reported."""
        return trajectory_of(self.stamps_ns, self.poses)


@dataclass(slots=True)
class PoseLog:
    """Poses by rising stamp, as they were reported."""

    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    poses: Rows = field(default_factory=lambda: Rows(4, 4))

    def add(self, stamp_ns: int, T_map_base: Transform) -> None:
        """Add T_map_base (4, 4) [m]."""
        self.stamps_ns.append(stamp_ns)
        self.poses.append(T_map_base)


@dataclass(slots=True)
class PosePath:
    """Poses ordered by stamp, with who gave them; they may be cut and replaced."""

    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    poses: Rows = field(default_factory=lambda: Rows(4, 4))  # T_map_base
    modules: list[str] = field(default_factory=list)
    begun: array[int] = field(default_factory=lambda: array("q"))  # the newest session then
    sessions: array[int] = field(
        default_factory=lambda: array("q")
    )  # its session, -1 before the first; bridged: the one before, until the new one answers
    # T_new_told of the pose before a row, where this row and those after it replaced others.
    moved: dict[int, Transform] = field(default_factory=dict)
    # Upper triangles as reported, of the poses in the modules' maps, and of these; NaN: none.
    _covariances: Rows = field(default_factory=lambda: Rows(len(_NONE)))
    _maps: Rows = field(default_factory=lambda: Rows(len(_NONE)))

    def add(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        session: int,
        covariance: Covariance | None,
        map_covariance: Covariance | None,
    ) -> None:
        """Add T_map_base (4, 4) [m] unless its stamp already has a pose.

        `covariance`, `map_covariance` (6, 6): as `Tracking` has them, None: not reported. A pose
        without the latter takes over that of the session's pose before it.
        """
        if self.stamps_ns and stamp_ns <= self.stamps_ns[-1]:
            return
        begun = session
        if module == BRIDGED and (not self.sessions or session != self.sessions[-1]):
            session = self.sessions[-1] if self.sessions else -1  # it begins with its first answer
        if map_covariance is None and len(self.poses) and session == self.sessions[-1]:
            before = symmetric(self._maps[-1])
            if not np.isnan(before[0, 0]):
                map_covariance = se3.carried(before, se3.inverse(T_map_base) @ self.poses[-1])
        for rows, given in ((self._covariances, covariance), (self._maps, map_covariance)):
            reported = _NONE if given is None else triangle(given)
            rows.append(np.clip(reported, -_UNKNOWN, _UNKNOWN))
        self.stamps_ns.append(stamp_ns)
        self.poses.append(T_map_base)
        self.modules.append(module)
        self.begun.append(begun)
        self.sessions.append(session)

    def cut(self, stamp_ns: int, T_new_told: Transform | None = None) -> None:
        """Remove the poses from an instant on; T_new_told (4, 4): of the last one left."""
        keep = bisect_left(self.stamps_ns, stamp_ns)
        for values in (self.stamps_ns, self.modules, self.begun, self.sessions):
            del values[keep:]
        for rows in (self.poses, self._covariances, self._maps):
            rows.cut(keep)
        self.moved = {row: one for row, one in self.moved.items() if row < keep}
        if T_new_told is not None:
            self.moved[keep] = T_new_told

    def covariance_at(self, row: int) -> Covariance | None:
        """Return the covariance (6, 6) that was reported with a pose, None without one."""
        covariance = symmetric(self._covariances[row])
        return None if np.isnan(covariance[0, 0]) else covariance

    def row_at(self, stamp_ns: int) -> int | None:
        """Return the index of the pose at a stamp, None without one."""
        row = bisect_left(self.stamps_ns, stamp_ns)
        return row if row < len(self.stamps_ns) and self.stamps_ns[row] == stamp_ns else None

    def known_at(self, stamp_ns: int) -> Known | None:
        """Return the pose at a stamp with its module and covariance, None without one."""
        row = self.row_at(stamp_ns)
        if row is None:
            return None
        return Known(
            T_map_base=self.poses[row],
            session=self.sessions[row],
            module=self.modules[row],
            covariance=self.covariance_at(row),
            of_map=np.nan_to_num(symmetric(self._maps[row])),
            begun_ns=self.stamps_ns[bisect_left(self.sessions, self.sessions[row])],
        )

    def session_starts(self) -> list[SessionStart]:
        """Return, per session, the first pose that its module gave."""
        starts: dict[int, SessionStart] = {}
        poses = zip(self.sessions, self.modules, self.stamps_ns, strict=True)
        for row, (session, module, stamp_ns) in enumerate(poses):
            if module != BRIDGED and session not in starts:
                starts[session] = SessionStart(
                    row=row, session=session, module=module, stamp_ns=stamp_ns
                )
        return list(starts.values())

    def reported(self, revised: Sequence[Trajectory]) -> NDArray[np.float64]:
        """Return the covariances (N, 6, 6) in the modules' maps, as `_semidefinite` has them.

        Of a pose that its module revised (`revised` is by session) it is what came with that.
        """
        triangles = np.asarray(self._covariances)
        stamps_ns, sessions = np.array(self.stamps_ns, np.int64), np.array(self.sessions, np.int64)
        for session, one in enumerate(revised):
            if one.covariances is None:
                continue
            own = np.flatnonzero(sessions == session)
            known = ~np.isnan(one.covariances[:, 0, 0])
            _, rows, given = np.intersect1d(
                stamps_ns[own], one.stamps_ns[known], return_indices=True
            )
            covariances = triangle(one.covariances[known][given])
            triangles[own[rows]] = np.clip(covariances, -_UNKNOWN, _UNKNOWN)
        return _semidefinite(triangles)

    def of_maps(self) -> NDArray[np.float64]:
        """Return the covariances (N, 6, 6) of the modules' maps, as `_semidefinite` has them."""
        return _semidefinite(np.asarray(self._maps))


def _semidefinite(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return reported covariances (N, 6, 6), positive semidefinite; NaN: not reported."""
    covariances = symmetric(triangles)
    given = ~np.isnan(covariances[:, 0, 0])
    covariances[given] = semidefinite(covariances[given])
    return covariances


def trajectory_of(stamps_ns: Sequence[int], poses: Rows) -> Trajectory:
    """Return poses as a trajectory."""
    return Trajectory(stamps_ns=np.array(stamps_ns, np.int64), T_world_base=np.asarray(poses))
