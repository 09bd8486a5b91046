"""The global trajectory, and what each activation of a module contributed to it."""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.budget import Budget
from sceneslam.atlas.covariances import PosedPath, calibrated, covariances
from sceneslam.atlas.fusion import Placed, fuse
from sceneslam.atlas.lasting.lasting_map import EXTEND, LastingMap
from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.pose_path import OpenSession, PoseLog, PosePath, trajectory_of
from sceneslam.atlas.revision import Revised, revise
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.atlas.uncertainty import VELOCITY, Covariance, of_wheels
from sceneslam.interfaces import TrajectoryLog
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError, text_of
from sceneslam.types.maps import HybridMap, MapLayers, MovedMap
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Wheels
from sceneslam.types.run import BRIDGED, Note, Session, SessionStart
from sceneslam.types.se3 import Transform, Vector
from sceneslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)
_SEEN_M, _SEEN_RAD = 0.05, 0.01  # a cell of the grid; the same 5 m away


class Atlas:
    """Keeps one trajectory and one map in `map` through every change of module."""

    def __init__(
        self,
        *,
        voxel_m: float,
        load: str | None = None,
        save: str | None = None,
        mode: str = EXTEND,
        save_every_s: float = 60.0,
        budget_mb: float | None = None,
    ) -> None:
        if not 0 < voxel_m < float("inf"):
            raise ConfigError("voxel_m", voxel_m, "metres above 0")
        if budget_mb is not None and not budget_mb > 0:
            raise ConfigError("budget_mb", budget_mb, "null (no limit), or above 0")
        self._budget = None if budget_mb is None else Budget(limit_mb=budget_mb, voxel_m=voxel_m)
        self._lasting = LastingMap(load=load, save=save, mode=mode, save_every_s=save_every_s)
        self._mapper: Mapper | None = None  # None while only poses are given
        self._note: Note | None = None
        # In force now, when the map was shown last, and when that was decided last.
        self._correction = self._shown = self._compared = Correction.none()
        self._shows_loaded = False  # since the map was shown last
        self._is_over = False  # the correction is of the poses as revised, before: as told
        self._voxel_m = voxel_m
        self._sessions: list[OpenSession] = []
        self._online = PoseLog()  # as reported at the time
        self._path = PosePath()  # after corrections
        self._journal: TrajectoryLog | None = None

    def keep_journal(self, journal: TrajectoryLog) -> None:
        """Write every further call to a log; repeating these calls gives the same atlas."""
        self._journal = journal

    def open(
        self,
        rig: Rig,
        note: Note,
        *,
        closing: Collection[str] = (),
        is_looking: bool = True,
        is_live: bool = False,
    ) -> None:
        """Prepare for observations; `note` receives events, such as recognized places and loops.

        `closing` are the modules that close loops themselves. With `is_looking`, places are
        recognized by what a camera sees.
        """
        import gtsam  # noqa: F401 - Ctrl-C during its import, as in the run, would end its use

        closed = frozenset(closing)
        self._note = note
        loaded = self._lasting.loaded
        self._lasting.open(is_live=is_live)
        if self._budget is not None:
            self._budget.open(is_live=is_live)
        self._mapper = Mapper(
            rig,
            known=self._path.known_at,
            note=note,
            is_closed=lambda session: session >= 0 and self._sessions[session].module in closed,
            loaded=loaded,
            moves_loaded=self._lasting.saves,
            keeps_views=is_looking or self._lasting.saves,
            is_live=is_live,
        )

    def observe(self, observation: Observation, up_base: Vector | None) -> None:
        """Add an observation whose pose was added, and the upward direction (3,) in base."""
        if self._mapper is not None:
            self._look(self._mapper, observation, up_base)
        self.report(observation.stamp_ns)

    def report(self, stamp_ns: int) -> None:
        """Add all newer poses to `online` as they are now; an observation was processed."""
        if self._journal is not None:
            self._journal.add_observation(stamp_ns)
        path, online = self._path, self._online
        first = bisect_right(path.stamps_ns, online.stamps_ns[-1]) if online.stamps_ns else 0
        for row in range(first, len(path.stamps_ns)):
            online.add(path.stamps_ns[row], self._in_map(path.poses[row]))

    def _look(self, mapper: Mapper, observation: Observation, up_base: Vector | None) -> None:
        """Add an observation to the submaps, and take the correction that follows."""
        try:
            mapper.observe(observation, up_base)
            correction = mapper.take_correction()
            if correction is not None:
                self.correct(correction.changes(self._correction))
            self._lasting.keep(observation.stamp_ns, mapper)
        except Exception as error:  # poses continue without a map
            self._give_up(error)

    def correct(self, changes: Correction) -> None:
        """Correct the poses otherwise than before, at the nodes of a correction."""
        if self._journal is not None:
            self._journal.add_correction(changes.stamps_ns, changes.T_new_old)
        self._correction = self._correction.updated(changes)

    def finish(self) -> list[str]:
        """Close the loops between sessions and save the map; return one sentence per failure.

        Call it after the last session was closed.
        """
        try:
            if self._budget is not None:
                self._budget.close()
        except Exception as error:  # the maps stay as they are
            self._lasting.faults.append(f"the maps could not be thinned: {text_of(error)}")
        if self._mapper is not None and self._path.stamps_ns:
            try:
                self._solve()
                return self._lasting.faults
            except Exception as error:
                self._give_up(error)
        self._lasting.close()
        return self._lasting.faults

    def _solve(self) -> None:
        """Solve the graph and save the map."""
        assert self._mapper is not None and self._note is not None
        revised = self._revise().T_map_base
        at = dict(zip(self._path.stamps_ns, revised, strict=True)).get
        layers = [session.layers for session in self._sessions]
        self.end_with(self._mapper.finish(at, layers))
        self._lasting.faults += self._mapper.faults
        self._lasting.finish(self._mapper, self._path.stamps_ns[-1], self._note)

    def _give_up(self, error: Exception) -> None:
        """Continue without submaps: the trajectory stays as the modules reported it."""
        _log.info("submaps", exc_info=error)
        if self._mapper is not None:
            self._mapper.close()
        self.end_with(Correction.none())
        self._mapper = None
        unsaved = ", its map is not saved from here on" if self._lasting.saves else ""
        self._lasting.faults.append(
            f"the run goes on without submaps and loops{unsaved}: {text_of(error)}"
        )

    def end_with(self, final: Correction) -> None:
        """Take the final correction, which is of the poses as their modules revised them."""
        if self._journal is not None:
            self._journal.add_final(final.stamps_ns, final.T_new_old)
        self._correction, self._is_over = final, True

    def begin_session(
        self, module: str, T_map_local: Transform, T_new_told: Transform | None = None
    ) -> int:
        """Open a session of a module placed at T_map_local (4, 4) (Eq. 1); return its number.

        `T_new_told` (4, 4): how the module before it has corrected the last pose since that was
        added; None: not at all.
        """
        T_new_told = se3.identity() if T_new_told is None else T_new_told
        if self._journal is not None:
            self._journal.add_session(module, T_map_local, T_new_told)
        self._sessions.append(OpenSession(module, T_map_local, T_new_told))
        return len(self._sessions) - 1

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Add a pose (4, 4) to the current session's own trajectory."""
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
        map_covariance: Covariance | None = None,
    ) -> None:
        """Add a pose (4, 4) to the global trajectory; further poses of one stamp are ignored.

        The covariances (6, 6) are those of T_local_base in the module's map, and of this map's
        drift; None if the module does not report them.
        """
        if self._journal is not None:
            self._journal.add_pose(stamp_ns, T_map_base, module, covariance, map_covariance)
        session = len(self._sessions) - 1
        self._path.add(stamp_ns, T_map_base, module, session, covariance, map_covariance)

    def rewind(self, stamp_ns: int, T_new_told: Transform | None = None) -> None:
        """Remove the poses from an instant on, to be replaced; `online` keeps them.

        `T_new_told` (4, 4): how the module has corrected the last pose left since that was added,
        where the session goes on from it; None: another session begins.
        """
        if self._journal is not None:
            self._journal.add_rewind(stamp_ns, T_new_told)
        self._path.cut(stamp_ns, T_new_told)
        self._correction = self._correction.cut(stamp_ns)
        self._shown = self._shown.cut(stamp_ns)
        if self._mapper is not None:
            try:
                self._mapper.rewind(stamp_ns)
            except Exception as error:  # poses continue without a map
                self._give_up(error)

    def close_session(self, session: int, layers: MapLayers, revised: Trajectory) -> None:
        """Add the final map of a session, and its revised poses T_local_base (4, 4) [m].

        `revised` is empty if the module did not revise its poses.
        """
        if self._journal is not None:
            self._journal.add_end(session, revised)
        self._sessions[session].layers, self._sessions[session].revised = layers, revised
        if self._budget is not None:
            self._budget.keep(self._sessions)

    def pose_at(self, stamp_ns: int) -> Transform | None:
        """Return T_map_base (4, 4) at the newest stamp, None if it has no pose.

        It is in the frame of the loaded map as soon as the run was located in it.
        """
        if self.last_stamp_ns != stamp_ns:
            return None
        return self._in_map(self._path.poses[-1])

    def take_moved(self) -> MovedMap | None:
        """Return the map if loops or a loaded map have moved it visibly since the last call."""
        was, now, path = self._shown, self._correction, self._path
        if now is self._compared or not path.stamps_ns:
            return None
        self._compared = now
        nodes_ns = np.union1d(was.stamps_ns, now.stamps_ns)
        rows = np.searchsorted(path.stamps_ns[:-1], nodes_ns)
        T_run_base = np.reshape([path.poses[row] for row in rows], (-1, 4, 4))
        T_was_base, T_now_base = (one.apply(nodes_ns, T_run_base) for one in (was, now))
        off = se3.inverse(T_was_base) @ T_now_base
        is_seen = np.linalg.norm(off[:, :3, 3], axis=1) > _SEEN_M
        is_seen |= se3.rotation_angle_rad(off) > _SEEN_RAD
        loaded = None
        if self._mapper is not None and self._mapper.is_placed:
            loaded = self._mapper.loaded_grid
        is_loaded = loaded is not None
        if not is_seen.any() and is_loaded == self._shows_loaded:
            return None
        self._shown, self._shows_loaded = now, is_loaded
        return MovedMap(loaded=loaded, moved=partial(now.moved, was))

    @property
    def last_covariance(self) -> Covariance | None:
        """Return the newest pose's (6, 6) covariance as its module reported it, else None."""
        rows = len(self._path.stamps_ns)
        return self._path.covariance_at(rows - 1) if rows else None

    @property
    def last_stamp_ns(self) -> int | None:
        """Return the stamp of the newest pose, None before the first."""
        return self._path.stamps_ns[-1] if self._path.stamps_ns else None

    @property
    def online(self) -> Trajectory:
        """Return T_map_base over time as it was reported at the time."""
        return trajectory_of(self._online.stamps_ns, self._online.poses)

    @property
    def trajectory(self) -> Trajectory:
        """Return T_map_base over time, with the corrections by hand-overs and revisions so far."""
        if not self._path.stamps_ns:
            return Trajectory.empty()
        stamps_ns = np.array(self._path.stamps_ns, np.int64)
        poses = self._correction.apply(stamps_ns, self._corrected().T_map_base)
        return Trajectory(stamps_ns=stamps_ns, T_world_base=poses)

    def session_starts(self) -> list[SessionStart]:
        """Return, per session, the first pose of the trajectory that its module gave."""
        return self._path.session_starts()

    def covariances(self, wheels: Wheels | None) -> NDArray[np.float64]:
        """Return the covariances (N, 6, 6) of the trajectory relative to its first pose.

        In `base`, translation [m] first, then rotation [rad]; in a loaded map, relative to that.
        Bridged poses have the uncertainty of the `wheels`, without odometry (None) that of constant
        velocity.
        """
        sessions, stamps_ns = self.sessions, np.array(self._path.stamps_ns, np.int64)
        path = PosedPath(
            T_map_base=self.trajectory.T_world_base,
            sessions=np.array(self._path.sessions, np.int64),
            is_bridged=np.array(self._path.modules) == BRIDGED,
            reported=self._path.reported([session.revised for session in self._sessions]),
            of_maps=self._path.of_maps(),
        )
        path = calibrated(
            path,
            [session.module for session in sessions],
            [session.trajectory for session in sessions],
        )
        loops = [] if self._mapper is None else self._mapper.loops(stamps_ns)
        bridge = VELOCITY if wheels is None else of_wheels(wheels)
        return covariances(path, loops=loops, bridge=bridge)

    @property
    def pose_modules(self) -> tuple[str, ...]:
        """Return, per pose of the trajectory, the module that gave it, or BRIDGED."""
        return tuple(self._path.modules)

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Return every session so far, as revised."""
        placed = self._placed(self._corrected().T_map_local)
        return tuple(
            Session(
                index=index,
                module=session.module,
                T_map_local=T_map_local,
                trajectory=session.revised if len(session.revised) else session.online,
            )
            for index, (session, T_map_local) in enumerate(zip(self._sessions, placed, strict=True))
        )

    def fuse_maps(self) -> HybridMap:
        """Return the one map of all sessions (the paper's hybrid map).

        If the run was located in a loaded map, the grid shows both.
        """
        revised = self._corrected().T_map_local
        placed = [
            Placed(
                module=session.module,
                T_map_local=T_map_local,
                layers=session.layers,
                T_map_laser=self._scanned_at(session.layers, T_revised),
            )
            for session, T_map_local, T_revised in zip(
                self._sessions, self._placed(revised), revised, strict=True
            )
        ]
        if self._mapper is None or not self._mapper.has_submaps:
            return fuse(placed, voxel_m=self._voxel_m)
        saved = self._mapper.saved()
        own = [row for row, one in enumerate(saved.submaps) if one.run == saved.runs - 1]
        fused = fuse(placed, voxel_m=self._voxel_m, pose_graph=saved.of(own).graph())
        if not self._mapper.is_placed:
            return fused
        try:
            plan = self._lasting.map_of(self._mapper).plan()
            is_drawn = len(plan) or plan.free.any()  # a map of views alone has no walls
            return replace(fused, grid=grid_of(plan)) if is_drawn else fused
        except InputError as error:  # it is too large
            _log.warning("the grid is without the loaded map: %s", error)
            return fused

    def _in_map(self, T_run_base: Transform) -> Transform:
        """Return a pose as loops correct it, or in a loaded map if the run was located there."""
        if not len(self._correction.stamps_ns):
            return T_run_base
        return np.asarray(self._correction.T_new_old[-1] @ T_run_base)

    def _placed(self, T_revised: Sequence[Transform]) -> list[Transform]:
        """Return T_map_local of every session, corrected as the middle one of its poses."""
        placed, path = list(T_revised), np.array(self._path.sessions, np.int64)
        stamps_ns = np.array(self._path.stamps_ns, np.int64)
        for session, T_map_local in enumerate(T_revised):
            own_ns = stamps_ns[path == session]
            if not len(own_ns):  # a hand-over replaced all of them
                own_ns = np.array(self._sessions[session].stamps_ns, np.int64)
            if len(own_ns):
                middle_ns = own_ns[[len(own_ns) // 2]]
                placed[session] = self._correction.apply(middle_ns, T_map_local[None])[0]
        return placed

    def _scanned_at(self, layers: MapLayers, T_map_local: Transform) -> NDArray[np.float64] | None:
        """Return T_map_laser (K, 4, 4) of a session's scans, each as the graph corrects it."""
        if layers.scans is None:
            return None
        T_map_laser = T_map_local @ layers.scans.T_world_laser
        return self._correction.apply(layers.scans.stamps_ns, T_map_laser)

    def _corrected(self) -> Revised:
        """Return the poses that the correction applies to."""
        if self._is_over or not len(self._correction.stamps_ns):
            return self._revise()
        told = np.array(self._path.poses).reshape(-1, 4, 4)
        return Revised(T_map_local=[one.T_map_local for one in self._sessions], T_map_base=told)

    def _revise(self) -> Revised:
        return revise(
            self._sessions,
            np.array(self._path.stamps_ns, np.int64),
            np.array(self._path.poses).reshape(-1, 4, 4),
            np.array(self._path.begun, np.int64),
            np.array(self._path.modules) == BRIDGED,
            self._path.moved,
        )
