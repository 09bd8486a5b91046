"""How well a module has held its pose so far."""

from __future__ import annotations

from sceneslam.bus.runner import Runner
from sceneslam.types.observation import Observation, Tracking, TrackingStatus


class Hold:
    """Follows one activation of a module: since when it is held, lost, or silent."""

    def __init__(self, *, silence_ns: int) -> None:
        self.status: TrackingStatus | None = None  # None until it was fed
        self.unheld_since_ns: int | None = None
        self.held_since_ns: int | None = None
        self.held_ns = 0  # how long it had held its pose without a break before that
        self._fed_ns: int | None = None  # when its sensors last spoke ...
        self._period_ns = silence_ns  # ... and how long after the time before; at first a guess

    @property
    def is_held(self) -> bool:
        """Tell whether the module holds its pose, as far as is known."""
        return self.held_since_ns is not None

    def ask(self, runner: Runner, observation: Observation) -> Tracking | None:
        """Return a module's answer where it holds its pose; raises ModuleError with the runner."""
        if not runner.can_use(observation):
            self.wait(observation.stamp_ns)
            return None
        tracking = runner.track(observation)
        return tracking if self.feed(tracking) else None

    def feed(self, tracking: Tracking) -> bool:
        """Take an answer; return whether the module holds its pose."""
        if self._fed_ns is not None:
            self._period_ns = tracking.stamp_ns - self._fed_ns
        self._fed_ns, self.status = tracking.stamp_ns, tracking.status
        if tracking.status is TrackingStatus.LOST:
            self._lose(tracking.stamp_ns)
            return False
        self.unheld_since_ns = None
        if self.held_since_ns is None:
            self.held_since_ns = tracking.stamp_ns
        return True

    def wait(self, stamp_ns: int) -> None:
        """Take note of an observation in which none of the module's sensors spoke."""
        if self._fed_ns is None or stamp_ns - self._fed_ns > 2 * self._period_ns:
            self._lose(stamp_ns)

    def _lose(self, stamp_ns: int) -> None:
        if self.unheld_since_ns is None:
            self.unheld_since_ns = stamp_ns
            held_since_ns, self.held_since_ns = self.held_since_ns, None
            self.held_ns = stamp_ns - held_since_ns if held_since_ns is not None else 0
