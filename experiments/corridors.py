"""Write a synthetic CARMEN log of corridors that are driven several times, with its truth.

    python experiments/corridors.py doors|bare|periodic SEED FOLDER [LENGTH_M]

Walls have recesses: `doors` of random width, depth and place, `periodic` equal ones every 4 m,
`bare` one in half of the walls. FOLDER/corridors.clf is the log: 181 beams, 30 m, four scans a
second, wheels off by a scale and by a turn per metre. truth.tum says where the robot was, and
corridors.relations its motions every 5 m and from earlier visits of each place.
"""

from __future__ import annotations

import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.testing.floor_plans import Corner, Scanner, Wall, World, through
from sceneslam.types import planar
from sceneslam.types.trajectory import Trajectory

STYLES = "doors", "bare", "periodic"
WIDTH_M, STEP_M, STEP_S = 2.4, 0.12, 0.25
START_NS = 100 * 10**9
SCANNER = Scanner(beams=181, field_rad=np.pi, range_m=30.0, noise_m=0.015)
NO_RETURN = 81.83  # as a SICK laser's log has it
APART_M, AGAIN_M, LATER_M, VISITS = 5.0, 2.6, 40.0, 3  # of relations

Crossing = tuple[int, int]


def recesses(style: str, rng: np.random.Generator, length_m: float) -> list[tuple[float, ...]]:
    """Return start, end and depth [m] of every recess of a wall."""
    if style == "periodic":
        return [(at, at + 0.9, 0.2) for at in np.arange(2.0, length_m - 1.5, 4.0).tolist()]
    if style == "bare":
        at = rng.uniform(2.0, length_m - 3.0)
        return [(at, at + 0.9, 0.25)] if rng.random() < 0.5 else []
    found: list[tuple[float, ...]] = []
    end = rng.uniform(1.2, 7.0) + 0.9
    while end < length_m - 0.6:
        found.append((end - rng.choice([0.8, 0.9, 1.2]), end, rng.uniform(0.1, 0.35)))
        end += rng.uniform(1.2, 7.0) + 0.9
    return found


def wall(start: Corner, end: Corner, found: list[tuple[float, ...]]) -> list[Wall]:
    """Return a wall with its recesses, which go to the right of the way from start to end."""
    (x0, y0), (x1, y1) = start, end
    length_m = float(np.hypot(x1 - x0, y1 - y0))
    dx, dy = (x1 - x0) / length_m, (y1 - y0) / length_m
    corners = [(0.0, 0.0)]
    for first, last, depth in found:
        corners += [(first, 0.0), (first, depth), (last, depth), (last, 0.0)]
    line = [
        (x0 + along * dx + out * dy, y0 + along * dy - out * dx)
        for along, out in (*corners, (length_m, 0.0))
    ]
    return [(*a, *b) for a, b in pairwise(line)]


def around(x0: float, x1: float, y0: float, y1: float) -> list[tuple[Corner, Corner]]:
    """Return the sides of a rectangle, with its inside on the right."""
    corners = [(x0, y0), (x0, y1), (x1, y1), (x1, y0), (x0, y0)]
    return list(pairwise(corners))


def building(style: str, rng: np.random.Generator) -> tuple[list[Wall], list[float], list[float]]:
    """Return walls, and where the corridors' middles are in x and in y."""
    xs = [0.0, *rng.uniform(22.0, 45.0, 4).cumsum().tolist()]
    ys = [0.0, *rng.uniform(18.0, 36.0, 3).cumsum().tolist()]
    half = WIDTH_M / 2
    sides = [
        side
        for (x0, x1) in pairwise(xs)
        for (y0, y1) in pairwise(ys)
        for side in around(x0 + half, x1 - half, y0 + half, y1 - half)
    ]
    outside = around(xs[0] - half, xs[-1] + half, ys[0] - half, ys[-1] + half)
    sides += [(end, start) for start, end in outside]
    walls: list[Wall] = []
    for start, end in sides:
        length_m = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        walls += wall(start, end, recesses(style, rng, length_m))
    return walls, xs, ys


def route(
    xs: list[float], ys: list[float], rng: np.random.Generator, length_m: float
) -> list[Corner]:
    """Return a way over the crossings, by corridors that were driven least; no U-turns."""
    crossings = {(i, j) for i in range(len(xs)) for j in range(len(ys))}
    driven: Counter[frozenset[Crossing]] = Counter()
    way: list[Crossing] = [(0, 0)]
    total_m = 0.0
    while total_m < length_m:
        (i, j), before = way[-1], way[-2:-1]
        beside = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        options = [one for one in beside if one in crossings and one not in before]
        costs = [driven[frozenset(((i, j), one))] + rng.uniform(0.0, 1.5) for one in options]
        k, m = options[int(np.argmin(costs))]
        driven[frozenset(((i, j), (k, m)))] += 1
        total_m += abs(xs[k] - xs[i]) + abs(ys[m] - ys[j])
        way.append((k, m))
    print(f"{total_m:.0f} m; times that a corridor was driven: {sorted(driven.values())}")
    off = rng.uniform(-0.3, 0.3, (len(way), 2))
    return [(xs[i] + dx, ys[j] + dy) for (i, j), (dx, dy) in zip(way, off.tolist(), strict=True)]


def wheels(true: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the odometry (N, 3) of a drive: off by 1 %, 0.004 rad per metre, and noise."""
    scale, turn_per_m, gain = 1 + rng.normal(0, 0.01), rng.normal(0, 0.004), rng.normal(0, 0.01)
    poses = [np.zeros(3)]
    for before, after in pairwise(true):
        forward, left, turn = planar.between(before, after)
        moved = float(np.hypot(forward, left))
        forward = forward * scale + rng.normal(0, 0.01) * moved
        turn += turn * gain + turn_per_m * moved + rng.normal(0, 0.01) * abs(turn)
        turn += rng.normal(0, 0.02) * np.sqrt(moved * STEP_M)
        poses.append(planar.compose(poses[-1], np.array([forward, left, turn])))
    return np.array(poses)


def relations(true: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the pairs of poses that relations are of."""
    along_m = np.hypot(*np.diff(true[:, :2], axis=0, prepend=true[:1, :2]).T).cumsum()
    places = np.searchsorted(along_m, np.arange(0.0, along_m[-1], APART_M))
    pairs: list[tuple[int, int]] = list(pairwise(places.tolist()))
    for place in places:
        earlier = places[along_m[places] < along_m[place] - LATER_M]
        away_m = np.hypot(*(true[earlier, :2] - true[place, :2]).T)
        pairs += [(int(one), int(place)) for one in earlier[away_m < AGAIN_M][:VISITS]]
    return pairs


def main(arguments: list[str]) -> None:
    """Write the three files."""
    style, seed, folder = arguments[0], int(arguments[1]), Path(arguments[2])
    if style not in STYLES:
        sys.exit(f"error: {style!r}, allowed are {', '.join(STYLES)}")
    length_m = float(arguments[3]) if len(arguments) > 3 else 1900.0
    rng = np.random.default_rng(seed)
    walls, xs, ys = building(style, rng)
    true = through(route(xs, ys, rng, length_m), STEP_M)
    stamps_ns = START_NS + (np.arange(len(true)) * STEP_S * 1e9).astype(np.int64)
    world = World(walls, rng, SCANNER)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "corridors.clf").open("w") as file:
        for stamp_s, pose, odometry in zip(stamps_ns * 1e-9, true, wheels(true, rng), strict=True):
            ranges = world.scan(pose).ranges_m
            beams = " ".join(f"{one:.2f}" for one in np.where(ranges < np.inf, ranges, NO_RETURN))
            x, y, yaw = odometry
            at = f"{x:.4f} {y:.4f} {yaw:.5f}"
            file.write(f"FLASER {len(ranges)} {beams} {at} {at} {stamp_s:.3f} host {stamp_s:.3f}\n")
    T_world_base = np.array([planar.to_transform(pose) for pose in true])
    truth = Trajectory(stamps_ns=stamps_ns, T_world_base=T_world_base)
    truth.write_tum(folder / "truth.tum")
    with (folder / "corridors.relations").open("w") as file:
        for first, second in relations(true):
            x, y, yaw = planar.between(true[first], true[second])
            stamps = f"{stamps_ns[first] * 1e-9:.6f} {stamps_ns[second] * 1e-9:.6f}"
            file.write(f"{stamps} {x:.6f} {y:.6f} 0 0 0 {yaw:.6f}\n")
    print(f"{len(true)} scans, {len(walls)} walls: {folder}")


if __name__ == "__main__":
    main(sys.argv[1:])
