"""The poses of a run after its modules corrected their past: loop closures and the like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Told:
    """A session as its module told it, and as it says at its end that it was."""

    T_map_local: Transform
    online: Trajectory  # T_local_base
    revised: Trajectory  # T_local_base; empty: as told


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Revised:
    """The same run with every correction in it."""

    T_map_local: list[Transform]  # per session
    T_map_base: NDArray[np.float64]  # (N, 4, 4)


def revise(
    sessions: Sequence[Told],
    stamps_ns: NDArray[np.int64],
    T_map_base: NDArray[np.float64],
    pose_sessions: NDArray[np.int64],
) -> Revised:
    """Return the poses after all revisions; `pose_sessions` (N,) is -1 before the first session.

    Every pose moves with the newest pose of its session that was revised, so that bridged motion
    stays what it was. A session starts where the one before it, revised, left off (Eq. 1).
    """
    moved = np.array(T_map_base)
    placed: list[Transform] = []
    carried = se3.identity()  # corrects `map` where the session begins
    for index, session in enumerate(sessions):
        placed.append(carried @ session.T_map_local)
        rows = np.flatnonzero(pose_sessions == index)
        corrections = _corrections(session, carried, stamps_ns[rows])
        moved[rows] = corrections @ moved[rows]
        carried = corrections[-1] if len(rows) else carried
    return Revised(T_map_local=placed, T_map_base=moved)


def _corrections(
    session: Told, carried: Transform, stamps_ns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return T_map_told (N, 4, 4): what takes the poses as told to the poses as revised."""
    online, revised = session.online, session.revised
    if not len(revised):
        return np.broadcast_to(carried, (len(stamps_ns), 4, 4))
    _, told_rows, revised_rows = np.intersect1d(
        online.stamps_ns, revised.stamps_ns, assume_unique=True, return_indices=True
    )
    T_told, T_revised = online.T_world_base[told_rows], revised.T_world_base[revised_rows]
    T_local_told = np.concatenate([np.eye(4)[None], T_revised @ se3.inverse(T_told)])
    newest = np.searchsorted(online.stamps_ns[told_rows], stamps_ns, side="right")
    T_map_local = carried @ session.T_map_local
    return np.asarray(T_map_local @ T_local_told[newest] @ se3.inverse(session.T_map_local))
