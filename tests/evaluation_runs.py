"""Made-up runs for the tests of evaluation: a robot that drives a loop and changes modules."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import select
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.types import se3
from sceneslam.types.maps import GridLayer, HybridMap, PointLayer
from sceneslam.types.run import Event, RunResult, Timings
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
SETTINGS = EvaluationSettings(
    association_gap_s=0.01,
    rpe_interval_s=1.0,
    segment_m=2.0,
    correct_limit_m=0.25,
    correct_limit_ratio=0.0,
    correct_limit_rad=0.1745,
    coverage_min_ratio=0.9,
    drawn_threshold=None,
    scenes={},
)


def stamps(count: int, start_ns: int = START_NS) -> NDArray[np.int64]:
    return start_ns + PERIOD_NS * np.arange(count, dtype=np.int64)


def loop(count: int, start_ns: int = START_NS) -> Trajectory:
    """An oval of 4 m by 2 m, once around, heading along the path."""
    angle = 2 * np.pi * np.arange(count) / max(count, 1)
    poses = [
        se3.from_xy_yaw(2 * np.sin(a), 1 - np.cos(a), np.arctan2(np.sin(a), 2 * np.cos(a)))
        for a in angle
    ]
    return Trajectory(
        stamps_ns=stamps(count, start_ns),
        T_world_base=np.array(poses).reshape(-1, 4, 4),
    )


def moved(trajectory: Trajectory, T_a_world: NDArray[np.float64]) -> Trajectory:
    return Trajectory(
        stamps_ns=trajectory.stamps_ns, T_world_base=T_a_world @ trajectory.T_world_base
    )


def shaken(trajectory: Trajectory, sigma_m: float, seed: int = 1) -> Trajectory:
    T_world_base = trajectory.T_world_base.copy()
    rng = np.random.default_rng(seed)
    T_world_base[:, :3, 3] += rng.normal(0, sigma_m, (len(trajectory), 3))
    return Trajectory(stamps_ns=trajectory.stamps_ns, T_world_base=T_world_base)


def happened(event: str, stamp_ns: int, **fields: Any) -> Event:
    """One line of events.jsonl; `from_` is the key `from`."""
    return {"event": event, "stamp_ns": stamp_ns, **{k.rstrip("_"): v for k, v in fields.items()}}


def switch_events(
    stamp_ns: int, since_ns: int, from_: str = "rgbd", to: str = "laser"
) -> list[Event]:
    handover = {
        "session": 1,
        "kind": "cold",
        "from_ns": stamp_ns,
        "T_map_local": np.eye(4).tolist(),
        "jump_m": 0.5,
        "jump_rad": 0.25,
        "gap_s": 0.75,
    }
    return [
        happened("scene", stamp_ns, scene="Dark", previous="Bright", since_ns=since_ns),
        happened("state", stamp_ns, from_="run", to="switch", reason="scene"),
        happened("decision", stamp_ns, scene="Dark", from_=from_, to=to, reason="scene"),
        happened("handover", stamp_ns, module=to, **handover),
        happened("cost", stamp_ns, module=to, handover_ms=3.5),
    ]


def first_events() -> list[Event]:
    at = START_NS
    return [
        happened("scene", at, scene="Bright", previous=None, since_ns=at),
        happened("decision", at, scene="Bright", from_=None, to="rgbd", reason="first"),
        happened("tracking", at, module="rgbd", status="tracking"),
    ]


def votes(count: int, dark_from: int) -> list[Event]:
    values = 80 - 50 * np.tanh((np.arange(count) - dark_from) / 6.0)
    return [
        happened("vote", stamp_ns, value=value, scene="Bright" if value > 100 else "Dark")
        for stamp_ns, value in zip(stamps(count).tolist(), values.tolist(), strict=True)
    ]


def hybrid_map(points: int = 3000) -> HybridMap:
    rng = np.random.default_rng(0)
    cloud = rng.uniform([-3, -1, 0], [3, 3, 2], (points, 3)).astype(np.float32)
    wall = rng.integers(0, 2, points).astype(bool)
    cloud[wall, 1] = -1.0
    log_odds = np.zeros((80, 120), np.float32)
    log_odds[10:70, 10:110] = -2.0
    log_odds[[10, 69], 10:110] = 3.0
    return HybridMap(
        points=PointLayer(points=cloud),
        point_modules=(cloud[:, 0] > 0).astype(np.uint8),
        modules=("rgbd", "laser"),
        grid=GridLayer(log_odds=log_odds, resolution_m=0.05, origin_xy_m=(-3.0, -1.5)),
    )


def empty_map() -> HybridMap:
    return HybridMap(
        points=PointLayer(points=np.zeros((0, 3), np.float32)),
        point_modules=np.zeros(0, np.uint8),
        modules=(),
    )


def timings(count: int) -> Timings:
    cost = np.linspace(10, 30, count)
    return Timings(
        detector_us=cost, bus_us=2 * cost, module_ms={"rgbd": cost, "laser": cost / 3}, wall_s=8.0
    )


def switched_run(count: int = 200, true_at: int = 80, decided_at: int = 100) -> RunResult:
    """A run that is exact but for 1 mm of noise, and changes to `laser` at `decided_at`."""
    return RunResult(
        observed_ns=stamps(count),
        trajectory=shaken(loop(count), 0.001),
        online=shaken(loop(count), 0.001),
        covariances=np.zeros((count, 6, 6)),
        modules=["rgbd"] * decided_at + ["laser"] * (count - decided_at),
        sessions=[],
        map=hybrid_map(),
        events=[
            *first_events(),
            *votes(count, true_at),
            *switch_events(int(stamps(count)[decided_at]), int(stamps(count)[true_at])),
        ],
        timings=timings(count),
    )


def true_loop(count: int = 200, true_at: int = 80) -> GroundTruth:
    """The truth of `switched_run`, in a frame of its own."""
    T_gt_map = se3.exp(np.array([3.0, -2.0, 0.5, 0.1, -0.2, 2.0]))
    changes = [SceneChange(stamp_ns=START_NS, scene="Bright")]
    changes.append(SceneChange(stamp_ns=int(stamps(count)[true_at]), scene="Dark"))
    return GroundTruth(trajectory=moved(loop(count), T_gt_map), scenes=tuple(changes))


def poseless_run(observed: int = 0) -> RunResult:
    none = np.zeros(0)
    return RunResult(
        observed_ns=stamps(observed),
        trajectory=Trajectory.empty(),
        online=Trajectory.empty(),
        covariances=np.zeros((0, 6, 6)),
        modules=[],
        sessions=[],
        map=empty_map(),
        events=[],
        timings=Timings(detector_us=none, bus_us=none, module_ms={}, wall_s=0.0),
    )


def relabel(run: RunResult, index: slice, module: str) -> RunResult:
    """Let `module` have given the poses at `index`."""
    modules = list(run.modules)
    modules[index] = [module] * len(modules[index])
    return replace(run, modules=modules)


def shift_from(run: RunResult, index: int, T_map_map: NDArray[np.float64]) -> RunResult:
    """Move all poses from `index` on, as a bad hand-over does."""
    T_world_base = run.trajectory.T_world_base.copy()
    T_world_base[index:] = T_map_map @ T_world_base[index:]
    trajectory = Trajectory(stamps_ns=run.trajectory.stamps_ns, T_world_base=T_world_base)
    return replace(run, trajectory=trajectory)


def without(run: RunResult, gone: slice | NDArray[np.int64]) -> RunResult:
    """Take poses away."""
    kept = np.delete(np.arange(len(run.trajectory)), gone)
    modules = [run.modules[k] for k in kept]
    return replace(run, trajectory=select(run.trajectory, kept), modules=modules)


def part_of(run: RunResult, index: slice | NDArray[np.int64]) -> RunResult:
    """Let there have been only the observations at `index`, each with its pose."""
    kept = np.arange(len(run.trajectory))[index]
    part = without(run, np.setdiff1d(np.arange(len(run.trajectory)), kept))
    return replace(part, observed_ns=run.observed_ns[kept])
