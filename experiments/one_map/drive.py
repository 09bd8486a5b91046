"""Drives an atlas through a floor plan, by odometry that drifts, without a bus around it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.places.floor_plan import FloorPlan, draw
from sceneslam.scans.key_scan import KeyScan, KeyScanner
from sceneslam.testing.floor_plans import World
from sceneslam.types import planar
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation
from sceneslam.types.planar import Planar
from sceneslam.types.rig import Laser, Rig, Sensor
from sceneslam.types.trail import Trail
from sceneslam.types.trajectory import Trajectory

RIG = Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())
_STEP_S = 0.2  # between two poses 0.1 m apart: half a metre per second
_START_NS = 10**9
_DEVIATION = 0.03  # of distance and height that dead reckoning states, per metre and per radian


@dataclass(frozen=True, slots=True, kw_only=True)
class Odometry:
    """By how much more than the truth dead reckoning measures."""

    scale: float = 0.0  # of every distance
    turn_rad_per_m: float = 0.0


@dataclass(slots=True)
class Drive:
    """A run of an atlas."""

    atlas: Atlas
    is_live: bool = False
    turn_deviation: float = _DEVIATION  # of rotation, likewise; all deviations add up
    events: list[dict[str, Any]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    reckoned: list[Planar] = field(default_factory=list)  # T_run_base as the atlas got them

    def go(
        self,
        world: World,
        true: NDArray[np.float64],
        *,
        odometry: Odometry | None = None,
        sessions: int = 1,
    ) -> Drive:
        """Drive along true poses (N, 3), in so many sessions of two modules by dead reckoning."""
        self.atlas.open(RIG, self._note, is_live=self.is_live)
        T_run_base, T_run_local, session = np.zeros(3), np.zeros(3), -1
        deviation = np.full(6, 1e-3)
        for row, pose in enumerate(true):
            step = planar.between(true[max(row - 1, 0)], pose)
            T_run_base = planar.compose(T_run_base, _measured(step, odometry or Odometry()))
            if row * sessions // len(true) != session:
                session = row * sessions // len(true)
                T_run_local = T_run_base
                name = f"module_{session % 2}"
                self.atlas.begin_session(name, planar.to_transform(T_run_local))
                deviation = np.full(6, 1e-3)
            ratio = np.repeat([_DEVIATION, self.turn_deviation], 3)
            deviation = deviation + ratio * float(np.abs(step).sum())
            self.reckoned.append(T_run_base)
            stamp_ns = _START_NS + round(row * _STEP_S * 1e9)
            T_local_base = planar.between(T_run_local, T_run_base)
            self.atlas.add_local(stamp_ns, planar.to_transform(T_local_base))
            self.atlas.add(stamp_ns, planar.to_transform(T_run_base), name, np.diag(deviation**2))
            scan = world.scan(pose, stamp_ns)
            self.atlas.observe(Observation(stamp_ns=stamp_ns, scan=scan), None)
        for number in range(session + 1):
            self.atlas.close_session(number, MapLayers(), Trajectory.empty())
        self.faults = self.atlas.finish()
        return self

    def errors_m(
        self, true: NDArray[np.float64], T_map_world: Planar, *, is_online: bool = False
    ) -> NDArray[np.float64]:
        """Return the distance of every pose (N,) from where it should be in the map."""
        found = self.atlas.online if is_online else self.atlas.trajectory
        return _apart_m(found.positions_m, true, T_map_world)

    def drifted_m(self, true: NDArray[np.float64], T_map_world: Planar) -> NDArray[np.float64]:
        """Return the same of the poses (N,) as the atlas got them, without any loop."""
        return _apart_m(np.array(self.reckoned), true, T_map_world)

    def loops_off_m(self, true: NDArray[np.float64]) -> list[float]:
        """Return how far off every loop is that was accepted at the end, of true poses (N, 3).

        That is the error of the motion that it measured, wherever the run lies.
        """
        graph = self.atlas.fuse_maps().pose_graph
        if graph is None:
            return []
        T_world_node = true[np.searchsorted(self.atlas.trajectory.stamps_ns, graph.stamps_ns)]
        ends, T_from_to = graph.edges[graph.is_loop], graph.T_from_to[graph.is_loop]
        due = [planar.between(*T_world_node[pair]) for pair in ends]
        return [
            float(np.linalg.norm(T[:2, 3] - motion[:2]))
            for T, motion in zip(T_from_to, due, strict=True)
        ]

    def of_kind(self, event: str) -> list[dict[str, Any]]:
        """Return the events of one kind."""
        return [one for one in self.events if one["event"] == event]

    def _note(self, event: str, stamp_ns: int, **fields: Any) -> None:
        self.events.append({"event": event, "stamp_ns": stamp_ns, **fields})


def _apart_m(
    positions: NDArray[np.float64], true: NDArray[np.float64], T_map_world: Planar
) -> NDArray[np.float64]:
    due = np.array([planar.compose(T_map_world, pose) for pose in true])
    return np.asarray(np.linalg.norm(positions[:, :2] - due[:, :2], axis=1))


def map_of(true: NDArray[np.float64]) -> Planar:
    """Return T_map_world of a run that begins its map at its first pose."""
    return planar.between(true[0], np.zeros(3))


def key_scan(world: World, T_world_base: Planar, stamp_ns: int = 0) -> KeyScan:
    """Return the scan at a pose."""
    scan = world.scan(T_world_base, stamp_ns)
    found = KeyScanner(RIG).make(Observation(stamp_ns=stamp_ns, scan=scan), Trail())
    assert found is not None
    return found


def plan_of(world: World, true: NDArray[np.float64]) -> FloorPlan:
    """Return the plan of a drive, in base at its first pose."""
    return draw([(planar.between(true[0], pose), key_scan(world, pose)) for pose in true])


def _measured(step: Planar, odometry: Odometry) -> Planar:
    measured = np.array(step)
    measured[:2] *= 1.0 + odometry.scale
    measured[2] += odometry.turn_rad_per_m * float(np.hypot(step[0], step[1]))
    return measured
