"""Fault injection into any source, for experiments on robustness."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.sources.changes.wrapped import Wrapped
from sceneslam.types import se3
from sceneslam.types.fault_plan import FaultPlan
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_least
from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform

SENSORS = tuple(sensor.field for sensor in Sensor)
FAULTS = ("dropout", "blackout", "nan", "clock", "duplicate", "disorder", "reset")


class FaultySource(Wrapped):
    """Passes on a source's observations and injects faults into random ones.

    `dropout`: one sensor is missing for `lasting_s`; `blackout`: all but odometry are. `nan`: the
    values of one sensor are NaN. `clock`: one stamp is off by up to `clock_jump_s`. `duplicate`:
    the observation is repeated. `disorder`: it comes after the next one. `reset`: odometry restarts
    at the identity.
    """

    def __init__(
        self,
        source: Source,
        faults: list[str],
        rate_ratio: float,
        lasting_s: float,
        clock_jump_s: float,
        seed: int,
        record: Path,
    ) -> None:
        check_least(0, lasting_s=lasting_s, clock_jump_s=clock_jump_s)
        super().__init__(source)
        self._seed = seed
        self._lasting_ns = round(lasting_s * 1e9)
        self._clock_jump_ns = round(clock_jump_s * 1e9)
        self._plan = FaultPlan(
            kinds=faults, known=FAULTS, rate_ratio=rate_ratio, seed=seed, record=record
        )

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations with the injected faults."""
        self._plan.begin_anew()
        late: Observation | None = None
        silent: dict[str, int] = {}  # sensor -> end of its silence [ns]
        self._T_new_odom: Transform | None = None  # new odometry frame after a reset
        for observation in self._source:
            stamp_ns = observation.stamp_ns
            rng = np.random.default_rng([self._seed, 1, stamp_ns % 2**64])
            fault = self._plan.strike(stamp_ns)
            silent |= dict.fromkeys(
                self._silenced(fault, observation, rng), stamp_ns + self._lasting_ns
            )
            struck = self._struck(fault, self._reset(fault, observation), rng)
            quiet = {name: None for name, until_ns in silent.items() if stamp_ns < until_ns}
            struck = replace(struck, **quiet)  # type: ignore[arg-type]
            if fault == "disorder" and late is None:
                late = struck
                continue
            yield struck
            if fault == "duplicate":
                yield struck
            if late is not None:
                yield late
                late = None
        if late is not None:
            yield late

    def _silenced(
        self, fault: str | None, observation: Observation, rng: np.random.Generator
    ) -> list[str]:
        """Return the sensors whose measurements a fault removes."""
        if fault == "blackout":
            return [name for name in SENSORS if name != "T_odom_base"]
        return [_any_sensor(observation, rng)] if fault == "dropout" else []

    def _reset(self, fault: str | None, observation: Observation) -> Observation:
        """Return the observation; after a reset, with odometry from the new origin."""
        T_odom_base = observation.T_odom_base
        if fault == "reset" and T_odom_base is not None:
            self._T_new_odom = se3.inverse(T_odom_base)
        if self._T_new_odom is None or T_odom_base is None:
            return observation
        return replace(observation, T_odom_base=self._T_new_odom @ T_odom_base)

    def _struck(
        self, fault: str | None, observation: Observation, rng: np.random.Generator
    ) -> Observation:
        if fault == "clock":
            off_ns = int(rng.integers(-self._clock_jump_ns, self._clock_jump_ns + 1))
            return replace(observation, stamp_ns=observation.stamp_ns + off_ns)
        if fault == "nan":
            return _without_numbers(observation, _any_sensor(observation, rng))
        return observation


def _any_sensor(observation: Observation, rng: np.random.Generator) -> str:
    """Return a random sensor of the observation."""
    present = [name for name in SENSORS if getattr(observation, name) is not None]
    return present[int(rng.integers(len(present)))] if present else SENSORS[0]


def _without_numbers(observation: Observation, name: str) -> Observation:
    """Return the observation with NaN for one sensor; an image (8 bit) becomes black."""
    value = getattr(observation, name)
    if name == "scan":
        blind = replace(value, ranges_m=np.full_like(value.ranges_m, np.nan))
        return replace(observation, scan=blind)
    if name == "image_bgr" or value is None:
        blind = None if value is None else np.zeros_like(value)
        return replace(observation, image_bgr=blind)
    return replace(observation, **{name: np.full_like(value, np.nan)})
