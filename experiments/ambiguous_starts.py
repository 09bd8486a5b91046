"""Print how many places of the flat look like another one to a narrow view.

    python experiments/ambiguous_starts.py [COUNT [SEED]]

Short drives as `+experiment=one_map` has them (57 degrees, 4.5 m, 3 s), and an observer that knows
every wall and its own motion exactly: it searches the flat for a second pose, elsewhere or turned,
and counts the beams of all scans that this pose predicts to 10 cm.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.plan_search import is_apart
from sceneslam.experiments.one_map.relocalization import short_drive
from sceneslam.testing.floor_plans import DEPTH_LIKE, World, flat
from sceneslam.types import planar
from sceneslam.types.planar import Planar

WITHIN_S, CELL_M, HEADINGS = 3.0, 0.1, 120
ALIKE_M = 0.1  # of a beam
EMPTY_M = DEPTH_LIKE.range_m + 0.3  # what a beam without a return counts as
BEAMS = slice(None, None, 8)
CANDIDATES, STEPS = 8, np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.05]])
SHARES = 0.99, 0.97, 0.95, 0.9, 0.85, 0.8

Floats = NDArray[np.float64]


class Flat:
    """All walls, and the ranges from every cell of 10 cm in every direction."""

    def __init__(self) -> None:
        walls = flat()
        self._world = World(walls, np.random.default_rng(0), DEPTH_LIKE)
        width_m, height_m = np.array(walls).reshape(-1, 2).max(axis=0)
        xs, ys = np.arange(CELL_M / 2, width_m, CELL_M), np.arange(CELL_M / 2, height_m, CELL_M)
        self.cells = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        self._columns, degrees = len(xs), np.radians(np.arange(360.0))
        around_m = np.array([self._world.hit(np.array([*at, 0.0]), degrees) for at in self.cells])
        farthest_m = around_m.max(axis=1)
        is_free = np.isfinite(farthest_m) & (farthest_m > 2.0)  # neither outside nor in furniture
        self._ranges = np.where(is_free[:, None], _bounded(around_m), np.inf)

    def ranges(self, pose: Planar, angles_rad: Floats) -> Floats:
        """Return what beams (N,) measure at a pose."""
        return _bounded(self._world.hit(pose, angles_rad))

    def near(self, positions: Floats, angles_rad: Floats) -> Floats:
        """Return the ranges (N, M) in directions (M,) from the cells of positions (N, 2)."""
        columns, rows = np.floor(positions / CELL_M).astype(np.int64).T
        count = len(self.cells) // self._columns
        is_in = (columns >= 0) & (columns < self._columns) & (rows >= 0) & (rows < count)
        cells = np.where(is_in, rows * self._columns + columns, 0)
        found = self._ranges[cells[:, None], np.round(np.degrees(angles_rad)).astype(int) % 360]
        return np.where(is_in[:, None], found, np.inf)


class Drive:
    """The scans of a short drive."""

    def __init__(self, world: World) -> None:
        poses = short_drive(world, WITHIN_S)
        self.start = poses[0]
        self._moved = [planar.between(self.start, pose) for pose in poses]
        scans = [world.scan(pose) for pose in poses]
        self._angles = scans[0].angles_rad[BEAMS]
        self._ranges = [_bounded(scan.ranges_m[BEAMS]) for scan in scans]

    def rival(self, walls: Flat) -> float:
        """Return the largest share of the beams that a pose elsewhere predicts."""
        refined = (self._refined(walls, start) for start in self._candidates(walls))
        shares = [
            (self._off_m(walls, one) < ALIKE_M).mean()
            for one in refined
            if is_apart(one, self.start)
        ]
        return float(max(shares, default=0.0))

    def _candidates(self, walls: Flat) -> list[Planar]:
        """Return the best poses of a search over all cells, none near another."""
        headings = np.arange(HEADINGS) * (2 * np.pi / HEADINGS)
        off_m = np.stack([self._off_from_cells(walls, yaw) for yaw in headings.tolist()], axis=1)
        found: list[Planar] = []
        for row in np.argsort(off_m, axis=None):
            cell, heading = divmod(int(row), HEADINGS)
            pose = np.array([*walls.cells[cell], headings[heading]])
            if all(is_apart(pose, one) for one in (self.start, *found)):
                found.append(pose)
            if len(found) == CANDIDATES:
                break
        return found

    def _off_from_cells(self, walls: Flat, yaw: float) -> Floats:
        """Return the mean difference (N,) of a few scans from what is due at each cell."""
        off_m = np.zeros(len(walls.cells))
        for moved, ranges_m in list(zip(self._moved, self._ranges, strict=True))[::5]:
            positions = walls.cells + planar.rotation(yaw) @ moved[:2]
            due_m = walls.near(positions, yaw + moved[2] + self._angles)
            off_m += np.minimum(np.abs(due_m - ranges_m), 0.5).mean(axis=1)
        return off_m

    def _refined(self, walls: Flat, pose: Planar) -> Planar:
        """Return the best pose nearby: steps along each axis, halved where none is better."""
        scale, least = 1.0, self._misfit(walls, pose)
        while scale > 0.05:
            tried = [pose + scale * sign * step for step in STEPS for sign in (1.0, -1.0)]
            misfits = [self._misfit(walls, one) for one in tried]
            best = int(np.argmin(misfits))
            if misfits[best] < least:
                pose, least = tried[best], misfits[best]
            else:
                scale /= 2.0
        return pose

    def _misfit(self, walls: Flat, pose: Planar) -> float:
        return float(np.minimum(self._off_m(walls, pose), 0.3).mean())

    def _off_m(self, walls: Flat, pose: Planar) -> Floats:
        """Return by how much each beam of each scan differs."""
        due = [walls.ranges(planar.compose(pose, moved), self._angles) for moved in self._moved]
        return np.abs(np.array(due) - np.array(self._ranges))


def _bounded(ranges_m: Floats) -> Floats:
    return np.where(ranges_m < DEPTH_LIKE.range_m, ranges_m, EMPTY_M)


def main(arguments: list[str]) -> None:
    """Print a row per share of beams."""
    count = int(arguments[0]) if arguments else 100
    seed = int(arguments[1]) if len(arguments) > 1 else 100
    walls, world = Flat(), World(flat(), np.random.default_rng(seed), DEPTH_LIKE)
    rivals = np.array([Drive(world).rival(walls) for _ in range(count)])
    print("a second place explains at least [% of the beams],places of so many [%]")
    for share in SHARES:
        print(f"{share:.0%},{(rivals >= share).mean():.0%}")


if __name__ == "__main__":
    main(sys.argv[1:])
