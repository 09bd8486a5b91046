"""The global trajectory, and what each activation of a module contributed to it."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.fusion import fuse
from sceneslam.atlas.revision import Revised, Told, revise
from sceneslam.atlas.uncertainty import VELOCITY, WHEELS, Covariance, Step, propagate
from sceneslam.interfaces import TrajectoryLog
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import HybridMap, MapLayers
from sceneslam.types.run import BRIDGED, Session, SessionStart
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory


@dataclass(slots=True)
class _Open:
    """A session while it grows."""

    module: str
    T_map_local: Transform
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)  # T_local_base
    layers: MapLayers = field(default_factory=MapLayers)
    revised: Trajectory = field(default_factory=Trajectory.empty)  # T_local_base

    @property
    def told(self) -> Told:
        """Return its poses, as reported and as revised."""
        online = _trajectory(self.stamps_ns, self.poses)
        return Told(
            module=self.module, T_map_local=self.T_map_local, online=online, revised=self.revised
        )


@dataclass(slots=True)
class _Path:
    """Poses by rising stamp."""

    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)  # T_map_base
    modules: list[str] = field(default_factory=list)
    sessions: list[int] = field(default_factory=list)  # that was open, -1 before the first
    covariances: list[Covariance | None] = field(default_factory=list)  # as reported

    def add(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        session: int,
        covariance: Covariance | None,
    ) -> None:
        """Add a pose unless its stamp has one."""
        if self.stamps_ns and stamp_ns <= self.stamps_ns[-1]:
            return
        self.covariances.append(covariance)
        self.stamps_ns.append(stamp_ns)
        self.poses.append(T_map_base)
        self.modules.append(module)
        self.sessions.append(session)

    def cut(self, stamp_ns: int) -> None:
        """Forget the poses from an instant on."""
        keep = bisect_left(self.stamps_ns, stamp_ns)
        for values in (
            self.stamps_ns,
            self.poses,
            self.modules,
            self.sessions,
            self.covariances,
        ):
            del values[keep:]


class Atlas:
    """Keeps one trajectory and one map in `map` through every change of module."""

    def __init__(self, *, voxel_m: float) -> None:
        if not 0 < voxel_m < float("inf"):
            raise ConfigError("voxel_m", voxel_m, "metres above 0")
        self._voxel_m = voxel_m
        self._sessions: list[_Open] = []
        self._online = _Path()  # as reported at the time
        self._path = _Path()  # as known now
        self._journal: TrajectoryLog | None = None

    def keep_journal(self, journal: TrajectoryLog) -> None:
        """Write every call to a log from now on; the same calls, repeated, give the same atlas."""
        self._journal = journal

    def begin_session(self, module: str, T_map_local: Transform) -> int:
        """Open a session of a module that was placed in the map (Eq. 1); return its number."""
        if self._journal is not None:
            self._journal.add_session(module, T_map_local)
        self._sessions.append(_Open(module, T_map_local))
        return len(self._sessions) - 1

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Add a pose to the current session's own trajectory."""
        if self._journal is not None:
            self._journal.add_local(stamp_ns, T_local_base)
        self._sessions[-1].stamps_ns.append(stamp_ns)
        self._sessions[-1].poses.append(T_local_base)

    def add(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: Covariance | None = None,
    ) -> None:
        """Add a pose to the global trajectory; a stamp has one pose, the first.

        `covariance` is that of T_local_base, where the module tells it.
        """
        if self._journal is not None:
            self._journal.add_pose(stamp_ns, T_map_base, module, covariance)
        session = len(self._sessions) - 1
        self._online.add(stamp_ns, T_map_base, module, session, covariance)
        self._path.add(stamp_ns, T_map_base, module, session, covariance)

    def rewind(self, stamp_ns: int) -> None:
        """Take the poses from an instant on back, for better ones; `online` keeps them."""
        if self._journal is not None:
            self._journal.add_rewind(stamp_ns)
        self._path.cut(stamp_ns)

    def close_session(self, session: int, layers: MapLayers, revised: Trajectory) -> None:
        """Take the map that a session leaves behind, and its own poses (T_local_base) at the end.

        `revised` is empty where the module stands by what it told.
        """
        if self._journal is not None:
            self._journal.add_end(session, revised)
        self._sessions[session].layers, self._sessions[session].revised = layers, revised

    def pose_at(self, stamp_ns: int) -> Transform | None:
        """Return T_map_base at the newest stamp, None when it got no pose."""
        return self._path.poses[-1] if self.last_stamp_ns == stamp_ns else None

    @property
    def last_covariance(self) -> Covariance | None:
        """Return the (6, 6) of the newest pose as its module told it, None where it did not."""
        return self._path.covariances[-1] if self._path.covariances else None

    @property
    def last_stamp_ns(self) -> int | None:
        """Return the stamp of the newest pose, None before the first."""
        return self._path.stamps_ns[-1] if self._path.stamps_ns else None

    @property
    def online(self) -> Trajectory:
        """Return T_map_base over time as it was reported at the time."""
        return _trajectory(self._online.stamps_ns, self._online.poses)

    @property
    def trajectory(self) -> Trajectory:
        """Return T_map_base over time as known now: after hand-overs in the past and revisions."""
        if not self._path.stamps_ns:
            return Trajectory.empty()
        stamps_ns = np.array(self._path.stamps_ns, np.int64)
        return Trajectory(stamps_ns=stamps_ns, T_world_base=self._revise().T_map_base)

    def session_starts(self) -> list[SessionStart]:
        """Return, per session, the first pose of the trajectory that its module gave."""
        path = self._path
        starts: dict[int, SessionStart] = {}
        told = zip(path.sessions, path.modules, path.stamps_ns, strict=True)
        for row, (session, module, stamp_ns) in enumerate(told):
            if module != BRIDGED and session not in starts:
                starts[session] = SessionStart(
                    row=row, session=session, module=module, stamp_ns=stamp_ns
                )
        return list(starts.values())

    def covariances(self, has_odometry: bool) -> NDArray[np.float64]:
        """Return the covariances of the trajectory (N, 6, 6), before modules revised the poses.

        In `base`, translation first. Bridges are the wheels' motion where there is odometry.
        """
        path = self._path
        steps = [
            Step(T_map_base=T, session=session, is_bridged=module == BRIDGED, covariance=told)
            for T, session, module, told in zip(
                path.poses, path.sessions, path.modules, path.covariances, strict=True
            )
        ]
        return propagate(steps, WHEELS if has_odometry else VELOCITY)

    @property
    def pose_modules(self) -> tuple[str, ...]:
        """Return, per pose of the trajectory, the module that gave it, BRIDGED for none."""
        return tuple(self._path.modules)

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Return every session so far, as revised."""
        placed = self._revise().T_map_local
        return tuple(
            Session(
                index=index,
                module=session.module,
                T_map_local=T_map_local,
                trajectory=session.revised if len(session.revised) else session.told.online,
            )
            for index, (session, T_map_local) in enumerate(zip(self._sessions, placed, strict=True))
        )

    def fuse_maps(self) -> HybridMap:
        """Return the one map of all sessions (the paper's hybrid map)."""
        placed = zip(self._sessions, self._revise().T_map_local, strict=True)
        return fuse(
            [(session.module, T_map_local, session.layers) for session, T_map_local in placed],
            voxel_m=self._voxel_m,
        )

    def _revise(self) -> Revised:
        return revise(
            [session.told for session in self._sessions],
            np.array(self._path.stamps_ns, np.int64),
            np.array(self._path.poses).reshape(-1, 4, 4),
            np.array(self._path.sessions, np.int64),
        )


def _trajectory(stamps_ns: Sequence[int], poses: Sequence[Transform]) -> Trajectory:
    if not stamps_ns:
        return Trajectory.empty()
    return Trajectory(stamps_ns=np.array(stamps_ns, np.int64), T_world_base=np.stack(poses))
