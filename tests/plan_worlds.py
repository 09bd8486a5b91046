"""Floor plans made of walls, a laser in them, and drives whose odometry drifts."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sceneslam.atlas.atlas import Atlas
from sceneslam.scans.key_scan import KeyScan, line_normals
from sceneslam.types import planar
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Laser, Rig, Sensor
from sceneslam.types.trajectory import Trajectory

RIG = Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())
STEP_S = 0.2


def box(x0, y0, x1, y1):
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


def flat():
    """Return two different furnished rooms, 6 x 5 m and 4 x 4 m, with a door between."""
    outer = [(0, 0, 6, 0), (6, 0, 6, 1.5), (6, 2.5, 6, 5), (6, 5, 0, 5), (0, 5, 0, 0)]
    second = [(6, 0, 10, 0), (10, 0, 10, 4), (10, 4, 6, 4)]
    return outer + second + box(1, 1, 1.8, 2) + box(4, 3.2, 4.6, 4.2) + box(8, 2.6, 9, 3.2)


def twins():
    """Return two rooms that are the same but for their place, with a door to a corridor each."""
    walls = [(0, 0, 16, 0), (0, -2, 16, -2), (0, -2, 0, 0), (16, -2, 16, 0)][1:]
    for x in (0.0, 8.0):
        walls += [(x, 0, x, 4), (x, 4, x + 5, 4), (x + 5, 4, x + 5, 0), (x + 3, 0, x + 8, 0)]
        walls += [(x, 0, x + 2, 0), *box(x + 1, 2.5, x + 1.8, 3.2)]
    return walls


def corridor(length_m=40.0):
    """Return a bare corridor whose ends are out of sight."""
    return [(-length_m, -1, length_m, -1), (-length_m, 1, length_m, 1)]


@dataclass
class World:
    """Walls, and the noise of what looks at them."""

    walls: list
    rng: np.random.Generator
    beams: int = 270
    field_rad: float = 1.5 * np.pi
    range_m: float = 10.0
    noise_m: float = 0.01

    def scan(self, pose, stamp_ns=0):
        """Return the laser's scan at a planar pose."""
        angles = np.linspace(-self.field_rad / 2, self.field_rad / 2, self.beams)
        walls = np.array(self.walls, float)
        away = np.column_stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)])
        along, start = walls[:, 2:] - walls[:, :2], walls[:, :2] - pose[:2]
        with np.errstate(divide="ignore", invalid="ignore"):
            across = np.outer(away[:, 0], along[:, 1]) - np.outer(away[:, 1], along[:, 0])
            range_m = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / across
            share = np.outer(away[:, 1], start[:, 0]) - np.outer(away[:, 0], start[:, 1])
            share = share / across
        hit = np.where((range_m > 0) & (share >= 0) & (share <= 1), range_m, np.inf).min(axis=1)
        hit = hit + self.rng.normal(0.0, self.noise_m, self.beams)
        return LaserScan(
            stamp_ns=stamp_ns,
            ranges_m=np.where(hit < self.range_m, hit, np.inf).astype(np.float32),
            angle_min_rad=float(angles[0]),
            angle_step_rad=float(angles[1] - angles[0]),
            range_min_m=0.05,
            range_max_m=self.range_m,
        )

    def key_scan(self, pose):
        scan = self.scan(pose)
        seen = np.isfinite(scan.ranges_m)
        angles, ranges_m = scan.angles_rad[seen], scan.ranges_m[seen].astype(float)
        points = np.column_stack([ranges_m * np.cos(angles), ranges_m * np.sin(angles)])
        normals = line_normals(points, np.zeros(2))
        return KeyScan(stamp_ns=0, points=points, normals=normals, origin=np.zeros(2))

    def around(self, pose, turn_rad=1.5, scans=10):
        """Return the scans of a turn on the spot, with T_first_base."""
        yaws = np.linspace(0.0, turn_rad, scans)
        return [
            (np.array([0.0, 0.0, yaw]), self.key_scan(planar.compose(pose, np.array([0, 0, yaw]))))
            for yaw in yaws
        ]


def through(points, step_m=0.1):
    """Return the poses (N, 3) of a drive along straight lines, turning at the corners."""
    poses = []
    for (x0, y0), (x1, y1) in pairwise(points):
        yaw = np.arctan2(y1 - y0, x1 - x0)
        if poses:
            turn = planar.wrap(yaw - poses[-1][2])
            count = int(abs(turn) / 0.2)
            poses += [
                np.array([x0, y0, poses[-1][2] + turn / max(count, 1) * (i + 1)])
                for i in range(count)
            ]
        count = max(int(np.hypot(x1 - x0, y1 - y0) / step_m), 1)
        poses += [
            np.array([x0 + (x1 - x0) * i / count, y0 + (y1 - y0) * i / count, yaw])
            for i in range(count + 1)
        ]
    return np.array([[x, y, planar.wrap(yaw)] for x, y, yaw in poses])


FLAT_TOUR = [(0.6, 2.6), (3.0, 2.4), (3.2, 0.8), (5.4, 0.9), (5.4, 2.0), (7.4, 2.0), (7.3, 0.8),
             (9.3, 0.9), (9.4, 1.9), (5.3, 2.0), (2.9, 2.6), (3.0, 4.4), (0.7, 4.2),
             (0.6, 2.8)]  # fmt: skip


@dataclass
class Drive:
    """A run of an atlas through a world."""

    atlas: Atlas
    events: list = field(default_factory=list)
    faults: list = field(default_factory=list)

    def go(self, world, true, *, drift_ratio=0.0, turn_drift=0.0, sessions=1):
        """Drive along true poses (N, 3) by dead reckoning, in so many sessions of two modules."""
        self.atlas.open(RIG, self._note)
        T_run, before = np.zeros(3), true[0]
        current = -1
        covariance = np.diag([1e-6] * 6)
        for row, pose in enumerate(true):
            step = planar.between(before, pose)
            step[:2] *= 1.0 + drift_ratio
            step[2] += turn_drift * np.hypot(*step[:2])
            T_run, before = planar.compose(T_run, step), pose
            stamp_ns = 10**9 + round(row * STEP_S * 1e9)
            if row * sessions // len(true) != current:
                current = row * sessions // len(true)
                session = self.atlas.begin_session(f"m{current % 2}", planar.to_transform(T_run))
                T_map_local = T_run
            T_local_base = planar.to_transform(planar.between(T_map_local, T_run))
            self.atlas.add_local(stamp_ns, T_local_base)
            self.atlas.add(stamp_ns, planar.to_transform(T_run), f"m{current % 2}", covariance)
            scan = world.scan(pose, stamp_ns)
            self.atlas.observe(Observation(stamp_ns=stamp_ns, scan=scan))
        for number in range(session + 1):
            self.atlas.close_session(number, MapLayers(), Trajectory.empty())
        self.faults = self.atlas.finish()
        return self

    def errors_m(self, true, T_map_world):
        """Return the distance of every pose from the truth (N,), placed by T_map_world."""
        truth = np.array([planar.compose(T_map_world, pose) for pose in true])
        return np.linalg.norm(self.atlas.trajectory.positions_m[:, :2] - truth[:, :2], axis=1)

    def kinds(self):
        return [event["event"] for event in self.events]

    def _note(self, event, stamp_ns, **fields):
        self.events.append({"event": event, "stamp_ns": stamp_ns, **fields})


def start_of(true):
    """Return T_map_world of a run that begins its map at its first pose."""
    return planar.between(true[0], np.zeros(3))
