"""One hostile program beside a healthy module: how it was stopped, and what it left behind."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import numpy as np

from sceneslam.modules.slam.odometry import Odometry
from sceneslam.modules.slam.process.module import ProcessSlam
from sceneslam.supervision.ending import MARK
from sceneslam.supervision.limits import Limits
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, ModuleError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor

from .hostile import plan

PROGRAM = Path(__file__).with_name("hostile.py")
RIG = Rig(sensors=frozenset({Sensor.ODOMETRY}))
STEPS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """What became of one program."""

    seed: int
    kind: str
    moment: str
    sentence: str  # with which it was stopped; "" where it was not
    late_s: float  # how long after its deadline the call returned
    harm: tuple[str, ...]  # to anything else


def observe(index: int) -> Observation:
    """Return an observation of a robot that drives straight on."""
    return Observation(stamp_ns=(index + 1) * 10**8, T_odom_base=se3.from_xy_yaw(0.1 * index, 0, 0))


def run_case(seed: int, limits: Limits) -> Case:
    """Run a program until it is stopped; a module of ours gets the same observations."""
    kind, moment, _ = plan(seed)
    before = _open_files()
    sentence, late_s, harm = "", 0.0, []
    healthy = Odometry()
    healthy.activate(RIG)
    # -S -I: without site packages it starts in a third of the time
    command = [sys.executable, "-S", "-I", str(PROGRAM), str(seed)]
    module = ProcessSlam(command=command, late_max_s=1.0, limits=limits, closes_loops=False)
    asked_s = monotonic()
    deadline_s = limits.start_deadline_s
    try:
        for call in _calls(module):
            is_step = call.__name__ in ("step", "set_scene")
            deadline_s = limits.step_deadline_s if is_step else limits.start_deadline_s
            asked_s = monotonic()
            call()
    except (ModuleError, ConfigError) as error:
        sentence, late_s = str(error), monotonic() - asked_s - deadline_s
    except Exception as error:
        harm.append(f"raised {type(error).__name__}: {error}")
    module.note_failure()
    for index in range(STEPS):
        T_local_base = healthy.track(observe(index)).T_local_base
        if not np.allclose(T_local_base, se3.from_xy_yaw(0.1 * index, 0, 0)):
            harm.append(f"the module beside it is off at {index}")
    left = _marked()
    harm += [f"the process {pid} is left" for pid in left]
    if _open_files() != before:
        harm.append(f"{_open_files() - before} files are left open")
    return Case(
        seed=seed, kind=kind, moment=moment, sentence=sentence, late_s=late_s, harm=tuple(harm)
    )


def _calls(module: ProcessSlam) -> Iterator[Callable[[], object]]:
    """Yield every call of a session."""

    def greet() -> object:
        return module.requires

    def activate() -> None:
        module.activate(RIG)

    def set_scene() -> None:
        module.set_scene("Bright")

    yield from (greet, activate, set_scene)
    for index in range(STEPS):

        def step(index: int = index) -> object:
            return module.track(observe(index))

        yield step
    yield from (module.get_trajectory, module.get_map)


def _open_files() -> int:
    return len([*Path("/proc/self/fd").iterdir()])


def _marked() -> list[int]:
    """Return the processes that programs of this process started and that do not end."""
    found = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        pid = int(path.parent.name)
        try:
            is_ours = str(PROGRAM).encode() in (path.parent / "cmdline").read_bytes()
            if is_ours and f"{MARK}=".encode() in path.read_bytes() and not _ends(pid):
                found.append(pid)
        except OSError:
            continue
    return found


def _ends(pid: int) -> bool:
    """Tell whether a process that was killed is gone within a second."""
    handle = os.pidfd_open(pid)
    arrivals = select.poll()
    arrivals.register(handle, select.POLLIN)
    try:
        return bool(arrivals.poll(1000.0))
    finally:
        os.close(handle)
