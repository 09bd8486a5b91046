"""Random starts in a saved map: found soon, at the right place, and never at a wrong one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.places.floor_plan import FloorPlan
from sceneslam.atlas.places.localizer import LocalizationEvent, Look, MapLocalizer
from sceneslam.atlas.submaps.collector import Known
from sceneslam.experiments.one_map.drive import key_scan, plan_of
from sceneslam.testing.floor_plans import FLAT_TOUR, Scanner, Wall, World, through
from sceneslam.types import planar, se3
from sceneslam.types.observation import Observation
from sceneslam.types.planar import Planar
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.views.placed_views import are_alike

_STEP_M, _STEP_RAD, _STEP_S = 0.1, 0.2, 0.2  # half a metre, or a radian, per second
_WRONG_M, _WRONG_RAD = 0.5, 0.2
_CLEAR_M = 0.35  # a robot keeps so far from walls
_LIT_GREY = 80.0  # mean of an image in the light: the detector's threshold


@dataclass(frozen=True, slots=True, kw_only=True)
class Starts:
    """How many of so many starts were found, and how well."""

    count: int
    found: int
    wrong: int  # found elsewhere than they were
    worst_m: float  # of those at the right place
    worst_rad: float

    @property
    def found_ratio(self) -> float:
        """Return the share that was found in the right place; 1 of none."""
        return (self.found - self.wrong) / self.count if self.count else 1.0


def together(parts: Sequence[Starts]) -> Starts:
    """Return the starts of several drives as one."""
    return Starts(
        count=sum(part.count for part in parts),
        found=sum(part.found for part in parts),
        wrong=sum(part.wrong for part in parts),
        worst_m=max(part.worst_m for part in parts),
        worst_rad=max(part.worst_rad for part in parts),
    )


def random_starts(
    walls: Sequence[Wall],
    mapper: Scanner,
    finder: Scanner,
    *,
    count: int,
    within_s: float,
    seed: int,
) -> Starts:
    """Map the flat with one scanner, and start at random places in it with another."""
    rng = np.random.default_rng(seed)
    true = through(FLAT_TOUR)
    plan = plan_of(World(walls, rng, mapper), true)
    world = World(walls, rng, finder)
    offs = [_start(plan, world, true[0], within_s) for _ in range(count)]
    return _starts(
        count, [(float(np.hypot(*off[:2])), abs(float(off[2]))) for off in offs if off is not None]
    )


class StoryStarts:
    """Starts at random instants of a story, in the map of another, with all that it measured.

    Poses are those of the run, as reported then, seen from the start. A start shares geometry with
    the map if its camera comes to where it sees what a view of the map shows.
    """

    def __init__(
        self,
        saved: SavedMap,
        rig: Rig,
        online: Trajectory,
        due: Callable[[int], Transform],
        *,
        count: int,
        within_s: float,
        seed: int,
    ) -> None:
        """Draw the starts. `due` returns the true T_map_base (4, 4) at a stamp [ns]."""
        self._saved, self._rig, self._due = saved, rig, due
        self._seen = np.reshape([T_map_cam for T_map_cam, _ in saved.views()], (-1, 4, 4))
        self._within_ns = round(within_s * 1e9)
        self._poses = dict(zip(online.stamps_ns.tolist(), online.T_world_base, strict=True))
        late = online.stamps_ns[-1] - self._within_ns
        drawn = np.random.default_rng(seed).choice(
            online.stamps_ns[online.stamps_ns <= late], count
        )
        self._waiting = sorted(drawn.tolist(), reverse=True)
        self._under_way: list[_Start] = []
        self._ended: list[_Start] = []

    def observe(self, observation: Observation) -> None:
        """Take the next observation of the story."""
        stamp_ns = observation.stamp_ns
        pose = self._poses.get(stamp_ns)
        if pose is None:
            return
        while self._waiting and self._waiting[-1] <= stamp_ns:
            self._waiting.pop()
            start = _Start(
                self._saved, self._rig, pose, observation, is_shared=self._shares(stamp_ns)
            )
            self._under_way.append(start)
        for start in self._under_way:
            start.observe(observation, pose, self._due)
        is_over = [
            start.off is not None or stamp_ns - start.begun_ns >= self._within_ns
            for start in self._under_way
        ]
        self._ended += compress(self._under_way, is_over)
        self._under_way = [
            start for start, over in zip(self._under_way, is_over, strict=True) if not over
        ]

    def _shares(self, begun_ns: int) -> bool:
        """Tell whether a start comes to where its camera sees what a view of the map shows."""
        ended_ns = begun_ns + self._within_ns
        camera = self._rig.camera
        assert camera is not None
        T_true = [
            self._due(ns) @ camera.T_base_cam for ns in self._poses if begun_ns <= ns <= ended_ns
        ]
        return bool(are_alike(np.array(T_true), self._seen).any())

    def found(self, *, is_lit: bool, is_shared: bool) -> Starts:
        """Return what became of the starts in the light or the dark, that share geometry or not."""
        kind = (is_lit, is_shared)
        ended = [start for start in self._ended if (start.is_lit, start.is_shared) == kind]
        return _starts(len(ended), [start.off for start in ended if start.off is not None])


class _Start:
    """One start, and by how much it was found beside the truth."""

    def __init__(
        self,
        saved: SavedMap,
        rig: Rig,
        T_online_start: Transform,
        first: Observation,
        *,
        is_shared: bool,
    ) -> None:
        self.is_shared = is_shared
        self.begun_ns, self._T_online_start = first.stamp_ns, T_online_start
        self.is_lit = first.image_bgr is not None and float(first.image_bgr.mean()) >= _LIT_GREY
        self.off: tuple[float, float] | None = None  # m, rad
        self._T_start_base = se3.identity()
        self._mapper = Mapper(rig, known=self._known, note=_unheard, loaded=saved)

    def observe(
        self, observation: Observation, T_online_base: Transform, due: Callable[[int], Transform]
    ) -> None:
        self._T_start_base = se3.inverse(self._T_online_start) @ T_online_base
        self._mapper.observe(observation, None)
        if self._mapper.is_placed:
            T_map_base = self._mapper.T_map_run @ self._T_start_base
            off = se3.inverse(due(observation.stamp_ns)) @ T_map_base
            self.off = float(np.linalg.norm(off[:3, 3])), float(se3.rotation_angle_rad(off))

    def _known(self, _: int) -> Known:
        return Known(T_map_base=self._T_start_base, session=0, module="run", covariance=None)


def _unheard(*_: object, **__: object) -> None:
    """Take no notice of an event."""


def _starts(count: int, offs: Sequence[tuple[float, float]]) -> Starts:
    """Return the starts, of which some were found with these errors [m, rad]."""
    right = [off for off in offs if off[0] <= _WRONG_M and off[1] <= _WRONG_RAD]
    worst = np.max(right, axis=0) if right else np.zeros(2)
    return Starts(
        count=count,
        found=len(offs),
        wrong=len(offs) - len(right),
        worst_m=float(worst[0]),
        worst_rad=float(worst[1]),
    )


def _start(plan: FloorPlan, world: World, T_world_map: Planar, within_s: float) -> Planar | None:
    """Return by how much a start was found beside the truth, None where it was not found."""
    localizer, latest = MapLocalizer(plan), list[Look]()
    drive = short_drive(world, within_s)
    for step, pose in enumerate(drive):
        T_run_base = planar.between(drive[0], pose)
        scan = key_scan(world, pose, round(step * _STEP_S * 1e9))
        T_run = planar.to_transform(T_run_base)
        latest.append(Look(stamp_ns=scan.stamp_ns, T_run_base=T_run, scan=scan))
        is_found = (
            localizer.is_due(latest[-1]) and localizer.compare(latest) is LocalizationEvent.FOUND
        )
        if is_found and localizer.T_map_run is not None:
            T_map_base = planar.from_transform(localizer.T_map_run @ T_run)
            return planar.between(planar.between(T_world_map, pose), T_map_base)
    return None


def short_drive(world: World, within_s: float) -> list[Planar]:
    """Return the poses (3,) of a drive from a random place, every 0.2 s."""
    poses = [_free_pose(world)]
    for _ in range(round(within_s / _STEP_S)):
        poses.append(_driven_on(world, poses[-1]))
    return poses


def _free_pose(world: World) -> Planar:
    """Return a random pose in the first room, away from all walls."""
    while True:
        x, y = world.rng.uniform([0.4, 0.4], [5.6, 4.6])
        pose = np.array([x, y, world.rng.uniform(-np.pi, np.pi)])
        if _clearance_m(world, pose) > _CLEAR_M and not _is_in_furniture(x, y):
            return pose


def _is_in_furniture(x: float, y: float) -> bool:
    return bool((1 <= x <= 1.8 and 1 <= y <= 2) or (4 <= x <= 4.6 and 3.2 <= y <= 4.2))


def _driven_on(world: World, pose: Planar) -> Planar:
    """Return the next pose: straight on where there is room, else a turn."""
    ahead = planar.compose(pose, np.array([_STEP_M, 0.0, 0.05]))
    if _clearance_m(world, ahead) > _CLEAR_M:
        return ahead
    return planar.compose(pose, np.array([0.0, 0.0, _STEP_RAD]))


def _clearance_m(world: World, pose: Planar) -> float:
    """Return the distance to the nearest wall."""
    walls = np.array(world.walls, np.float64)
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    share = ((pose[:2] - start) * along).sum(axis=1) / (along**2).sum(axis=1)
    nearest = start + np.clip(share, 0.0, 1.0)[:, None] * along
    return float(np.linalg.norm(nearest - pose[:2], axis=1).min())
