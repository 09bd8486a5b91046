"""The results of a run in memory: the input of evaluation, figures and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NewType

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.maps import HybridMap
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

BRIDGED = ""  # the module of a pose that no module gave
HANDOVERS = ("cold", "warm", "rewind")  # how a pose can pass from module to module
# A program and its arguments: code, that only the command line can allow.
Command = NewType("Command", list[str])
Note = Callable[..., None]  # is told an event: its kind, `stamp_ns`, and its own keys
Event = Mapping[str, Any]  # one line of events.jsonl: `event` (kind), `stamp_ns`, and its own keys


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionStart:
    """The first pose of a session in the trajectory."""

    row: int  # of the trajectory
    session: int
    module: str
    stamp_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session:
    """One activation of one module."""

    index: int
    module: str  # its key in `slam`
    T_map_local: Transform  # the paper's T_conversion, as revised
    trajectory: Trajectory  # T_local_base, as revised


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyMoment:
    """The camera image at a change of scene or module."""

    stamp_ns: int
    events: Sequence[Event]  # the changes; empty: the first image
    image_bgr: NDArray[np.uint8]  # (h, w, 3), small


@dataclass(frozen=True, slots=True, kw_only=True)
class SlowPose:
    """A pose of a live run with large latency, and the parts of it."""

    stamp_ns: int
    latency_ms: float  # from the stamp to the pose
    # `arriving`: until the observation was available; `waiting`: for the previous one; then each
    # part of its processing.
    parts_ms: Mapping[str, float]
    cpu_ms: float  # CPU time of the thread; the rest of the time it waited
    beside: Sequence[str]  # parallel computations of other threads for the modules


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Timings:
    """Wall-clock times; not part of the deterministic output."""

    detector_us: NDArray[np.float64]  # per observation
    bus_us: NDArray[np.float64]  # per observation, all but detector and module
    module_ms: Mapping[str, NDArray[np.float64]]  # per observation that the module tracked
    wall_s: float  # the whole loop, reading included
    latency_ms: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros(0)
    )  # live: stamp to pose
    slowest: Sequence[SlowPose] = ()  # live, the slowest first


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunResult:
    """Everything the bus and the atlas produced."""

    observed_ns: NDArray[np.int64]  # stamps of all observations fed
    trajectory: Trajectory  # T_map_base, with what modules corrected afterwards
    online: Trajectory  # the same stamps, as reported at the time
    covariances: NDArray[np.float64]  # (N, 6, 6) of `trajectory`, in base, translation first
    modules: Sequence[str]  # per pose: key of the module that gave it, "" where it was bridged
    sessions: Sequence[Session]
    map: HybridMap
    events: Sequence[Event]
    timings: Timings
    # Stamp -> what the module lacked; None: not kept.
    missing: Mapping[int, str] | None = field(default_factory=dict)
    dropped: int = 0  # observations that live mode skipped
    dropped_images: int = 0  # those of them with an image
    moments: Sequence[KeyMoment] = ()  # ordered by stamp
