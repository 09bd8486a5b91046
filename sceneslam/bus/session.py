"""One activation of a module: track, check, place or bridge each observation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.bridge import Bridge
from sceneslam.bus.judging.gate import Witness
from sceneslam.bus.judging.hold import Health, Hold
from sceneslam.bus.judging.runner import Runner
from sceneslam.bus.observation_buffer import BufferedObservation
from sceneslam.types import se3
from sceneslam.types.covariance import grown, unknown_motion
from sceneslam.types.errors import ModuleError
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.run import BRIDGED
from sceneslam.types.se3 import Transform


@dataclass(frozen=True, slots=True, kw_only=True)
class Suspicion:
    """A disagreement of a module with the wheels, until it is decided which of them was wrong."""

    since_ns: int  # its poses after it may be wrong
    noticed_ns: int


class ModuleSession:
    """Advances by one observation at a time: the newest, or remembered ones in a catch-up.

    Without a runner there is no module, and every pose is bridged.
    """

    def __init__(self, runner: Runner | None, hold: Hold, bridge: Bridge) -> None:
        self.runner, self.hold, self.bridge = runner, hold, bridge
        self.is_placed = False
        self._has_gap = False  # a pose was unknown since the last one that was tracked
        # How the last answer corrected its past, in map; unknown where nothing bridges the motion.
        self.T_new_old: Transform | None = None
        self.tracking: Tracking | None = None  # of the last observation, where its pose is used
        self.fault: ModuleError | None = None  # failure at the last observation
        self.stored: list[int] = []  # its sessions in the back end
        self.logged: TrackingStatus | None = None  # its status as last logged
        self.from_ns = 0  # its poses after it are the module's
        self.suspicion: Suspicion | None = None
        self.is_acquitted = False  # the last suspicion ended: the wheels were wrong
        # The answer at which it was placed, and the covariance (6, 6) of a place that was guessed.
        self._placed: tuple[Tracking, NDArray[np.float64] | None] | None = None

    @property
    def key(self) -> str:
        """Return the module's key in `slam`, "" without one."""
        return BRIDGED if self.runner is None else self.runner.key

    @property
    def is_running(self) -> bool:
        """Tell whether there is a module that has not failed."""
        return self.runner is not None and not self.runner.is_failed

    @property
    def health(self) -> Health:
        """Return the module's health, FAILED without one."""
        return self.hold.health if self.is_running else Health.FAILED

    def advance(
        self,
        observation: Observation,
        *,
        by_velocity: bool,
        witness: Witness,
        T_prev_curr: Transform | None = None,
        is_given: bool = True,
    ) -> BufferedObservation:
        """Return the observation with its pose: the module's, or a bridged one.

        The module is spared the observation unless `is_given`.
        Odometry bridges; else constant velocity, if `by_velocity` or while the module's sensors
        are silent; else `T_prev_curr`, the motion as it was estimated at the time. `witness` says
        what is known of the odometry without the module.
        """
        self.fault, self.tracking, self.T_new_old = None, None, None
        try:
            if is_given and self.is_running:
                self.tracking = self._ask(observation, witness)
            else:
                if self.runner is not None:
                    self.runner.skip(observation)
                self.hold.spare(observation)
            if self.tracking is not None:
                T_map_tracked = self._place(observation, self.tracking, T_prev_curr)
                self.tracking = self.doubted(self.tracking)
                return self._moment(observation, T_map_tracked, witness)
        except ModuleError as error:
            self.fault, self.tracking = error, None
        if not self.is_running:
            self.hold.lose(observation.stamp_ns)
        is_silent = self.hold.status is not TrackingStatus.LOST
        T_map_base = self.predict(
            self.bridge, observation, by_velocity=by_velocity or is_silent, T_prev_curr=T_prev_curr
        )
        self._has_gap |= T_map_base is None
        return self._moment(observation, T_map_base, witness)

    def predict(
        self,
        bridge: Bridge,
        observation: Observation,
        *,
        by_velocity: bool,
        T_prev_curr: Transform | None,
    ) -> Transform | None:
        """Return T_map_base (4, 4) by a bridge, which continues from it; None if it is unknown."""
        observation = self._believed(observation)
        turn = self.hold.turn if self.is_running else None
        T_map_base = bridge.predict(observation, by_velocity=by_velocity, turn=turn)
        if T_map_base is None and T_prev_curr is not None:
            T_map_base = bridge.follow(observation, T_prev_curr)
        return T_map_base

    def _believed(self, observation: Observation) -> Observation:
        """Return an observation without the odometry of wheels that lie."""
        return replace(observation, T_odom_base=None) if self.hold.wheels_lie else observation

    def _ask(self, observation: Observation, witness: Witness) -> Tracking | None:
        """Return the module's answer if it may be used; raises ModuleError as the runner does."""
        assert self.runner is not None
        tracking = self.hold.ask(self.runner, observation, witness)
        self.is_acquitted = False
        if self.hold.is_suspect:
            self.is_placed = False  # it is placed anew at the robot's next pose
        elif tracking is not None and self.suspicion is not None:
            # Where it was DEGRADED it may have slid, unless the wheels show that it was they.
            was_held = self.hold.degraded_ns <= self.suspicion.since_ns
            self.is_acquitted = self.hold.wheels_lie and (was_held or self.hold.wheels_jumped)
            self.is_placed = self.is_acquitted  # where it was before
        return tracking

    def _place(
        self, observation: Observation, tracking: Tracking, T_prev_curr: Transform | None
    ) -> Transform:
        """Return T_map_base; a module's first pose is the bridged one, handed over (Eq. 1)."""
        if not self.is_placed:
            T_map_base = self.bridge.predict(self._believed(observation), by_velocity=True)
            if T_map_base is None and T_prev_curr is not None:
                T_map_base = self.bridge.follow(observation, T_prev_curr)
            self.settle(tracking, None if self._has_gap else T_map_base)
            self.is_placed = True
        assert self.runner is not None and self.runner.T_map_local is not None
        T_map_base = self.runner.T_map_local @ tracking.T_local_base
        if self.hold.is_revised:
            T_map_old = self.bridge.copy().predict(
                self._believed(observation), by_velocity=self.bridge.has_velocity
            )
            if T_map_old is not None:
                self.T_new_old = T_map_base @ se3.inverse(T_map_old)
        self.bridge.update(observation, T_map_base, is_jump=self.hold.is_revised)
        self._has_gap = False
        return T_map_base

    def settle(self, tracking: Tracking, T_map_base: Transform | None) -> None:
        """Place the module where the bridge is; what moved since is unknown without T_map_base."""
        assert self.runner is not None
        unknown = unknown_motion(self.bridge.unknown_s(tracking.stamp_ns))
        self._placed = tracking, unknown if T_map_base is None else None
        self.runner.place(self.bridge.T_map_base @ se3.inverse(tracking.T_local_base))

    def doubted(self, tracking: Tracking) -> Tracking:
        """Return an answer whose map's covariance counts from where the module was placed.

        What its map drifted before is no part of it; how uncertain that place is, is.
        """
        assert self._placed is not None
        placed, unknown = self._placed
        drift, before = tracking.map_covariance, placed.map_covariance
        T_base_placed = se3.inverse(tracking.T_local_base) @ placed.T_local_base
        if drift is not None and before is not None and before.any():
            drift = grown(before, drift, T_base_placed)
        if unknown is not None:
            carried = se3.carried(unknown, T_base_placed)
            drift = carried if drift is None else drift + carried
        return replace(tracking, map_covariance=drift)

    def _moment(
        self, observation: Observation, T_map_base: Transform | None, witness: Witness
    ) -> BufferedObservation:
        tracking = self.tracking
        return BufferedObservation(
            observation=observation,
            T_map_base=T_map_base,
            module=BRIDGED if tracking is None else self.key,
            bridge=self.bridge.copy(),
            turn=self.hold.turn if self.is_running else None,
            tracking=self.hold.answer if tracking is None else tracking,
            is_trusted=tracking is not None and self.hold.is_trusted,
            vouches=self.runner is not None and self.hold.agrees and not self.runner.needs_wheels,
            missed_rad=witness.missed_rad,
        )
