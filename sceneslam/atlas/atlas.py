"""The global trajectory, and what each activation of a module contributed to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneslam.atlas.fusion import fuse
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import HybridMap, MapLayers
from sceneslam.types.run import Session
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

BRIDGED = ""  # the module of a pose that no module gave


@dataclass(slots=True)
class _Open:
    """A session while it grows."""

    module: str
    T_map_local: Transform
    stamps_ns: list[int] = field(default_factory=list)
    poses: list[Transform] = field(default_factory=list)  # T_local_base
    layers: MapLayers = field(default_factory=MapLayers)


class Atlas:
    """Keeps one trajectory and one map in `map` through every change of module."""

    def __init__(self, *, voxel_m: float) -> None:
        if not 0 < voxel_m < float("inf"):
            raise ConfigError("voxel_m", voxel_m, "metres above 0")
        self._voxel_m = voxel_m
        self._sessions: list[_Open] = []
        self._stamps_ns: list[int] = []
        self._poses: list[Transform] = []  # T_map_base
        self._modules: list[str] = []

    def begin_session(self, module: str, T_map_local: Transform) -> int:
        """Open a session of a module that was placed in the map (Eq. 1); return its number."""
        self._sessions.append(_Open(module, T_map_local))
        return len(self._sessions) - 1

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Add a pose to the current session's own trajectory."""
        self._sessions[-1].stamps_ns.append(stamp_ns)
        self._sessions[-1].poses.append(T_local_base)

    def add(self, stamp_ns: int, T_map_base: Transform, module: str) -> None:
        """Add a pose to the global trajectory; a stamp has one pose, the first."""
        if not self.has_pose(stamp_ns):
            self._stamps_ns.append(stamp_ns)
            self._poses.append(T_map_base)
            self._modules.append(module)

    def add_layers(self, session: int, layers: MapLayers) -> None:
        """Take the map that a session leaves behind."""
        self._sessions[session].layers = layers

    def has_pose(self, stamp_ns: int) -> bool:
        """Tell whether the newest pose is of this stamp."""
        return bool(self._stamps_ns) and self._stamps_ns[-1] == stamp_ns

    def pose_at(self, stamp_ns: int) -> Transform | None:
        """Return T_map_base at the newest stamp, None when it got no pose."""
        return self._poses[-1] if self.has_pose(stamp_ns) else None

    @property
    def last_stamp_ns(self) -> int | None:
        """Return the stamp of the newest pose, None before the first."""
        return self._stamps_ns[-1] if self._stamps_ns else None

    @property
    def trajectory(self) -> Trajectory:
        """Return T_map_base over time."""
        return _trajectory(self._stamps_ns, self._poses)

    @property
    def pose_modules(self) -> tuple[str, ...]:
        """Return, per pose of the trajectory, the module that gave it, BRIDGED for none."""
        return tuple(self._modules)

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Return every session so far."""
        return tuple(
            Session(
                index=index,
                module=session.module,
                T_map_local=session.T_map_local,
                trajectory=_trajectory(session.stamps_ns, session.poses),
            )
            for index, session in enumerate(self._sessions)
        )

    def fuse_maps(self) -> HybridMap:
        """Return the one map of all sessions (the paper's hybrid map)."""
        return fuse(
            [(s.module, s.T_map_local, s.layers) for s in self._sessions], voxel_m=self._voxel_m
        )


def _trajectory(stamps_ns: Sequence[int], poses: Sequence[Transform]) -> Trajectory:
    if not stamps_ns:
        return Trajectory.empty()
    return Trajectory(stamps_ns=np.array(stamps_ns, np.int64), T_world_base=np.stack(poses))
