"""Fault injection into any SLAM module, for experiments on robustness."""

from __future__ import annotations

import os
import resource
import signal
from dataclasses import replace
from pathlib import Path
from time import sleep

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import SlamModule
from sceneslam.types import se3
from sceneslam.types.fault_plan import FaultPlan
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.ranges import check_least
from sceneslam.types.rig import Rig
from sceneslam.types.trajectory import Trajectory

from .local import WrappedModule

IN_ANY_PROCESS = ("raise", "nan", "jump", "silence")
# With run.isolation=process only; else the main process would fail.
IN_ITS_OWN_PROCESS = ("hang", "kill", "memory", "stop")
FAULTS = (*IN_ANY_PROCESS, *IN_ITS_OWN_PROCESS)
_HANG_S = 3600.0
_GULP = 1 << 22  # numbers of 8 bytes


class FaultyModule(WrappedModule):
    """Passes all calls on to `module`, and injects faults at random observations.

    `silence`: it reports LOST for `lasting_s`. `jump`: its poses are off by `jump_m` in a random
    direction until the next activation, without any report.
    """

    _system: SlamModule

    def __init__(
        self,
        module: SlamModule,
        faults: list[str],
        rate_ratio: float,
        lasting_s: float,
        jump_m: float,
        seed: int,
        record: Path,
    ) -> None:
        check_least(0, lasting_s=lasting_s, jump_m=jump_m)
        self._system, self._jump_m = module, jump_m
        self._lasting_ns = round(lasting_s * 1e9)
        self._plan = FaultPlan(
            kinds=faults, known=FAULTS, rate_ratio=rate_ratio, seed=seed, record=record
        )
        self._silent_until_ns: int | None = None
        self._T_wrong_local = se3.identity()

    def activate(self, rig: Rig) -> None:
        """Start a session without active faults."""
        self._silent_until_ns, self._T_wrong_local = None, se3.identity()
        self._system.activate(rig)

    def set_pose(self, T_map_local: se3.Transform) -> None:
        """Set T_map_local (4, 4) [m]."""
        self._system.set_pose(T_map_local)

    def track(self, observation: Observation) -> Tracking:
        """Return the module's result, unless a fault is active."""
        fault = self._plan.strike(observation.stamp_ns)
        if fault in ("raise", *IN_ITS_OWN_PROCESS):
            getattr(self, f"_{fault}")()
        if fault == "silence":
            self._silent_until_ns = observation.stamp_ns + self._lasting_ns
        if fault == "jump":
            self._T_wrong_local = self._off(observation.stamp_ns)
        tracking = self._system.track(observation)
        T_local_base = self._T_wrong_local @ tracking.T_local_base
        if fault == "nan":
            T_local_base = np.full((4, 4), np.nan)
        is_silent = (
            self._silent_until_ns is not None and observation.stamp_ns < self._silent_until_ns
        )
        status = TrackingStatus.LOST if is_silent else tracking.status
        return replace(tracking, T_local_base=T_local_base, status=status)

    def get_trajectory(self) -> Trajectory:
        """Return the module's trajectory, without faults."""
        return self._system.get_trajectory()

    def _off(self, stamp_ns: int) -> se3.Transform:
        direction = np.random.default_rng([stamp_ns % 2**64]).normal(size=3)
        shift = self._jump_m * direction / np.linalg.norm(direction)
        return se3.from_parts(np.eye(3), shift)

    def _raise(self) -> None:
        raise RuntimeError("a fault on purpose")

    def _hang(self) -> None:
        sleep(_HANG_S)

    def _kill(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def _stop(self) -> None:
        os.kill(os.getpid(), signal.SIGSTOP)

    def _memory(self) -> None:
        """Allocate memory up to the process's limit; without a limit, raise at once."""
        hoard: list[NDArray[np.float64]] = []
        while resource.getrlimit(resource.RLIMIT_DATA)[0] != resource.RLIM_INFINITY:
            hoard.append(np.ones(_GULP))
        raise MemoryError("a fault on purpose, without a limit to reach")
