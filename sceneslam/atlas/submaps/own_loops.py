"""The loops that modules closed themselves, as measured motions between two stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneslam.atlas.pose_path import OpenSession
from sceneslam.types import planar, se3
from sceneslam.types.maps import PoseGraphLayer
from sceneslam.types.planar import Matrix, Planar
from sceneslam.types.se3 import Transform

Path = Callable[[int], Transform | None]  # T_run_base at a stamp, None without a pose

_ROUNDING = np.diag([1e-6, 1e-6, 1e-6])  # makes a covariance invertible: 1 mm, 1 mrad
# A module recognizes its own earlier session by dozens of features, accurate to some
# millimetres each (experiments/rgbd_loop.md); it reports no covariance.
_RECOGNIZED = np.diag([5e-3, 5e-3, 2e-3]) ** 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OwnLoop:
    """A motion between two stamps of a run."""

    from_ns: int
    to_ns: int
    T_from_to: Planar
    covariance: Matrix  # (3, 3), axes of `to`


def own_loops(sessions: Sequence[OpenSession], path: Path) -> list[OwnLoop]:
    """Return the loops within sessions, and to earlier sessions of the same module.

    `path` is as the modules revised it.
    """
    found = []
    for index, session in enumerate(sessions):
        if session.layers.pose_graph is not None:
            found += _loops_of(session.layers.pose_graph)
        earlier = _recognized(sessions, index)
        if earlier is None:
            continue
        from_ns, to_ns = earlier.stamps_ns[-1], int(session.revised.stamps_ns[0])
        T_run_from, T_run_to = path(from_ns), path(to_ns)
        if T_run_from is not None and T_run_to is not None:
            motion = planar.from_transform(se3.inverse(T_run_from) @ T_run_to)
            found.append(
                OwnLoop(from_ns=from_ns, to_ns=to_ns, T_from_to=motion, covariance=_RECOGNIZED)
            )
    return found


def _loops_of(graph: PoseGraphLayer) -> list[OwnLoop]:
    found = []
    for row in np.flatnonzero(graph.is_loop).tolist():
        from_ns, to_ns = graph.stamps_ns[graph.edges[row]].tolist()
        covariance = planar.planar_covariance(np.linalg.pinv(graph.information[row]))
        found.append(
            OwnLoop(
                from_ns=from_ns,
                to_ns=to_ns,
                T_from_to=planar.from_transform(graph.T_from_to[row]),
                covariance=covariance + _ROUNDING,
            )
        )
    return found


def _recognized(sessions: Sequence[OpenSession], index: int) -> OpenSession | None:
    """Return the earlier session in which the module recognized where this one starts."""
    session, revised = sessions[index], sessions[index].revised
    before = [one for one in sessions[:index] if one.module == session.module and one.stamps_ns]
    if not before or not len(revised) or int(revised.stamps_ns[0]) not in session.stamps_ns:
        return None
    row = session.stamps_ns.index(int(revised.stamps_ns[0]))
    is_moved = not np.allclose(session.poses[row], revised.T_world_base[0], rtol=0.0, atol=1e-6)
    return before[-1] if is_moved else None
