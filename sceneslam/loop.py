"""The main loop of a run, which passes all observations to the bus and handles errors."""

from __future__ import annotations

import errno
import logging
import sys
from array import array
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import chain, islice
from time import perf_counter
from typing import Any

import numpy as np
from tqdm import tqdm

from sceneslam.atlas.guarded import covariances_of, fused_map_of
from sceneslam.atlas.save import save_map
from sceneslam.bus.bus import Bus
from sceneslam.config.build import RunParts
from sceneslam.config.settings import LIVE
from sceneslam.engine.live import LiveTally, Spent, StepInterrupt, run_live
from sceneslam.engine.open_sinks import OpenSinks
from sceneslam.engine.slowest import Stopwatch
from sceneslam.engine.steering import Operator
from sceneslam.evaluation.shortfalls import NO_POSE
from sceneslam.executors import executor
from sceneslam.interfaces import Live, LiveFeed, closes_own_loops
from sceneslam.keeping import Keeping
from sceneslam.moments import Moments
from sceneslam.results import Results
from sceneslam.sources.survey.preflight import preflight
from sceneslam.sources.survey.survey import Surveyed
from sceneslam.sources.survey.tally import Tally
from sceneslam.storage.events import log_uncertainty
from sceneslam.types.errors import InputError, text_of
from sceneslam.types.observation import Observation
from sceneslam.types.run import Event, RunResult, Timings
from sceneslam.types.truth import GroundTruth

_BAR_S = 0.5  # update period of the progress bar
_LINE_S = 10.0  # the same if it is written to a file
_log = logging.getLogger(__name__)


class RunLoop:
    """Passes observations to the bus and results to the sinks; `faults` lists errors."""

    def __init__(
        self, parts: RunParts, results: Results, say: Callable[[str], None] | None = None
    ) -> None:
        self._say = say  # prints messages before the run
        self._warnings: tuple[str, ...] = ()
        self._tally = Tally(parts.rig.sensors)
        self.is_interrupted = self._is_stepping = False
        self.truth: GroundTruth | None = None
        self._result: RunResult | None = None
        self._parts, self._title, self.faults = parts, results.title, results.faults
        self._keeping = Keeping(parts, results)
        self._log = self._keeping.events
        self._events_written = 0
        self._moments, self._events_seen = Moments(), 0
        self._observed_ns = array("q")
        self._live, self._watch = LiveTally(), Stopwatch()
        self._covariances = np.zeros((0, 6, 6))
        self._began_s, self._wall_s = perf_counter(), 0.0
        is_live = parts.run.mode == LIVE
        with ExitStack() as opened:  # closed again if anything cannot be opened
            opened.callback(self.close, is_saved=True)
            self._bus = Bus(
                detector=parts.detector,
                modules=parts.modules,
                scenes=parts.scenes,
                policy=parts.policy,
                rig=parts.rig,
                back_end=parts.atlas,
                log=self._log,
                catch_up_steps=parts.run.catch_up_steps,
                is_live=is_live,
            )
            opened.callback(self._bus.close, 0)
            self._operator = Operator(
                parts.detector.scenes,
                self._bus.select,
                parts.scenes,
                save_map,
                results.folder,
                self._log.add,
                executor("save", is_live=is_live),
            )
            closing = [key for key, module in parts.modules.items() if closes_own_loops(module)]
            is_one = len(closing) == len(parts.modules) == 1  # it recognizes its places itself
            opened.callback(parts.atlas.finish)
            parts.atlas.open(
                parts.rig, self._log.add, closing=closing, is_looking=not is_one, is_live=is_live
            )
            self._sinks = OpenSinks(self.faults)
            opened.callback(self._sinks.abandon)
            self._sinks.open(parts.sinks, parts.rig, results.folder)
            opened.pop_all()

    def run(self, is_stopped: Callable[[], bool]) -> None:
        """Process all observations; an error or Ctrl-C ends the run, not the program.

        `is_stopped` tells whether that was asked for: a module may have caught the Ctrl-C.
        """
        try:
            self._survey()
            self._feed(is_stopped)
        except KeyboardInterrupt as stop:
            self.is_interrupted, self._is_stepping = True, isinstance(stop, StepInterrupt)
            self.faults.append(f"stopped after {len(self._observed_ns)} observations; saved so far")
        except InputError as error:
            self.faults.append(str(error))
        except BaseException as error:
            _log.info("unexpected error", exc_info=error)
            self.faults.append(f"unexpected {text_of(error)}; saved so far, traceback in the log")
        self._wall_s = perf_counter() - self._began_s

    def finish(self) -> None:
        """Shut down everything but the sinks, in reverse order, and collect errors.

        Raises KeyboardInterrupt if a step still runs, since nothing can be saved beside it, unless
        it waits for a module: that is left out.
        """
        if self._is_stepping and not self._bus.leave_awaited(self._last_ns()):
            raise KeyboardInterrupt
        self.faults += self._without_module()
        self._operator.close(self._last_ns())
        self._bus.close(self._last_ns())
        self.faults += self._parts.atlas.finish()
        self._add_covariances()
        if not len(self._parts.atlas.online) and not self.faults:
            self.faults.append(f"{NO_POSE}{self._why_no_pose()}")
        self.faults += self._parts.source.faults
        self._keeping.finish()

    def read_truth(self) -> None:
        """Read the ground truth."""
        if not self._observed_ns:  # rendering it would be useless
            return
        try:
            self.truth = self._parts.source.ground_truth()
        except InputError as error:
            self.faults.append(f"no ground truth: {error}")
        except (Exception, SystemExit) as error:
            _log.info("no ground truth", exc_info=error)
            self.faults.append(f"no ground truth: {text_of(error)}")

    def close_sinks(self) -> None:
        """Pass the last events and the final results to the sinks, and close them."""
        self._write_events()
        self._sinks.close(self.truth, self.result)

    def close(self, *, is_saved: bool) -> None:
        """Close the journal; it is removed if the results are saved."""
        self._keeping.close(is_saved=is_saved)

    def result(self) -> RunResult:
        """Return all results of the closed run."""
        if self._result is None:
            self._result = self._gather()
        return self._result

    def _add_covariances(self) -> None:
        """Compute the trajectory's covariances, and log those where sessions begin."""
        atlas, wheels = self._parts.atlas, self._parts.rig.odometry
        self._covariances = covariances_of(atlas, self.faults.append, wheels=wheels)
        if len(self._covariances):
            log_uncertainty(self._log, atlas.session_starts(), self._covariances)

    def _gather(self) -> RunResult:
        atlas, bus = self._parts.atlas, self._bus
        return RunResult(
            observed_ns=np.array(self._observed_ns, np.int64),
            trajectory=atlas.trajectory,
            online=atlas.online,
            covariances=self._covariances,
            modules=atlas.pose_modules,
            sessions=atlas.sessions,
            map=fused_map_of(atlas, self.faults.append),
            events=self._log.events,
            missing=self._tally.missing,
            dropped=self._live.dropped,
            dropped_images=self._live.dropped_images,
            moments=tuple(self._moments.kept),
            timings=Timings(
                detector_us=np.array(bus.detector_us),
                bus_us=np.array(bus.bus_us),
                module_ms={key: np.array(runner.track_ms) for key, runner in bus.runners.items()},
                wall_s=self._wall_s,
                latency_ms=np.array(self._live.latencies_ms),
                slowest=self._live.slowest.poses,
            ),
        )

    def _survey(self) -> None:
        """Print the survey of the recording, with warnings."""
        source = self._parts.source
        try:
            found = source.survey() if isinstance(source, Surveyed) else None
        except (Exception, SystemExit) as error:  # errors of the input are reported when it is read
            _log.info("the source could not be surveyed", exc_info=error)
            return
        if found is None:
            return
        checked = preflight(found, self._parts.rig)
        self._warnings = checked.warnings
        for what in checked.warnings:
            self._log.add("warning", 0, what=what)
        if self._say is not None:
            self._say("\n".join([*checked.lines, *(f"warning: {one}" for one in checked.warnings)]))

    def _feed(self, is_stopped: Callable[[], bool]) -> None:
        source = self._parts.source
        observations = islice(source, self._parts.run.max_observations)
        if isinstance(source, Live) and source.live is not None:
            with self._progress() as self._bar:
                self._run_live(observations, source.live)
            return
        first = next(observations, None)  # rendering and indexing are not part of the run's time
        if first is None:
            return
        self._began_s = perf_counter()
        with self._progress() as self._bar:
            if self._parts.run.mode == LIVE:
                self._run_live(chain([first], observations), None)
                return
            for observation in chain([first], observations):
                if not self._step(observation):
                    return
                if is_stopped():
                    raise KeyboardInterrupt

    def _run_live(self, observations: Iterator[Observation], feed: LiveFeed | None) -> None:
        try:
            run_live(
                observations,
                self._step,
                self._note,
                settings=self._parts.run.live,
                feed=feed,
                tally=self._live,
                spent=self._spent,
            )
        finally:
            images = self._live.dropped_images
            self._log.add("dropped", self._last_ns(), count=self._live.dropped, images=images)

    def _note(self, event: Event) -> None:
        """Record an event of a live run's input."""
        fields = {key: value for key, value in event.items() if key not in ("event", "stamp_ns")}
        self._log.add(event["event"], event["stamp_ns"], **fields)
        self._write_events()  # before the observation that it concerns
        if event["event"] == "given_up":
            self.faults.append(f"the source was silent for {event['for_s']:g} s")

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
        """Process one observation; return whether the run continues."""
        watch = self._watch
        watch.restart()
        self._steer(observation.stamp_ns)
        watch.lap("operator")
        if self._operator.is_paused:
            self._write_events()
            return True
        self._bus.step(observation)
        watch.lap("bus")
        self._parts.atlas.observe(observation, self._bus.up_base)
        watch.lap("atlas")
        self._observed_ns.append(observation.stamp_ns)
        events = self._log.since(self._events_seen)
        self._events_seen += len(events)
        self._moments.look(observation, events)
        module = self._parts.modules.get(self._bus.active)
        self._tally.add(observation, () if module is None else module.requires)
        self._keeping.keep()
        if not self._keeping.has_room(len(self._observed_ns)):
            self._sinks.drop_files(OSError(errno.ENOSPC, "what is left is for the results"))
        watch.lap("files")
        if self._sinks:
            self._write(observation)
        watch.lap("sinks")
        self._bar.update()
        return self._bus.state != "terminate"

    def _spent(self) -> Spent:
        """Return the durations of the parts of the last step."""
        parts_ms, bus = dict(self._watch.parts_ms), self._bus
        if "bus" not in parts_ms:  # the run is paused
            return Spent(parts_ms=parts_ms)
        own_ms = {"detector": bus.detector_us[-1] / 1e3, "bus": bus.bus_us[-1] / 1e3}
        modules = f"modules ({bus.active or 'none'}, {bus.state})"
        parts_ms[modules] = parts_ms["bus"] - sum(own_ms.values())
        return Spent(parts_ms={**parts_ms, **own_ms}, cpu_ms=self._watch.cpu_ms, beside=bus.beside)

    def _steer(self, stamp_ns: int) -> None:
        """Execute the operators' commands since the last observation."""
        for command in self._sinks.commands():
            self._operator.obey(command, stamp_ns)
        self._operator.report(stamp_ns)

    def _write(self, observation: Observation) -> None:
        """Pass the observation with its pose to the sinks, then the events."""
        atlas = self._parts.atlas
        if self._sinks.show_maps and (moved := atlas.take_moved()) is not None:
            self._sinks.write_map(moved)
        T_map_base = atlas.pose_at(observation.stamp_ns)
        self._sinks.write(observation, T_map_base, atlas.last_covariance, self._bus.active)
        self._write_events()

    def _write_events(self) -> None:
        """Pass the events since the last call to the sinks."""
        events = self._log.since(self._events_written)
        self._events_written += len(events)
        self._sinks.write_events(events)

    def _last_ns(self) -> int:
        return self._observed_ns[-1] if self._observed_ns else 0

    def _without_module(self) -> list[str]:
        """Return for which scenes no module was left, and why: the run ended or was bridged."""
        scenes = dict(self._bus.unserved)
        if self._bus.state == "terminate":
            scenes[self._bus.scene or "(none)"] = self._log.last_fault
        return [f"no module is left for scene {scene}: {what}" for scene, what in scenes.items()]

    def _why_no_pose(self) -> str:
        if not self._observed_ns:
            return "the source gave no observation"
        if self._bus.state == "init" or not self._bus.scene:
            return "no scene was confirmed (policy.first_confirm_window_s, detector)"
        tried = [str(e["to"]) for e in self._log.events if e["event"] in ("decision", "refused")]
        names = " and ".join(dict.fromkeys(tried)) or self._bus.active or "none"
        said = f"module {names} was lost from the first observation on"
        said = f"{said}; {self._tally.words()}"
        return f"{said}. Most likely: {'; '.join(self._warnings)}" if self._warnings else said
