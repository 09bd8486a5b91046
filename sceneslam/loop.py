"""The loop of a run: one observation after the other through the bus, whatever happens."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from tqdm import tqdm

from sceneslam.bus.bus import Bus
from sceneslam.bus.events import EventLog
from sceneslam.bus.handover_log import log_uncertainty
from sceneslam.bus.live import run_live
from sceneslam.config.build import Parts
from sceneslam.interfaces import ResultSink, Sink
from sceneslam.types.errors import InputError, told
from sceneslam.types.maps import HybridMap, PointLayer
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor
from sceneslam.types.run import RunResult, Timings
from sceneslam.types.truth import GroundTruth

_BAR_S = 0.5  # between two updates of the progress bar
_LINE_S = 10.0  # the same where it is written into a file
_log = logging.getLogger(__name__)


class Loop:
    """Feeds the bus and the sinks; `faults` says what went wrong on the way."""

    def __init__(self, parts: Parts, folder: Path, title: str) -> None:
        self.faults: list[str] = []
        self.is_interrupted = False
        self.truth: GroundTruth | None = None
        self._result: RunResult | None = None
        self._parts, self._title = parts, title
        self._log = EventLog(folder / "events.jsonl")
        self._events_written = 0
        self._observed_ns: list[int] = []
        self._dropped = 0
        self._covariances = np.zeros((0, 6, 6))
        self._began_s, self._wall_s = perf_counter(), 0.0
        self._bus = Bus(
            detector=parts.detector,
            modules=parts.modules,
            scenes=parts.scenes,
            policy=parts.policy,
            rig=parts.rig,
            atlas=parts.atlas,
            log=self._log,
            catch_up_steps=parts.run.catch_up_steps,
        )
        self._sinks: dict[str, Sink] = {}
        for key, sink in parts.sinks.items():
            self._open_sink(key, sink, folder)

    def run(self) -> None:
        """Feed all observations; an error or Ctrl-C ends the run, not the program."""
        try:
            self._feed()
        except KeyboardInterrupt:
            self.is_interrupted = True
            self.faults.append(f"stopped after {len(self._observed_ns)} observations; saved so far")
        except InputError as error:
            self.faults.append(str(error))
        except BaseException as error:
            _log.info("unexpected error", exc_info=error)
            self.faults.append(f"unexpected {told(error)}; saved so far, traceback in the log")
        self._wall_s = perf_counter() - self._began_s

    def close(self) -> None:
        """Shut everything down, in reverse order, and gather what was wrong."""
        if self._bus.state == "terminate":
            self.faults.append(self._why_over())
        self._bus.close(self._last_ns())
        has_odometry = Sensor.ODOMETRY in self._parts.rig.sensors
        self._covariances = self._parts.atlas.covariances(has_odometry)
        log_uncertainty(self._log, self._parts.atlas, self._covariances)
        if not len(self._parts.atlas.online) and not self.faults:
            self.faults.append(self._why_no_pose())
        self.faults += self._parts.source.faults
        if self._observed_ns:  # else it may have to be rendered first, for nothing
            self._read_truth()
        for key in list(self._sinks):
            self._close_sink(key)
        self._log.close()
        if self._log.fault:
            self.faults.append(self._log.fault)

    def result(self) -> RunResult:
        """Return everything the run produced, once it is closed."""
        if self._result is None:
            self._result = self._gather()
        return self._result

    def _gather(self) -> RunResult:
        atlas, bus = self._parts.atlas, self._bus
        return RunResult(
            observed_ns=np.array(self._observed_ns, np.int64),
            trajectory=atlas.trajectory,
            online=atlas.online,
            covariances=self._covariances,
            modules=atlas.pose_modules,
            sessions=atlas.sessions,
            map=self._fused(),
            events=self._log.events,
            dropped=self._dropped,
            timings=Timings(
                detector_us=np.array(bus.detector_us),
                bus_us=np.array(bus.bus_us),
                module_ms={key: np.array(runner.track_ms) for key, runner in bus.runners.items()},
                wall_s=self._wall_s,
            ),
        )

    def _fused(self) -> HybridMap:
        """Return the one map, an empty one where it cannot be had: the trajectory is worth more."""
        try:
            return self._parts.atlas.fuse_maps()
        except Exception as error:
            _log.info("the maps could not be fused", exc_info=error)
            self.faults.append(f"the maps could not be fused: {told(error)}")
            nothing = PointLayer(points=np.zeros((0, 3), np.float32))
            return HybridMap(points=nothing, point_modules=np.zeros(0, np.uint8), modules=())

    def _feed(self) -> None:
        observations = islice(self._parts.source, self._parts.run.max_observations)
        first = next(observations, None)  # a simulator renders, a bag is indexed: not our time
        if first is None:
            return
        self._began_s = perf_counter()
        with self._progress() as self._bar:
            if self._parts.run.mode == "live":
                self._dropped = run_live(chain([first], observations), self._step)
                self._log.add("dropped", self._last_ns(), count=self._dropped)
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
            mininterval=_BAR_S if sys.stderr.isatty() else _LINE_S,
            disable=not self._parts.run.progress,
        )

    def _step(self, observation: Observation) -> bool:
        """Feed one observation; return whether the run goes on."""
        self._bus.step(observation)
        self._observed_ns.append(observation.stamp_ns)
        if self._sinks:
            self._write(observation)
        self._bar.update()
        return self._bus.state != "terminate"

    def _write(self, observation: Observation) -> None:
        """Give the sinks the observation with its pose, and the events since the last one."""
        T_map_base = self._parts.atlas.pose_at(observation.stamp_ns)
        events = self._log.since(self._events_written)
        self._events_written += len(events)
        for key, sink in list(self._sinks.items()):
            try:
                sink.write(observation, T_map_base, self._bus.active)
                for event in events:
                    sink.write_event(event)
            except Exception as error:
                self._drop_sink(key, error)

    def _read_truth(self) -> None:
        try:
            self.truth = self._parts.source.ground_truth()
        except InputError as error:
            self.faults.append(f"no ground truth: {error}")

    def _open_sink(self, key: str, sink: Sink, folder: Path) -> None:
        try:
            sink.open(self._parts.rig, folder)
        except Exception as error:
            _log.info("sinks.%s", key, exc_info=error)
            raise InputError(f"sinks.{key} could not be opened: {told(error)}") from error
        self._sinks[key] = sink

    def _close_sink(self, key: str) -> None:
        try:
            sink = self._sinks[key]
            if self.truth is not None:
                sink.write_truth(self.truth)
            if isinstance(sink, ResultSink):
                sink.write_result(self.result())
            sink.close()
        except Exception as error:
            self._drop_sink(key, error)

    def _drop_sink(self, key: str, error: Exception) -> None:
        """Go on without a sink that cannot write."""
        _log.info("sinks.%s", key, exc_info=error)
        self.faults.append(f"sinks.{key} stopped writing: {told(error)}")
        del self._sinks[key]

    def _last_ns(self) -> int:
        return self._observed_ns[-1] if self._observed_ns else 0

    def _why_over(self) -> str:
        whats: Sequence[str] = [e["what"] for e in self._log.events if e["event"] == "fault"]
        return f"no module is left for scene {self._bus.scene or '(none)'}: {whats[-1]}"

    def _why_no_pose(self) -> str:
        if not self._observed_ns:
            return "no pose: the source gave no observation"
        if self._bus.state == "init" or not self._bus.scene:
            return "no pose: no scene was confirmed (policy.first_confirm_window_s, detector)"
        return f"no pose: module {self._bus.active} was lost from the first observation on"
