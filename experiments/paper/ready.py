"""Prints what the start of a module takes in a fresh process, as JSON.

python -m sceneslam.experiments.paper.ready slam.bright +scenario=bright_to_dark
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from itertools import islice
from time import perf_counter

from hydra import compose, initialize_config_module

from sceneslam.config.component import ComponentBuilder
from sceneslam.config.resolve import resolved
from sceneslam.interfaces import SlamModule, Source
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

_IMAGES = 30  # within which a pose has to come


def measure(key: str, overrides: Sequence[str]) -> dict[str, float]:
    """Return the seconds until a module is built, and until its first pose.

    Its libraries are loaded on the way, if this process has not loaded them yet. Reading and
    decoding of the observations is not counted.
    """
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        builder = ComponentBuilder(resolved(compose("config", overrides=list(overrides))))
    source = builder.make("source", Source)
    observations, rig = list(islice(source, _IMAGES)), source.rig
    began_s = perf_counter()
    module = builder.make(key, SlamModule)
    module.activate(rig)
    module.set_pose(se3.identity())
    built_s = perf_counter() - began_s
    for observation in observations:
        if module.track(observation).status is not TrackingStatus.LOST:
            return {"built_s": built_s, "first_pose_s": perf_counter() - began_s}
    return {"built_s": built_s, "first_pose_s": float("inf")}


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], sys.argv[2:])))
