"""How well a module has held its pose so far, and whether its motion is believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.gate import Gate, GateSettings, Verdict
from sceneslam.bus.runner import Runner
from sceneslam.bus.sureness import Sureness
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.se3 import Transform


class Hold:
    """Follows one activation of a module: since when it is held, lost, silent or suspect."""

    def __init__(self, *, silence_ns: int, gate: GateSettings | None) -> None:
        self.status: TrackingStatus | None = None  # None until it was fed
        self.is_suspect = False  # from a disagreement on until it has agreed for long enough
        self.suspect_since_ns: int | None = None  # from when on it may have been wrong
        self.is_trusted = False  # another module may start from its last pose
        self.is_asked = False  # it was given the last observation
        self.inliers = 0  # measurements that agreed with its last pose
        self.is_revised = False  # its last pose jumped, for it corrected its past
        self.unheld_since_ns: int | None = None
        self.held_since_ns: int | None = None
        self.held_ns = 0  # how long it had held its pose without a break before that
        self.turn: NDArray[np.float64] | None = None  # its last (3, 3) rotation, where believed
        self.covariance: NDArray[np.float64] | None = None  # of its pose, where that may be used
        self.T_local_base: Transform | None = None  # at the last observation, where it told one
        self._gate = Gate(gate) if gate is not None else None
        self._sureness = Sureness()
        self._revision = 0
        self._fed_ns: int | None = None  # when its sensors last spoke ...
        self._period_ns = silence_ns  # ... and how long after the time before; at first a guess

    @property
    def is_held(self) -> bool:
        """Tell whether the module holds its pose, as far as is known."""
        return self.held_since_ns is not None

    def ask(self, runner: Runner, observation: Observation) -> Tracking | None:
        """Return a module's answer where its pose may be used; raises ModuleError as the runner."""
        self.is_trusted, self.covariance = False, None
        self.is_asked = runner.can_use(observation)
        if not self.is_asked:
            self._judge(observation, None)
            self._wait(observation.stamp_ns)
            return None
        tracking = runner.track(observation)
        self._feed(tracking)
        is_lost = tracking.status is TrackingStatus.LOST
        self._judge(observation, None if is_lost else tracking.T_local_base)
        if is_lost or self.is_suspect:
            self._lose(tracking.stamp_ns)
            return None
        self.covariance = tracking.covariance
        is_sure = self._sureness.is_usual(tracking.covariance)
        self.is_trusted = is_sure and tracking.status is TrackingStatus.TRACKING
        self.unheld_since_ns = None
        if self.held_since_ns is None:
            self.held_since_ns = tracking.stamp_ns
        return tracking

    def spare(self, observation: Observation) -> None:
        """Take note of an observation that a module which is catching up was not given."""
        self.is_trusted, self.covariance, self.is_asked = False, None, False
        self._judge(observation, None)

    def _feed(self, tracking: Tracking) -> None:
        if self._fed_ns is not None:
            self._period_ns = tracking.stamp_ns - self._fed_ns
        self._fed_ns, self.status = tracking.stamp_ns, tracking.status
        self.inliers = tracking.inliers
        self.is_revised = tracking.revision != self._revision
        self._revision = tracking.revision

    def _judge(self, observation: Observation, T_local_base: Transform | None) -> None:
        """Hold the module's motion against the odometry's."""
        before, self.T_local_base, self.turn = self.T_local_base, T_local_base, None
        if self._gate is None:
            return
        judgement = self._gate.update(
            observation.stamp_ns,
            T_local_base=T_local_base,
            T_odom_base=observation.T_odom_base,
            is_revised=self.is_revised,
        )
        if Verdict.DISAGREE in (judgement.distance, judgement.turn):
            self.suspect_since_ns = None if self.is_suspect else judgement.since_ns
            self.is_suspect = True
        elif judgement.is_trusted:
            self.is_suspect, self.suspect_since_ns = False, None
        if before is None or T_local_base is None or self.is_revised:
            return
        if judgement.turn is Verdict.AGREE:
            self.turn = before[:3, :3].T @ T_local_base[:3, :3]

    def _wait(self, stamp_ns: int) -> None:
        """Take note of an observation in which none of the module's sensors spoke."""
        if self._fed_ns is None or stamp_ns - self._fed_ns > 2 * self._period_ns:
            self._lose(stamp_ns)

    def _lose(self, stamp_ns: int) -> None:
        if self.unheld_since_ns is None:
            self.unheld_since_ns = stamp_ns
            held_since_ns, self.held_since_ns = self.held_since_ns, None
            self.held_ns = stamp_ns - held_since_ns if held_since_ns is not None else 0
