"""Real-time runs: source and bus in two threads, with a mailbox between them."""

from __future__ import annotations

import ctypes
import threading
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic_ns

from sceneslam.engine.mailbox import Mailbox, Waited
from sceneslam.engine.slowest import Slowest
from sceneslam.interfaces import LiveFeed
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.run import Event, SlowPose

_LOOK_S = 0.2  # interval of checks for Ctrl-C
_BEHIND_S = 1.0  # if a recording is read too slowly, its playback is delayed in steps of this
_LEAVE_S = 2.0  # wait for the source's thread to end; then it is abandoned
# Waits for the last step to end; together with saving less than the 10 s after which systemd and
# Docker kill what they have asked to stop.
_STEP_S = 4.0  # by itself
_RAISE_S = 1.0  # after KeyboardInterrupt was raised in it


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveSettings:
    """Timing of a live run, in seconds of the wall clock."""

    rate: float = 1.0  # playback rate of a recording; 2: twice as fast
    silent_after_s: float = 1.0  # time without an observation until the event `silent`
    end_after_s: float | None = None  # silence after which the run ends; None: never

    def __post_init__(self) -> None:
        if not 0.01 <= self.rate <= 100:
            raise ConfigError("rate", self.rate, "0.01 to 100")
        if not 0 < self.silent_after_s < float("inf"):
            raise ConfigError("silent_after_s", self.silent_after_s, "a number above 0 [s]")
        if self.end_after_s is not None and not self.end_after_s >= self.silent_after_s:
            allowed = f"null, or no less than silent_after_s ({self.silent_after_s:g}) [s]"
            raise ConfigError("end_after_s", self.end_after_s, allowed)


@dataclass(slots=True, kw_only=True)
class LiveTally:
    """Statistics of a live run's input."""

    dropped: int = 0  # observations that were replaced by newer ones
    dropped_images: int = 0  # of these, those with an image
    # from stamp to pose
    latencies_ms: array[float] = field(default_factory=lambda: array("d"))
    slowest: Slowest = field(default_factory=Slowest)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spent:
    """The durations of the parts of the last step; see SlowPose."""

    parts_ms: Mapping[str, float] = field(default_factory=dict)
    cpu_ms: float = 0.0
    beside: Sequence[str] = ()


class StepInterrupt(KeyboardInterrupt):
    """The end of a run whose last step did not return; if it does, it ends at once."""


def run_live(
    observations: Iterator[Observation],
    step: Callable[[Observation], bool],
    note: Callable[[Event], None],
    *,
    settings: LiveSettings,
    feed: LiveFeed | None = None,
    tally: LiveTally | None = None,
    spent: Callable[[], Spent] = Spent,
) -> LiveTally:
    """Run `step` on the observations in real time until it returns False; return statistics.

    `spent` is called after a step that is one of the slowest. A given `tally` is updated in place,
    and is valid also if the run is interrupted.

    Without a `feed` they are those of a recording, and paced by their stamps. `note` receives
    events of the input: `silent`, `returned`, `behind` (a recording is read too slowly and its
    playback delayed), and the feed's. Both functions run in the thread `bus`, the source in another
    one. Their exceptions are raised here; Ctrl-C ends both, after the current step. If that does
    not end within some seconds, or at another Ctrl-C, KeyboardInterrupt is raised in it, too;
    StepInterrupt is raised here if it goes on even then, as native code does.
    """
    run = _LiveRun(observations, step, note, settings=settings, feed=feed, spent=spent)
    run.tally = tally if tally is not None else run.tally
    return run.carry_out()


class _LiveRun:
    def __init__(
        self,
        observations: Iterator[Observation],
        step: Callable[[Observation], bool],
        note: Callable[[Event], None],
        *,
        settings: LiveSettings,
        feed: LiveFeed | None,
        spent: Callable[[], Spent],
    ) -> None:
        self._spent = spent
        self._observations, self._step, self._note = observations, step, note
        self._settings, self._feed = settings, feed
        self._mailbox, self._is_over = Mailbox(), threading.Event()
        self._has_stepped = threading.Event()  # set after the last step
        self.tally, self._errors = LiveTally(), list[BaseException]()
        self._lag_ns: int | None = None  # clock - stamp / rate, of the first observation
        self._last_ns = 0
        self._due_at_ns: dict[int, int] = {}  # stamp -> time from which the latency counts
        self._came_at_ns: dict[int, int] = {}  # stamp -> time of queueing
        self._behind_s = self._told_behind_s = 0.0  # delay of playback

    def carry_out(self) -> LiveTally:
        # A driver or a module that hangs does not keep the program running.
        source = threading.Thread(
            target=self._guard, args=(self._read,), name="source", daemon=True
        )
        bus = threading.Thread(target=self._step_all, name="bus", daemon=True)
        try:
            bus.start()
            source.start()  # no step before the bus is there to be waited for
            # Not Thread.join: interrupted, it takes the thread for ended (CPython 3.11).
            while not self._has_stepped.wait(_LOOK_S):
                continue
        finally:
            self._is_over.set()
            self._mailbox.close(is_emptied=True)
            if bus.ident is not None:
                self._await_last_step(bus.ident)
            if self._feed is not None:
                self._feed.close()
            if source.ident is not None:
                source.join(_LEAVE_S)
            self.tally.dropped = self._mailbox.dropped
            self.tally.dropped_images = self._mailbox.dropped_images
        if self._errors:
            raise self._errors[0]
        return self.tally

    def _await_last_step(self, thread: int) -> None:
        with suppress(KeyboardInterrupt):  # which waits no longer
            self._has_stepped.wait(_STEP_S)
        if self._has_stepped.is_set():
            return
        error = ctypes.py_object(KeyboardInterrupt)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), error)
        with suppress(KeyboardInterrupt):
            self._has_stepped.wait(_RAISE_S)
        if not self._has_stepped.is_set():
            raise StepInterrupt

    def _step_all(self) -> None:
        try:
            self._guard(self._work)
        finally:
            self._has_stepped.set()

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:
            self._errors.append(error)
        finally:
            self._mailbox.close()

    def _read(self) -> None:
        """Put every observation into the mailbox when it is due."""
        for observation in self._observations:
            if not self._feed and not self._await(observation):
                return
            self._came_at_ns[observation.stamp_ns] = monotonic_ns()
            self._mailbox.put(observation)
            if self._is_over.is_set():
                return

    def _await(self, observation: Observation) -> bool:
        """Wait until a recorded observation is due; return whether the run continues.

        If the recording is read too slowly, its playback is delayed from then on. Latency counts
        from when an observation is due, or from when it has been read if that is later.
        """
        elapsed_ns, now_ns = round(observation.stamp_ns / self._settings.rate), monotonic_ns()
        if self._lag_ns is None:
            self._lag_ns = now_ns - elapsed_ns
        behind_s = (now_ns - elapsed_ns - self._lag_ns) / 1e9
        if behind_s > _BEHIND_S:
            self._lag_ns = now_ns - elapsed_ns
            self._behind_s += behind_s
        self._due_at_ns[observation.stamp_ns] = max(elapsed_ns + self._lag_ns, now_ns)
        return not self._is_over.wait(max(-behind_s, 0.0))

    def _work(self) -> None:
        """Pass the observations of the mailbox to the bus."""
        silent_s, settings = 0.0, self._settings
        while True:
            taken = self._mailbox.take(settings.silent_after_s)
            self._tell_notices()
            if taken is Waited.END:
                break
            if taken is Waited.SILENCE:
                if not silent_s:
                    self._tell("silent", for_s=settings.silent_after_s)
                silent_s += settings.silent_after_s
                if settings.end_after_s is not None and silent_s >= settings.end_after_s:
                    self._tell("given_up", for_s=silent_s)
                    break
                continue
            assert isinstance(taken, Observation)
            self._last_ns = taken.stamp_ns
            if silent_s:
                self._tell("returned")
                silent_s = 0.0
            began_ns = monotonic_ns()
            if not self._step(taken):
                break
            self._count(taken, began_ns)
        self._is_over.set()

    def _count(self, taken: Observation, began_ns: int) -> None:
        """Record the latency of a pose, with its parts if it is one of the longest."""
        now_ns, stamp_ns = monotonic_ns(), taken.stamp_ns
        came_ns, due_ns = _taken(self._came_at_ns, stamp_ns), _taken(self._due_at_ns, stamp_ns)
        measured_ns = self._feed.measured_ns(taken) if self._feed else due_ns
        latency_ms = (now_ns - measured_ns) / 1e6
        self.tally.latencies_ms.append(latency_ms)
        if not self.tally.slowest.has_room(latency_ms):
            return
        spent = self._spent()
        waits = {"arriving": (came_ns - measured_ns) / 1e6, "waiting": (began_ns - came_ns) / 1e6}
        self.tally.slowest.add(
            SlowPose(
                stamp_ns=stamp_ns,
                latency_ms=latency_ms,
                parts_ms={**waits, **spent.parts_ms},
                cpu_ms=spent.cpu_ms,
                beside=spent.beside,
            )
        )

    def _tell_notices(self) -> None:
        for notice in self._feed.notices() if self._feed else ():
            self._note(notice)
        if self._behind_s > 2 * self._told_behind_s:  # not at every observation of a slow disk
            self._told_behind_s = self._behind_s
            self._tell("behind", by_s=self._behind_s)

    def _tell(self, event: str, **fields: object) -> None:
        self._note({"event": event, "stamp_ns": self._last_ns, **fields})


def _taken(at_ns: dict[int, int], stamp_ns: int) -> int:
    """Return the time of a stamp [ns]; remove it and all earlier ones, which were dropped."""
    found_ns = at_ns.get(stamp_ns, 0)
    for earlier_ns in [one for one in list(at_ns) if one <= stamp_ns]:
        del at_ns[earlier_ns]
    return found_ns
