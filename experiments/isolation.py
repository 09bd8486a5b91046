"""What a process of its own costs a module, and what two of them gain on two cores.

    OPENBLAS_NUM_THREADS=1 python experiments/isolation.py

Colour and depth of 640x480 from the simulator, each observation made anew (as a source does) just
before it is tracked, inline and isolated in turn. Run it on a machine that is otherwise idle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from time import perf_counter, perf_counter_ns
from typing import Any

import cv2
import numpy as np
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from omegaconf import OmegaConf

from sceneslam.interfaces import SlamModule
from sceneslam.supervision.isolated import IsolatedModule
from sceneslam.supervision.limits import Limits
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig

FRAMES, ROUNDS = 90, 5
BOUND_MS = 0.2
MODULES = ("odometry", "rgbd", "depth", "laser")
PAIRS = (("depth", "depth"), ("rgbd", "depth"), ("rgbd", "laser"))


def main() -> None:
    """Print the table of costs, the speed-up of two modules, and the time of a start."""
    cv2.setNumThreads(1)
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        overrides = ["+scenario=bright_to_dark", *(f"+slam@slam.{key}={key}" for key in MODULES)]
        config: Any = OmegaConf.to_container(compose("config", overrides=overrides), resolve=True)
    source = instantiate(config["source"], _convert_="all")
    frames = list(islice(source, FRAMES))
    makes = {
        key: partial(instantiate, node, _convert_="all") for key, node in config["slam"].items()
    }
    limits = _limits(config["run"])
    print_costs(makes["odometry"], frames, source.rig, limits)
    print_speed_ups(makes, frames, source.rig, limits)


def print_costs(
    make: Callable[[], SlamModule], frames: Sequence[Observation], rig: Rig, limits: Limits
) -> None:
    """Print what tracking one observation takes, inline and isolated, round by round in turn."""
    began_s = perf_counter()
    isolated = IsolatedModule("slam.isolated", make, limits)
    isolated.activate(rig)
    print(f"start of a process, module built and activated: {perf_counter() - began_s:.2f} s")
    inline_ms, process_ms = [], []
    for _ in range(ROUNDS):
        inline_ms += _track(make(), frames, rig)
        process_ms += _track(isolated, frames, rig)
    isolated.close()
    print("\n| per observation [ms] | p5 | median | p95 |\n|---|---|---|---|")
    for name, costs_ms in (("inline", inline_ms), ("process", process_ms)):
        low, median, high = np.percentile(costs_ms, [5, 50, 95])
        print(f"| {name} | {low:.3f} | {median:.3f} | {high:.3f} |")
    extra_ms = np.median(process_ms) - np.median(inline_ms)
    holds = "holds" if extra_ms <= BOUND_MS else "FAILS"
    print(f"\nextra, median: {extra_ms:.3f} ms (bound {BOUND_MS} ms): {holds}")


def print_speed_ups(
    makes: Mapping[str, Callable[[], SlamModule]],
    frames: Sequence[Observation],
    rig: Rig,
    limits: Limits,
) -> None:
    """Print how much sooner two modules are done with the same frames side by side."""
    print(f"\n| two modules, {len(frames)} frames | first [s] | second [s] | both at once [s] | |")
    print("|---|---|---|---|---|")
    for pair in PAIRS:
        one_s, other_s = [_seconds([makes[key]], frames, rig, limits) for key in pair]
        both_s = _seconds([makes[key] for key in pair], frames, rig, limits)
        gain = (one_s + other_s) / both_s
        print(f"| {' + '.join(pair)} | {one_s:.2f} | {other_s:.2f} | {both_s:.2f} | {gain:.2f} x |")


def _seconds(
    makes: Sequence[Callable[[], SlamModule]],
    frames: Sequence[Observation],
    rig: Rig,
    limits: Limits,
) -> float:
    """Return how long isolated modules take for the frames, each frame given to all at once."""
    modules = [IsolatedModule("slam.isolated", make, limits) for make in makes]
    for module in modules:
        module.activate(rig)
    began_s = perf_counter()
    for frame in frames:
        for module in modules:
            module.submit(frame)
        for module in modules:
            module.collect()
    took_s = perf_counter() - began_s
    for module in modules:
        module.close()
    return took_s


def _track(module: SlamModule, frames: Sequence[Observation], rig: Rig) -> list[float]:
    """Return what each observation took [ms]."""
    module.activate(rig)
    costs_ms = []
    for frame in frames:
        assert frame.image_bgr is not None and frame.depth_m is not None
        fresh = replace(frame, image_bgr=frame.image_bgr.copy(), depth_m=frame.depth_m.copy())
        began_ns = perf_counter_ns()
        module.track(fresh)
        costs_ms.append((perf_counter_ns() - began_ns) / 1e6)
    return costs_ms


def _limits(run: dict[str, Any]) -> Limits:
    return Limits(**{name: run[name] for name in Limits.__slots__})


if __name__ == "__main__":
    main()
