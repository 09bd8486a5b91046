"""Random starts in a saved map: found soon, at the right place, and never at a wrong one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import FloorPlan, join
from sceneslam.atlas.places.localizer import LocalizationEvent, Look, MapLocalizer
from sceneslam.experiments.one_map.drive import key_scan, plan_of
from sceneslam.testing.floor_plans import FLAT_TOUR, Scanner, Wall, World, through
from sceneslam.types import planar, se3
from sceneslam.types.planar import Planar
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform
from sceneslam.views.view import LandmarkView, PlacedView
from sceneslam.views.view_finder import ViewFinder

_STEP_M, _STEP_RAD, _STEP_S = 0.1, 0.2, 0.2  # half a metre, or a radian, per second
_WRONG_M, _WRONG_RAD = 0.5, 0.2
_CLEAR_M = 0.35  # a robot keeps so far from walls


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
        """Return the share that was found in the right place."""
        return (self.found - self.wrong) / self.count


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
    world, errors, wrong = World(walls, rng, finder), [], 0
    for _ in range(count):
        off = _start(plan, world, true[0], within_s)
        if off is None:
            continue
        distance_m, angle_rad = float(np.hypot(off[0], off[1])), abs(float(off[2]))
        if distance_m > _WRONG_M or angle_rad > _WRONG_RAD:
            wrong += 1
        else:
            errors.append([distance_m, angle_rad])
    return _starts(count, errors, wrong)


def camera_starts(
    saved: SavedMap,
    drive: SavedMap,
    camera: Camera,
    due: Callable[[int], Transform],
    *,
    within_s: float,
) -> Starts:
    """Start at every view that a drive kept, and look for it in another run's map by views alone.

    `due` returns the true T_map_base (4, 4) at a stamp [ns] of the drive.
    """
    finder = ViewFinder(camera, saved.views())
    looks = [
        Look(
            stamp_ns=view.stamp_ns,
            T_run_base=T_node @ view.T_submap_base,
            view=_seen_again(view, camera),
        )
        for T_node, submap in zip(drive.T_map_node, drive.submaps, strict=True)
        for view in submap.views
    ]
    errors, wrong = [], 0
    for number, first in enumerate(looks):
        localizer = MapLocalizer(join([]), finder)
        for look in looks[number:]:
            if look.stamp_ns - first.stamp_ns > round(within_s * 1e9):
                break
            if localizer.compare([look]) is LocalizationEvent.FOUND:
                assert localizer.T_map_run is not None
                off = se3.inverse(due(look.stamp_ns)) @ localizer.T_map_run @ look.T_run_base
                distance_m = float(np.linalg.norm(off[:3, 3]))
                angle_rad = float(se3.rotation_angle_rad(off))
                if distance_m > _WRONG_M or angle_rad > _WRONG_RAD:
                    wrong += 1
                else:
                    errors.append([distance_m, angle_rad])
                break
    return _starts(len(looks), errors, wrong)


def _seen_again(view: PlacedView, camera: Camera) -> LandmarkView:
    """Return what the camera saw when a view was kept."""
    points_cam = se3.apply(
        se3.inverse(camera.T_base_cam), view.landmarks.points_base.astype(np.float64)
    )
    return LandmarkView(
        stamp_ns=view.stamp_ns,
        rays=(points_cam[:, :2] / points_cam[:, 2:]).astype(np.float32),
        descriptors=view.landmarks.descriptors,
        depth_m=points_cam[:, 2].astype(np.float32),
        landmarks=view.landmarks,
    )


def _starts(count: int, errors: list[list[float]], wrong: int) -> Starts:
    worst = np.max(errors, axis=0, initial=0.0) if errors else np.zeros(2)
    return Starts(
        count=count,
        found=len(errors) + wrong,
        wrong=wrong,
        worst_m=float(worst[0]),
        worst_rad=float(worst[1]),
    )


def _start(plan: FloorPlan, world: World, T_world_map: Planar, within_s: float) -> Planar | None:
    """Return by how much a start was found beside the truth, None where it was not found."""
    localizer, latest = MapLocalizer(plan), list[Look]()
    pose = start = _free_pose(world)
    for step in range(round(within_s / _STEP_S) + 1):
        T_run_base = planar.between(start, pose)
        scan = key_scan(world, pose, round(step * _STEP_S * 1e9))
        T_run = planar.to_transform(T_run_base)
        latest.append(Look(stamp_ns=scan.stamp_ns, T_run_base=T_run, scan=scan))
        is_found = (
            localizer.is_due(latest[-1]) and localizer.compare(latest) is LocalizationEvent.FOUND
        )
        if is_found and localizer.T_map_run is not None:
            T_map_base = planar.from_transform(localizer.T_map_run @ T_run)
            return planar.between(planar.between(T_world_map, pose), T_map_base)
        pose = _driven_on(world, pose)
    return None


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
