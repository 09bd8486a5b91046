"""The contracts: what a source, detector, SLAM module, sink and experiment must do.

All poses are (4, 4) float64, metres, REP-103 axes. Calls never overlap and come in the order
`activate`, then the rest, then `shutdown`; in live mode not all of them from one thread. An
expected failure is a value (`LOST`, `UNSURE`); an exception means a broken promise, and the bus
stops the component for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.command import Command
from sceneslam.types.experiment import RunTrials, Verdict
from sceneslam.types.maps import HybridMap, MapLayers
from sceneslam.types.observation import Observation, SceneVote, Tracking
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import Event, RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth


@runtime_checkable
class Source(Protocol):
    """A recording, simulator or live robot."""

    @property
    def rig(self) -> Rig:
        """Return the sensors, known before the first observation; raises InputError else."""
        ...

    @property
    def length(self) -> int | None:
        """Return how many observations there will be (for progress), None when unknown."""
        ...

    @property
    def faults(self) -> Sequence[str]:
        """Return, after reading, one sentence per kind of damage found in the input."""
        ...

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations from the beginning, by rising stamp; every call starts anew.

        Raises InputError where the input cannot be read on; what came before stays valid.
        """
        ...

    def ground_truth(self) -> GroundTruth | None:
        """Return what is known to be true, None when nothing is. Never shown to a module."""
        ...


class LiveFeed(Protocol):
    """What a live run asks of a source that measures now; may be asked from any thread."""

    def measured_ns(self, observation: Observation) -> int:
        """Return when an observation was measured, by this machine's monotonic clock [ns]."""
        ...

    def notices(self) -> Sequence[Event]:
        """Return what happened to the input since the last call, oldest first.

        Such as `clock_jump` (`shift_ns`: from here on added to the robot's stamps, so that they
        rise), `stream_silent`, `stream_returned`, `late`, `unordered`.
        """
        ...

    def close(self) -> None:
        """End the iteration, wherever it waits, and free what it took. May be called twice."""
        ...


@runtime_checkable
class Live(Protocol):
    """A source that may measure now: a robot, a camera."""

    @property
    def live(self) -> LiveFeed | None:
        """Return the feed, None where what the source gives is recorded."""
        ...


@runtime_checkable
class Detector(Protocol):
    """Names the scene around the robot."""

    @property
    def quantity(self) -> str:
        """Return what the value of a vote measures, for figures; "" when it has none."""
        ...

    @property
    def scenes(self) -> tuple[str, ...]:
        """Return every scene that this detector can report."""
        ...

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the alternatives of sensors; the source must have every sensor of one of them."""
        ...

    def activate(self, rig: Rig) -> None:
        """Get ready for observations of `rig`."""
        ...

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return this observation's vote; UNSURE when it holds nothing to vote on."""
        ...

    def shutdown(self) -> None:
        """Free what `activate` took. May be called twice."""
        ...


@runtime_checkable
class FeatureDetector(Detector, Protocol):
    """A detector that votes by a few numbers per observation alone.

    `get_scene` is `decide` on `get_features`: the numbers can be kept, and other settings tried on
    them without the images (`run=detect_only`).
    """

    feature_settings: tuple[str, ...]  # constructor arguments that the features depend on

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return (F,) numbers, F the same for all; None when it holds nothing to vote on.

        They depend on nothing but the observations since `activate`, which come by rising stamp,
        and the `feature_settings`.
        """
        ...

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the vote on an observation's features; called by rising stamp."""
        ...


@runtime_checkable
class SlamModule(Protocol):
    """Estimates the robot's motion in a frame of its own, and maps on the way.

    `local` is the robot's base at the first observation after `activate`: there T_local_base is
    the identity. `T_map_local` (the paper's T_conversion) places it in the world.
    """

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the alternatives of sensors; the source must have every sensor of one of them."""
        ...

    def activate(self, rig: Rig) -> None:
        """Start anew: empty map, `local` at the next observation.

        What an earlier session saw may be recognised later: `Tracking.revision` tells of it.
        """
        ...

    def set_pose(self, T_map_local: Transform) -> None:
        """Hear where `local` lies in the map (Eq. 1).

        The bus makes T_map_base = T_map_local @ T_local_base of what `track` returns (Eq. 2): that
        is the paper's GetPose.
        """
        ...

    def set_scene(self, scene: str) -> None:
        """Hear of the confirmed scene; a module may change its mode for it."""
        ...

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base at the observation.

        It holds at least one of the sensors in `requires`; another may have been silent. LOST
        where no pose can be told: the pose is then the last one that was held. Never returns NaN.
        """
        ...

    def get_trajectory(self) -> Trajectory:
        """Return T_local_base at every stamp that has a pose, as best known by now.

        Empty where a module never revises what `track` told. Asked once, before `get_map`, when
        the module is about to be shut down; a last optimisation belongs here. May be slow.
        """
        ...

    def get_map(self) -> MapLayers:
        """Return the map in `local`. May be slow; not called for every observation."""
        ...

    def shutdown(self) -> None:
        """Free what `activate` took. The map stays readable. May be called twice."""
        ...


@runtime_checkable
class PipelinedSlam(Protocol):
    """A SLAM system whose poses come later than their observations.

    `sceneslam.modules.slam.pipelined.Pipelined` makes a `SlamModule` of it. All but `feed` is as
    there; `local` is the robot's base at the first observation that it is fed.
    """

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the alternatives of sensors."""
        ...

    def activate(self, rig: Rig) -> None:
        """Start anew."""
        ...

    def set_scene(self, scene: str) -> None:
        """Hear of the confirmed scene."""
        ...

    def feed(self, observation: Observation) -> Sequence[Tracking]:
        """Take an observation; return the poses that are ready by now, by rising stamp.

        None of them ("not yet"), one, or several; each bears the stamp of an observation that was
        fed and has no pose yet. One that is skipped gets none.
        """
        ...

    def get_trajectory(self) -> Trajectory:
        """Return all poses as best known at the end; empty: those that `feed` returned."""
        ...

    def get_map(self) -> MapLayers:
        """Return the map in `local`."""
        ...

    def shutdown(self) -> None:
        """Free what `activate` took."""
        ...


@runtime_checkable
class Restartable(Protocol):
    """A SLAM module that can be activated again after it failed, as it is then built anew."""

    @property
    def is_ready(self) -> bool:
        """Tell whether `activate` would not have to wait."""
        ...

    @property
    def is_spent(self) -> bool:
        """Tell whether it failed too often to be activated, for now."""
        ...

    def note_failure(self) -> None:
        """Take that its session was stopped because it failed."""
        ...


@runtime_checkable
class Concurrent(Protocol):
    """A SLAM module that tracks while its caller does something else: in its own process.

    Give every such module its observation first and collect the answers then: they run on as many
    cores as there are. Between `submit` and `collect` nothing else is asked of the module; both
    raise what `track` would.
    """

    def submit(self, observation: Observation) -> None:
        """Begin to track, and return at once."""
        ...

    def collect(self) -> Tracking:
        """Return what `track` would have returned for the observation submitted last."""
        ...


class BackEnd(Protocol):
    """Keeps one trajectory, and what every activation of a module contributes to it.

    What the bus tells of the way goes here and nowhere else.
    """

    @property
    def last_stamp_ns(self) -> int | None:
        """Return the stamp of the newest pose, None before the first."""
        ...

    def begin_session(self, module: str, T_map_local: Transform) -> int:
        """Open a session of a module that was placed in the map (Eq. 1); return its number."""
        ...

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Add a pose to the current session's own trajectory."""
        ...

    def add(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: NDArray[np.float64] | None = None,
    ) -> None:
        """Add a pose to the trajectory; a stamp has one pose, the first.

        `module` is "" where none gave it, `covariance` (6, 6) that of T_local_base in base, where
        the module tells it.
        """
        ...

    def rewind(self, stamp_ns: int) -> None:
        """Take the poses from an instant on back, for better ones."""
        ...

    def close_session(self, session: int, layers: MapLayers, revised: Trajectory) -> None:
        """Take the map that a session leaves behind, and its poses (T_local_base) at the end.

        `revised` is empty where the module stands by what it told.
        """
        ...


@runtime_checkable
class Experiment(Protocol):
    """Asks a question of many runs."""

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return what was found; figures and files of its own go into `folder`.

        `run_trials` runs in order. All trials handed to it at once are composed before the first
        is run, so that a mistake in any of them is found at once.
        """
        ...


@runtime_checkable
class Sink(Protocol):
    """Receives what the bus decides, while it runs."""

    def open(self, rig: Rig, folder: Path) -> None:
        """Get ready to write; relative paths are relative to `folder`, the run's own."""
        ...

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Take one observation with its pose (None without a pose) and active module."""
        ...

    def write_event(self, event: Event) -> None:
        """Take one event: a vote, a decision, a hand-over, ..."""
        ...

    def write_truth(self, truth: GroundTruth) -> None:
        """Take what is known to be true, once, after the last observation."""
        ...

    def close(self) -> None:
        """Finish the output so that it can be read, also after an error. May be called twice."""
        ...


@runtime_checkable
class ResultSink(Protocol):
    """A sink that also wants what was known at the end."""

    def write_result(self, result: RunResult) -> None:
        """Take the revised trajectory and the map, once, after the truth, before `close`."""
        ...


@runtime_checkable
class CovarianceSink(Protocol):
    """A sink that also wants to know how certain each pose is."""

    def write_covariance(self, stamp_ns: int, covariance: NDArray[np.float64]) -> None:
        """Take the covariance (6, 6) [m, rad] of the next pose, in base, as its module told it."""
        ...


@runtime_checkable
class Steering(Protocol):
    """A sink through which an operator steers the run."""

    def commands(self) -> Sequence[Command]:
        """Return what was asked since the last call, oldest first; asked before every step."""
        ...


class LiveMapper(Protocol):
    """Draws the map while the robot drives, of what the sensors measured at the reported poses."""

    def open(self, rig: Rig) -> None:
        """Begin an empty map."""
        ...

    def add(self, observation: Observation, T_map_base: Transform) -> None:
        """Draw one observation."""
        ...

    def map(self) -> HybridMap:
        """Return the map so far, in `map`."""
        ...


class TrajectoryLog(Protocol):
    """The calls of an atlas, in order; repeated on another atlas, they give the same result.

    Poses and transforms are (4, 4), covariances (6, 6) or None, as the atlas takes them.
    """

    def add_session(self, module: str, T_map_local: Transform) -> None:
        """Take that a session of a module begins."""
        ...

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Take a pose of the session's own trajectory."""
        ...

    def add_pose(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: NDArray[np.float64] | None,
    ) -> None:
        """Take a pose of the global trajectory; module "" where none gave it."""
        ...

    def add_rewind(self, stamp_ns: int) -> None:
        """Take that the poses from an instant on are taken back."""
        ...

    def add_end(self, session: int, revised: Trajectory) -> None:
        """Take how a module revised its session's poses; empty where it did not."""
        ...
