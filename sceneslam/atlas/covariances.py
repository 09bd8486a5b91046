"""The covariance of every pose in `map`: the marginals of a graph of submaps.

A module measures its poses relative to its map around them, and reports that covariance. Poses in
one submap share the submap's error, so that only the next submap adds an independent one; it is as
large as the poses that place the submap are uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.graph import LOADED, marginals
from sceneslam.atlas.submaps.submap import LENGTH_M, TURN_RAD
from sceneslam.atlas.uncertainty import MAPPED, Covariance, Drift, drifted, motions
from sceneslam.graphs.edge import Edge
from sceneslam.types import se3
from sceneslam.types.covariance import grown, semidefinite
from sceneslam.types.trajectory import Trajectory

_LEAST = 1e-10 * np.eye(6)  # (10 um, 10 urad)^2: keeps the graph well-conditioned
_MOVED_MIN = 0.1  # submaps; two modules' poses over less motion differ by noise alone
_LEVEL = [2, 3, 4]  # z, roll, pitch of base


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosedPath:
    """The poses of a run."""

    T_map_base: NDArray[np.float64]  # (N, 4, 4)
    sessions: NDArray[np.int64]  # (N,), -1 before the first
    is_bridged: NDArray[np.bool_]  # (N,): without a module
    reported: NDArray[np.float64]  # (N, 6, 6) of T_local_base, in base; NaN: not reported
    of_maps: NDArray[np.float64]  # (N, 6, 6) of the drift of the module's map, the same way

    def claim(self, rows: NDArray[np.int64] | slice) -> Covariance | None:
        """Return the covariance (6, 6) of a map that is placed by these poses, with common errors.

        It is the inverse of the poses' mean information; None if none was reported.
        """
        reported = self.reported[rows][~self.is_bridged[rows]]
        reported = reported[~np.isnan(reported[:, 0, 0])]
        if not len(reported):
            return None
        return np.asarray(np.linalg.inv(np.linalg.inv(reported + _LEAST).mean(axis=0)))

    def claims(self) -> list[Covariance | None]:
        """Return the claim of each session, with what its map is known to drift per submap."""
        T, maps = self.T_map_base, np.nan_to_num(self.of_maps)
        found, submaps = [], _submaps(_moved(T))
        for session in range(int(self.sessions.max(initial=-1)) + 1):
            rows = np.flatnonzero(self.sessions == session)
            claim = self.claim(rows)
            if claim is not None:
                first, last = rows[[0, -1]]
                drift = grown(maps[first], maps[last], se3.inverse(T[last]) @ T[first])
                claim = claim + drift / max(submaps[last] - submaps[first], 1.0)
            found.append(claim)
        return found


def covariances(path: PosedPath, *, loops: Sequence[Edge], bridge: Drift) -> NDArray[np.float64]:
    """Return the covariance (N, 6, 6) of every pose, in `base`; `map` begins at the first pose.

    `loops` lead from row to row, or from LOADED: then `map` is the loaded map's. `bridge` is the
    drift of bridged poses. The map of a module that reports no covariance drifts as MAPPED.
    """
    T, sessions = path.T_map_base, path.sessions
    if not len(T):
        return np.zeros((0, 6, 6))
    moved = _moved(T)
    beside, maps = _beside(path, moved, bridge), np.nan_to_num(path.of_maps)
    seams = np.flatnonzero(np.diff(sessions))
    begins = np.flatnonzero(np.diff(np.floor(_submaps(moved)))) + 1
    closed = [row for loop in loops for row in (loop.first, loop.second) if row != LOADED]
    rows = np.unique([0, *begins, *seams, *(seams + 1), *closed, len(T) - 1]).tolist()
    drifts: dict[tuple[int, int], Covariance] = {}
    for first, last in pairwise(rows):
        claim, driven = path.claim(slice(first, last)), moved[last] - moved[first]
        if sessions[first] != sessions[last]:  # one begins where the other ended
            drift = _carried(beside[first], T[first], T[last]) + maps[last]
        else:
            drift = drifted(MAPPED, driven) if claim is None else _submaps(driven) * claim
            drift = drift + grown(maps[first], maps[last], se3.inverse(T[last]) @ T[first])
        drifts[first, last] = drift + _LEAST
    if not any(loop.first == LOADED for loop in loops):
        drifts[LOADED, 0] = _LEAST
    of_node = marginals(T, drifts, loops)
    found = np.repeat(of_node[rows[-1]][None], len(T), axis=0)
    for first, last in pairwise(rows):
        submaps = _submaps(moved[first : last + 1] - moved[first])
        share = (submaps[:-1] / max(submaps[-1], np.finfo(float).tiny))[:, None, None]
        before = _carried(of_node[first], T[first], T[first:last])
        after = _carried(of_node[last], T[last], T[first:last])
        found[first:last] = (1.0 - share) * before + share * after
    return _on_floor(path, found + beside)


def calibrated(
    path: PosedPath, modules: Sequence[str], trajectories: Sequence[Trajectory]
) -> PosedPath:
    """Return the path with the modules' covariances as their differences at hand-overs show.

    `trajectories` (T_local_base) and their `modules` are by session. Two modules that processed
    the same observations differ by both their errors; the expected share of each, given what both
    claim, is held against its claim: one step of expectation maximisation of variance components.
    A variance is the geometric mean of what is claimed and seen: the claim counts as one submap, a
    difference as the submaps that both drove through.
    """
    claims = path.claims()
    submaps, logs = dict.fromkeys(modules, 1.0), dict.fromkeys(modules, 0.0)
    for old, new in pairwise(range(len(claims))):
        found = _difference(trajectories[old], trajectories[new])
        a, b = claims[old], claims[new]
        if found is None or a is None or b is None:
            continue
        apart, compared = found
        weight = np.linalg.inv(a + b)
        for session, claim, other in ((old, a, b), (new, b, a)):
            # The trace of claim^-1 times the expectation, without differences of what is alike.
            ratio = np.trace(weight @ (apart @ weight @ claim + other)) / 6
            submaps[modules[session]] += compared
            logs[modules[session]] += compared * float(np.log(ratio))
    scales = np.exp([*(logs[module] / submaps[module] for module in modules), 0.0])
    return replace(path, reported=path.reported * scales[path.sessions][:, None, None])


def _difference(a: Trajectory, b: Trajectory) -> tuple[Covariance, float] | None:
    """Return the covariance (6, 6) of two modules' difference per pose, and over how many submaps.

    None without motion.
    """
    _, rows_a, rows_b = np.intersect1d(a.stamps_ns, b.stamps_ns, return_indices=True)
    T_a, T_b = a.T_world_base[rows_a], b.T_world_base[rows_b]
    submaps = np.minimum(_submaps(_moved(T_a)), _submaps(_moved(T_b)))
    if not len(rows_a) or submaps[-1] < _MOVED_MIN:
        return None
    off = se3.log(se3.inverse(se3.inverse(T_a[0]) @ T_a) @ se3.inverse(T_b[0]) @ T_b)
    noise = np.diff(off, axis=0)  # between poses so near one another that nothing drifts
    drift = off.T @ off - noise.T @ noise  # the first difference is 0
    drift = semidefinite(drift / (2.0 * np.minimum(submaps, 1.0)).sum())
    return drift, float(submaps[-1])


def _moved(T_map_base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the metres and radians (N, 2) driven up to each pose."""
    begin = np.zeros((len(T_map_base[:1]), 2))
    return np.cumsum(np.concatenate([begin, motions(T_map_base)]), axis=0)


def _submaps(moved: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many submaps long motions (..., 2) are [m, rad]."""
    return np.asarray(moved @ (1.0 / np.array([LENGTH_M, TURN_RAD])))


def _beside(path: PosedPath, moved: NDArray[np.float64], bridge: Drift) -> NDArray[np.float64]:
    """Return the covariance (N, 6, 6) of each pose relative to its session's map."""
    beside = np.nan_to_num(path.reported)
    begins = np.diff(path.sessions, prepend=-2) != 0
    held = np.maximum.accumulate(
        np.where(begins | ~path.is_bridged, np.arange(len(moved)), 0)
    )  # the newest row that a module measured, within one map
    for row in np.flatnonzero(path.is_bridged).tolist():
        at, T = held[row], path.T_map_base
        beside[row] = drifted(bridge, moved[row] - moved[at])
        if not path.is_bridged[at]:
            beside[row] += _carried(beside[at], T[at], T[row])
    return beside


def _carried(
    covariance: Covariance, T_map_from: se3.Transform, T_map_to: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a pose's covariance (6, 6) at poses (..., 4, 4) that are rigidly connected to it."""
    return se3.carried(covariance, se3.inverse(T_map_to) @ T_map_from)


def _on_floor(path: PosedPath, covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariances (N, 6, 6), given how level the path is.

    Height and tilt vary by as much as they do along the estimated path, and as its modules claim.
    """
    claim = path.claim(slice(None))
    if claim is None:
        return covariances
    T_first_base = se3.inverse(path.T_map_base[0]) @ path.T_map_base
    level = np.stack([T_first_base[:, 2, 3], T_first_base[:, 2, 1], -T_first_base[:, 2, 0]], axis=1)
    varied = (level**2).mean(axis=0) + np.diag(claim)[_LEVEL]
    known = covariances[:, :, _LEVEL]
    gain = known @ np.linalg.inv(known[:, _LEVEL] + np.diag(varied))
    return np.asarray(covariances - gain @ np.swapaxes(known, 1, 2))
