"""The poses of a run as they arrive: the robot's trajectory, and that of each session."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneslam.atlas.revision import Told
from sceneslam.atlas.submaps.collector import Known
from sceneslam.atlas.uncertainty import Covariance, SessionPose
from sceneslam.types.maps import MapLayers
from sceneslam.types.run import BRIDGED, SessionStart
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory


@dataclass(slots=True)
class OpenSession:
    """A session that receives poses."""

    module: str
    T_map_local: Transform
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)  # T_local_base
    layers: MapLayers = field(default_factory=MapLayers)
    revised: Trajectory = field(default_factory=Trajectory.empty)  # T_local_base

    @property
    def told(self) -> Told:
        """Return its poses, as reported and as revised."""
        online = trajectory_of(self.stamps_ns, self.poses)
        return Told(
            module=self.module, T_map_local=self.T_map_local, online=online, revised=self.revised
        )


@dataclass(slots=True)
class PosePath:
    """Poses ordered by stamp."""

    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)  # T_map_base
    modules: list[str] = field(default_factory=list)
    sessions: list[int] = field(default_factory=list)  # the open session, -1 before the first
    covariances: list[Covariance | None] = field(default_factory=list)  # as reported

    def add(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        session: int,
        covariance: Covariance | None,
    ) -> None:
        """Add a pose unless its stamp already has one."""
        if self.stamps_ns and stamp_ns <= self.stamps_ns[-1]:
            return
        self.covariances.append(covariance)
        self.stamps_ns.append(stamp_ns)
        self.poses.append(T_map_base)
        self.modules.append(module)
        self.sessions.append(session)

    def cut(self, stamp_ns: int) -> None:
        """Remove the poses from an instant on."""
        keep = bisect_left(self.stamps_ns, stamp_ns)
        for values in (
            self.stamps_ns,
            self.poses,
            self.modules,
            self.sessions,
            self.covariances,
        ):
            del values[keep:]

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
            covariance=self.covariances[row],
        )

    def session_starts(self) -> list[SessionStart]:
        """Return, per session, the first pose that its module gave."""
        starts: dict[int, SessionStart] = {}
        told = zip(self.sessions, self.modules, self.stamps_ns, strict=True)
        for row, (session, module, stamp_ns) in enumerate(told):
            if module != BRIDGED and session not in starts:
                starts[session] = SessionStart(
                    row=row, session=session, module=module, stamp_ns=stamp_ns
                )
        return list(starts.values())

    def steps(self) -> list[SessionPose]:
        """Return every pose with its module and the covariance that this reported."""
        rows = zip(self.poses, self.sessions, self.modules, self.covariances, strict=True)
        return [
            SessionPose(
                T_map_base=T, session=session, is_bridged=module == BRIDGED, covariance=told
            )
            for T, session, module, told in rows
        ]


def trajectory_of(stamps_ns: Sequence[int], poses: Sequence[Transform]) -> Trajectory:
    """Return poses as a trajectory."""
    if not stamps_ns:
        return Trajectory.empty()
    return Trajectory(stamps_ns=np.array(stamps_ns, np.int64), T_world_base=np.stack(poses))
