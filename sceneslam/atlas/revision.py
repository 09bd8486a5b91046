"""The poses of a run after its modules' corrections, such as loop closures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_ROUNDING = 1e-9  # of products of transforms


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Told:
    """A session as its module reported it, and as the module revised it at its end."""

    module: str
    T_map_local: Transform
    online: Trajectory  # T_local_base
    revised: Trajectory  # T_local_base; empty: as reported


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Revised:
    """The run with all corrections."""

    T_map_local: list[Transform]  # per session
    T_map_base: NDArray[np.float64]  # (N, 4, 4)


def revise(
    sessions: Sequence[Told],
    stamps_ns: NDArray[np.int64],
    T_map_base: NDArray[np.float64],
    pose_sessions: NDArray[np.int64],
) -> Revised:
    """Return the poses after all revisions; `pose_sessions` (N,) is -1 before the first session.

    Every pose is corrected as the last revised pose of its session before it, so that bridged
    motions do not change. A session starts where the revised session before it ended (Eq. 1),
    unless its module corrected its start, too, because it recognized the place from an earlier
    session. Then the drift in between is corrected in proportion to the distance travelled.
    """
    moved = np.array(T_map_base)
    placed: list[Transform] = []
    carried = se3.identity()  # correction of `map` at the session's start
    for index, session in enumerate(sessions):
        placed.append(carried @ session.T_map_local)
        rows = np.flatnonzero(pose_sessions == index)
        corrections = _corrections(session, carried, stamps_ns[rows])
        moved[rows] = corrections @ moved[rows]
        before = [j for j in range(index) if sessions[j].module == session.module]
        if before and len(rows):
            step = corrections[0] @ se3.inverse(carried)
            between = _between(pose_sessions, before[-1], index)
            _spread(step, moved, between, placed, pose_sessions)
        carried = corrections[-1] if len(rows) else carried
    return Revised(T_map_local=placed, T_map_base=moved)


def _between(pose_sessions: NDArray[np.int64], first: int, last: int) -> NDArray[np.int64]:
    """Return the rows (N,) of the poses between two sessions."""
    return np.flatnonzero((pose_sessions > first) & (pose_sessions < last))


def _spread(
    step: Transform,
    moved: NDArray[np.float64],
    rows: NDArray[np.int64],
    placed: list[Transform],
    pose_sessions: NDArray[np.int64],
) -> None:
    """Distribute a correction over poses by distance; sessions move with their middle pose."""
    if not len(rows) or np.allclose(step, np.eye(4), rtol=0.0, atol=_ROUNDING):
        return
    ways_m = np.linalg.norm(
        np.diff(moved[rows, :3, 3], axis=0, prepend=moved[rows[:1], :3, 3]), axis=1
    )
    shares = np.cumsum(ways_m) / max(float(ways_m.sum()), 1e-9)
    xi = se3.log(step)
    T_new_old = np.stack([se3.exp(share * xi) for share in shares.tolist()])
    moved[rows] = T_new_old @ moved[rows]
    for index in np.unique(pose_sessions[rows]).tolist():
        within = np.flatnonzero(pose_sessions[rows] == index)
        placed[index] = T_new_old[within[len(within) // 2]] @ placed[index]


def _corrections(
    session: Told, carried: Transform, stamps_ns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return T_map_told (N, 4, 4): the transforms from reported to revised poses."""
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
