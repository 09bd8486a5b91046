"""Options of one group put where those of others stand: which fit together, and which do not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from sceneslam.experiments.mutants.bases import Base, bases

_SENSORS = {  # source -> what it has
    "two_rooms": "image depth odometry",
    "building": "image depth odometry",
    "tum_rgbd": "image depth",
    "rosbag": "image depth scan odometry",
    "mcap": "image depth scan odometry",
    "kitti": "points",
    "carmen": "scan odometry",
    "openloris": "odometry",
}
_NEEDS = {  # option -> alternatives, each of sensors that suffice
    "rgbd": ("image depth",),
    "laser": ("scan", "points", "depth"),
    "depth": ("depth",),
    "kiss_icp": ("points", "depth"),
    "odometry": ("odometry",),
    "grey_mean": ("image",),
    "manual": ("",),
    "one_scene": ("",),
}
_MODULES = ("rgbd", "laser", "depth", "kiss_icp", "odometry")
_DETECTORS = ("grey_mean", "manual", "one_scene")


@dataclass(frozen=True, slots=True, kw_only=True)
class Combination:
    """Options of every group."""

    overrides: tuple[str, ...]
    named: frozenset[str]  # keys, one of which has to be named; empty: they fit


def combinations(folder: Path) -> Iterator[Combination]:
    """Yield every detector and module with every source, each in both modes."""
    sources = {base.name: base for base in bases(folder) if base.part == "source"}
    modes = ("recording", "live")
    for source, detector, module, mode in product(sources, _DETECTORS, _MODULES, modes):
        lacking = [
            key
            for key, option in (("detector", detector), ("slam.only", module))
            if not _suffices(_SENSORS[source], _NEEDS[option])
        ]
        own = _of_source(sources[source])
        choices = (f"detector={detector}", f"slam@slam.only={module}", f"run={mode}")
        table = "+scenes={Bright:[only],Dark:[only]}"
        overrides = ("+scenario=single", *own, *choices, table)
        yield Combination(overrides=overrides, named=frozenset(lacking))


def _of_source(base: Base) -> list[str]:
    return [override for override in base.overrides if override.startswith("source")]


def _suffices(sensors: str, needs: tuple[str, ...]) -> bool:
    return any(set(need.split()) <= set(sensors.split()) for need in needs)
