"""The poses of a run after its modules' corrections, such as loop closures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.pose_path import OpenSession
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_ROUNDING = 1e-9  # of products of transforms


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Revised:
    """The run with all corrections."""

    T_map_local: list[Transform]  # per session
    T_map_base: NDArray[np.float64]  # (N, 4, 4)


def revise(
    sessions: Sequence[OpenSession],
    stamps_ns: NDArray[np.int64],
    T_map_base: NDArray[np.float64],
    pose_sessions: NDArray[np.int64],
    is_bridged: NDArray[np.bool_],
    replaced: Mapping[int, Transform],
) -> Revised:
    """Return the poses after all revisions.

    `pose_sessions` (N,): the newest session when a pose was added, -1 before the first.
    `replaced`: by the first row of poses that replaced others: T_new_told (4, 4), how its module
    had corrected the pose before it since that was added.

    Every pose is corrected as the last revised pose of its session before it, so that bridged
    motions do not change. A session starts where the revised session before it ended (Eq. 1).
    Both are less the correction that was known when the poses were added.
    """
    moved, answers = np.array(T_map_base), np.cumsum(~is_bridged)
    placed: list[Transform] = []
    carried, is_revised = se3.identity(), False  # correction of `map` at the last session's end
    for index, session in enumerate(sessions):
        rows = np.flatnonzero(pose_sessions == index)
        begun = carried @ se3.inverse(session.T_new_told) if is_revised else carried
        T_map_local, corrections = _corrections(session, begun, stamps_ns[rows], is_bridged[rows])
        placed.append(T_map_local)
        for row in (row for row in replaced if row in rows[rows > 0]):
            if row > rows[0]:  # else it follows a pose of the session before
                carried, is_revised = corrections[row - rows[0] - 1], len(session.revised) > 0
            bridged = carried @ se3.inverse(replaced[row]) if is_revised else carried
            corrections[(rows >= row) & (answers[rows] == answers[row - 1])] = bridged
        moved[rows] = corrections @ moved[rows]
        if len(rows):
            carried, is_revised = corrections[-1], len(session.revised) > 0
    return Revised(T_map_local=placed, T_map_base=moved)


def _corrections(
    session: OpenSession,
    carried: Transform,
    stamps_ns: NDArray[np.int64],
    is_bridged: NDArray[np.bool_],
) -> tuple[Transform, NDArray[np.float64]]:
    """Return the revised T_map_local (4, 4), and T_revised_told (N, 4, 4) of poses in `map`."""
    online, revised, T_map_local = session.online, session.revised, carried @ session.T_map_local
    if not len(revised):
        return T_map_local, np.tile(carried, (len(stamps_ns), 1, 1))
    _, told_rows, revised_rows = np.intersect1d(
        online.stamps_ns, revised.stamps_ns, assume_unique=True, return_indices=True
    )
    T_revised_told = revised.T_world_base[revised_rows] @ se3.inverse(
        online.T_world_base[told_rows]
    )
    before = se3.identity()  # the revision of the session's start
    if len(told_rows) and told_rows[0] == 0 and not _is_identity(T_revised_told[0]):
        before = T_revised_told[0]
        T_map_local = T_map_local @ se3.inverse(before)
    told_ns = online.stamps_ns[told_rows]
    is_kept = np.isin(told_ns, stamps_ns[~is_bridged])  # others were replaced
    newest = np.searchsorted(told_ns[is_kept], stamps_ns, side="right")
    T_revised_told = np.concatenate([before[None], T_revised_told[is_kept]])[newest]
    return T_map_local, T_map_local @ T_revised_told @ se3.inverse(session.T_map_local)


def _is_identity(T_a_b: Transform) -> bool:
    return np.allclose(T_a_b, np.eye(4), rtol=0.0, atol=_ROUNDING)
