"""Carries a run out: builds the parts, feeds the bus, saves what came of it, whatever happens."""

from __future__ import annotations

import resource
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from sceneslam.atlas.save import save_map
from sceneslam.bus.bus import Bus
from sceneslam.bus.events import EventLog
from sceneslam.bus.live import run_live
from sceneslam.config.build import Parts, build
from sceneslam.config.provenance import save_config
from sceneslam.evaluation.metrics import Metrics, evaluate, write_metrics
from sceneslam.evaluation.report import write_report
from sceneslam.interrupts import termination_as_interrupt, uninterrupted
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.run import RunResult, Timings
from sceneslam.types.trajectory import Trajectory

_BAR_S = 0.5  # between two updates of the progress bar


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """A run that ended, one way or another; its folder is written."""

    metrics: Metrics
    trajectory: Trajectory
    faults: tuple[str, ...]  # what was wrong with the input or ended the run early


def run(
    config: Mapping[str, Any],
    folder: Path,
    *,
    title: str = "sceneslam",
    reference: Trajectory | None = None,
) -> Finished:
    """Run a resolved configuration and write its folder.

    Raises ConfigError or InputError where nothing could be run. What ends a run once it has begun
    (Ctrl-C, broken input, no module left) is in `faults`, and all that was computed is saved.
    """
    parts = build(config)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(parts.run.threads)
    with termination_as_interrupt():
        loop = _Loop(parts, folder, title)
        faults = loop.run()
        with uninterrupted():
            return _save(config, parts, folder, loop.result(), faults, reference)


class _Loop:
    """Feeds the bus one observation after the other."""

    def __init__(self, parts: Parts, folder: Path, title: str) -> None:
        self._parts, self._title = parts, title
        self._log = EventLog(folder / "events.jsonl")
        self._events_written = 0
        self._observed_ns: list[int] = []
        self._began_s, self._wall_s = perf_counter(), 0.0
        self._sinks = list(parts.sinks.values())
        for sink in self._sinks:
            sink.open(parts.rig, folder)
        self._bus = Bus(
            detector=parts.detector,
            modules=parts.modules,
            scenes=parts.scenes,
            policy=parts.policy,
            rig=parts.rig,
            atlas=parts.atlas,
            log=self._log,
        )

    def run(self) -> tuple[str, ...]:
        """Run to the end; return what was wrong."""
        faults: list[str] = []
        try:
            self._feed()
        except KeyboardInterrupt:
            faults.append(f"stopped after {len(self._observed_ns)} observations; saved so far")
        except InputError as error:
            faults.append(str(error))
        finally:
            self._wall_s = perf_counter() - self._began_s
            is_over = self._bus.state == "terminate"
            self._bus.close(self._last_ns())
            self._close_sinks()
            self._log.close()
        if is_over:
            whats = [event["what"] for event in self._log.events if event["event"] == "fault"]
            faults.append(f"no module is left for scene {self._bus.scene or '(none)'}: {whats[-1]}")
        if not len(self._parts.atlas.trajectory) and not faults:
            faults.append(self._why_no_pose())
        return (*faults, *self._parts.source.faults)

    def result(self) -> RunResult:
        """Return everything the run produced."""
        atlas, bus = self._parts.atlas, self._bus
        return RunResult(
            observed_ns=np.array(self._observed_ns, np.int64),
            trajectory=atlas.trajectory,
            modules=atlas.pose_modules,
            sessions=atlas.sessions,
            map=atlas.fuse_maps(),
            events=self._log.events,
            timings=Timings(
                detector_us=np.array(bus.detector_us),
                bus_us=np.array(bus.bus_us),
                module_ms={key: np.array(runner.track_ms) for key, runner in bus.runners.items()},
                wall_s=self._wall_s,
            ),
        )

    def _last_ns(self) -> int:
        return self._observed_ns[-1] if self._observed_ns else 0

    def _why_no_pose(self) -> str:
        if not self._observed_ns:
            return "no pose: the source gave no observation"
        if self._bus.state == "init":
            return "no pose: no scene was confirmed (policy.first_confirm_window_s, detector)"
        return f"no pose: module {self._bus.active} was lost from the first observation on"

    def _close_sinks(self) -> None:
        truth = self._parts.source.ground_truth() if self._sinks else None
        for sink in self._sinks:
            if truth is not None:
                sink.write_truth(truth)
            sink.close()

    def _feed(self) -> None:
        observations = islice(self._parts.source, self._parts.run.max_observations)
        first = next(observations, None)  # a simulator renders, a bag is indexed: not our time
        if first is None:
            return
        self._began_s = perf_counter()
        with self._progress() as self._bar:
            if self._parts.run.mode == "live":
                dropped = run_live(chain([first], observations), self._step)
                self._log.add("dropped", self._last_ns(), count=dropped)
                return
            for observation in chain([first], observations):
                if not self._step(observation):
                    return

    def _progress(self) -> Any:
        limits = [self._parts.run.max_observations, self._parts.source.length]
        return tqdm(
            total=min([limit for limit in limits if limit is not None], default=None),
            desc=self._title,
            unit="obs",
            mininterval=_BAR_S,
            disable=not self._parts.run.progress,
        )

    def _step(self, observation: Observation) -> bool:
        """Feed one observation; return whether the run goes on."""
        self._observed_ns.append(observation.stamp_ns)
        self._bus.step(observation)
        if self._sinks:
            self._write(observation)
        self._bar.update()
        return self._bus.state != "terminate"

    def _write(self, observation: Observation) -> None:
        """Give the sinks the observation with its pose, and the events since the last one."""
        T_map_base = self._parts.atlas.pose_at(observation.stamp_ns)
        events = self._log.since(self._events_written)
        self._events_written += len(events)
        for sink in self._sinks:
            sink.write(observation, T_map_base, self._bus.active)
            for event in events:
                sink.write_event(event)


def _save(
    config: Mapping[str, Any],
    parts: Parts,
    folder: Path,
    result: RunResult,
    faults: tuple[str, ...],
    reference: Trajectory | None,
) -> Finished:
    """Write the run's folder, what matters most first."""
    result.trajectory.write_tum(folder / "trajectory.tum")
    for session in result.sessions:
        name = f"trajectory_{session.index}_{session.module}.tum"
        session.trajectory.write_tum(folder / name)
    save_map(result.map, folder / "map")
    versions = save_config(config, folder / "config.yaml")
    truth = parts.source.ground_truth()
    metrics = evaluate(
        result,
        truth,
        settings=parts.evaluation,
        peak_rss_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        reference=reference,
    )
    write_metrics(folder / "metrics.json", metrics)
    write_report(
        folder,
        result,
        truth,
        metrics,
        threshold=parts.threshold,
        config_yaml=(folder / "config.yaml").read_text(),
        versions=versions,
        faults=faults,
        reference=reference,
        value_label=parts.detector.quantity,
    )
    return Finished(metrics=metrics, trajectory=result.trajectory, faults=faults)
