"""The contracts: what a source, detector, SLAM module, sink and experiment must do.

All poses are (4, 4) float64, metres, REP-103 axes. Calls never overlap and come in the order
`activate`, then the rest, then `shutdown`; in live mode not all of them from one thread. An
expected failure is a value (`LOST`, `UNSURE`); an exception means a violated contract, and the bus
then stops the component.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.command import Command
from sceneslam.types.experiment import RunTrials, Verdict
from sceneslam.types.maps import HybridMap, MapLayers, MovedMap
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
        """Return the sensors, before the first observation is read; raises InputError."""
        ...

    @property
    def length(self) -> int | None:
        """Return the number of observations (for the progress bar), None if unknown."""
        ...

    @property
    def faults(self) -> Sequence[str]:
        """Return one sentence per type of damage found in the input, after reading."""
        ...

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations from the beginning, by rising stamp; every call starts again.

        Raises InputError if the input cannot be read further; earlier observations stay valid.
        """
        ...

    def ground_truth(self) -> GroundTruth | None:
        """Return the ground truth, None if unknown. It is never passed to a module."""
        ...


class LiveFeed(Protocol):
    """The interface of live sources for a run; thread-safe."""

    def measured_ns(self, observation: Observation) -> int:
        """Return the time [ns] at which an observation was measured, on the monotonic clock."""
        ...

    def notices(self) -> Sequence[Event]:
        """Return the events of the input since the last call, oldest first.

        For example `clock_jump` (`shift_ns`: offset added to the robot's stamps from here on, so
        that they rise), `stream_silent`, `stream_returned`, `late`, `unordered`.
        """
        ...

    def close(self) -> None:
        """End the iteration at once, and release all resources. May be called twice."""
        ...


@runtime_checkable
class Live(Protocol):
    """A source that may be live, such as a robot or a camera."""

    @property
    def live(self) -> LiveFeed | None:
        """Return the feed, None if the source is recorded."""
        ...


@runtime_checkable
class Logged(Protocol):
    """A recording whose observations have other stamps than the recording itself.

    Files of trajectories have the recording's stamps, by which others compare them.
    """

    def logged_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the recording's stamps (N,) of observations with `stamps_ns` (N,)."""
        ...


@runtime_checkable
class Detector(Protocol):
    """Classifies the scene around the robot."""

    @property
    def quantity(self) -> str:
        """Return the name of a vote's value, for figures; "" if votes have no value."""
        ...

    @property
    def scenes(self) -> tuple[str, ...]:
        """Return every scene that this detector can report."""
        ...

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return alternative sets of sensors; the source must have all sensors of one set."""
        ...

    def activate(self, rig: Rig) -> None:
        """Prepare for observations of `rig`."""
        ...

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the vote for this observation; UNSURE without the necessary measurements."""
        ...

    def shutdown(self) -> None:
        """Release the resources of `activate`. May be called twice."""
        ...


@runtime_checkable
class FeatureDetector(Detector, Protocol):
    """A detector whose votes depend on a few numbers per observation only.

    `get_scene` is `decide` on `get_features`: the numbers can be stored, and other settings tried
    on them without the images (`run=detect_only`).
    """

    feature_settings: tuple[str, ...]  # constructor arguments on which the features depend

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return the features (F,), with constant F; None without the necessary measurements.

        They depend only on the observations since `activate`, which come by rising stamp, and the
        `feature_settings`.
        """
        ...

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the vote for an observation's features (F,); called by rising stamp."""
        ...


@runtime_checkable
class SlamModule(Protocol):
    """Estimates the robot's pose in a frame of its own, and builds a map.

    `local` is the robot's base at the first observation after `activate`: there T_local_base is the
    identity. `T_map_local` (the paper's T_conversion) is the pose of `local` in the map.
    """

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return alternative sets of sensors; the source must have all sensors of one set."""
        ...

    def activate(self, rig: Rig) -> None:
        """Start a session: empty map, `local` at the next observation."""
        ...

    def set_pose(self, T_map_local: Transform) -> None:
        """Set T_map_local (4, 4) [m], the pose of `local` in the map (Eq. 1).

        The bus computes T_map_base = T_map_local @ T_local_base from the result of `track` (Eq. 2),
        which is the paper's GetPose.
        """
        ...

    def set_scene(self, scene: str) -> None:
        """Set the confirmed scene; a module may change its mode by it."""
        ...

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m] at the observation, with status and covariances.

        The observation has at least one of the required sensors; others may be missing. The status
        is LOST if there is no pose; the pose is then the last tracked one. It is never NaN.
        """
        ...

    def get_trajectory(self) -> Trajectory:
        """Return the best current estimate of T_local_base at every stamp with a pose.

        It is empty if a module never revises the poses of `track`. Its covariances, where it has
        any, replace those of `track`. Called once, before `get_map`, when the module is about to be
        shut down, with a last optimisation. May be slow.
        """
        ...

    def get_map(self) -> MapLayers:
        """Return the map in `local`. May be slow; not called for every observation."""
        ...

    def shutdown(self) -> None:
        """Release the resources of `activate`. The map stays readable. May be called twice."""
        ...


@runtime_checkable
class ClosesLoops(Protocol):
    """A SLAM module that may recognize places in its own map, and correct its poses itself.

    Of all others the atlas closes the loops.
    """

    @property
    def closes_loops(self) -> bool:
        """Tell whether it does."""
        ...


def closes_own_loops(module: object) -> bool:
    """Tell whether a module closes loops itself."""
    return isinstance(module, ClosesLoops) and module.closes_loops


@runtime_checkable
class PipelinedSlam(Protocol):
    """A SLAM system whose poses come later than their observations.

    `sceneslam.modules.slam.pipelined.Pipelined` makes a `SlamModule` of it. All methods but `feed`
    are as there; `local` is the robot's base at the first observation.
    """

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return alternative sets of sensors."""
        ...

    def activate(self, rig: Rig) -> None:
        """Start anew."""
        ...

    def set_scene(self, scene: str) -> None:
        """Set the confirmed scene."""
        ...

    def feed(self, observation: Observation) -> Sequence[Tracking]:
        """Process an observation; return the poses that are available now, by rising stamp.

        There may be none yet, one, or several; each has the stamp of an observation that was fed
        and has no pose yet. Skipped observations get no pose.
        """
        ...

    def get_trajectory(self) -> Trajectory:
        """Return the revised poses at the end; empty: those that `feed` returned."""
        ...

    def get_map(self) -> MapLayers:
        """Return the map in `local`."""
        ...

    def shutdown(self) -> None:
        """Free what `activate` took."""
        ...


@runtime_checkable
class Restartable(Protocol):
    """A SLAM module that can be activated again after a failure, as it is then built again."""

    @property
    def is_ready(self) -> bool:
        """Tell whether `activate` would not wait."""
        ...

    @property
    def is_spent(self) -> bool:
        """Tell whether there were too many failures for an activation now."""
        ...

    def note_failure(self) -> None:
        """Record that its session was stopped because of a failure."""
        ...


@runtime_checkable
class Concurrent(Protocol):
    """A SLAM module that tracks asynchronously, in a process of its own.

    Submit the observation to all such modules first, then collect the results: they run on as many
    cores as available. Between `submit` and `collect` no other method is called; both raise the
    exceptions of `track`.
    """

    def submit(self, observation: Observation) -> None:
        """Start tracking, and return at once."""
        ...

    def collect(self) -> Tracking:
        """Return the result of `track` for the last submitted observation."""
        ...


class BackEnd(Protocol):
    """Stores the one trajectory, and the sessions of all modules.

    All poses of the bus are passed to it.
    """

    @property
    def last_stamp_ns(self) -> int | None:
        """Return the stamp of the newest pose, None before the first."""
        ...

    def begin_session(
        self, module: str, T_map_local: Transform, T_new_told: Transform | None = None
    ) -> int:
        """Begin a session of a module at T_map_local (4, 4) [m] (Eq. 1); return its index.

        `T_new_told` (4, 4): how the module before it has corrected the last pose since that was
        added; None: not at all.
        """
        ...

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Add T_local_base (4, 4) [m] to the current session's trajectory."""
        ...

    def add(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: NDArray[np.float64] | None = None,
        map_covariance: NDArray[np.float64] | None = None,
    ) -> None:
        """Add T_map_base (4, 4) [m] to the trajectory; a stamp has one pose, the first.

        `module` is "" for bridged poses; the covariances (6, 6) are those of T_local_base in base,
        in the module's map and of this map's drift (`Tracking`), if the module reports them.
        """
        ...

    def rewind(self, stamp_ns: int, T_new_told: Transform | None = None) -> None:
        """Remove the poses from a stamp on, to be replaced by better ones.

        `T_new_told` (4, 4): how the module has corrected the last pose left since that was added,
        where the session goes on from it; None: another session begins.
        """
        ...

    def close_session(self, session: int, layers: MapLayers, revised: Trajectory) -> None:
        """Store a session's map and its revised poses T_local_base (4, 4) [m].

        `revised` is empty if the module did not revise its poses.
        """
        ...


@runtime_checkable
class Experiment(Protocol):
    """A question that is answered by many runs."""

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return the verdict; figures and other files are written to `folder`.

        `run_trials` runs trials in order. All trials of one call are composed before the first is
        run, so that a mistake in any of them is found at once.
        """
        ...


@runtime_checkable
class Sink(Protocol):
    """Receives poses and decisions of a run, while it runs."""

    def open(self, rig: Rig, folder: Path) -> None:
        """Prepare for writing; relative paths are relative to `folder`, the run's folder."""
        ...

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Write an observation with T_map_base (4, 4) [m] (None: no pose).

        `module` is the key of the active module, also while it is lost and the pose is bridged; ""
        where no module is active.
        """
        ...

    def write_event(self, event: Event) -> None:
        """Write an event: a vote, a decision, a hand-over, ..."""
        ...

    def write_truth(self, truth: GroundTruth) -> None:
        """Write the ground truth, once, after the last observation."""
        ...

    def close(self) -> None:
        """Complete the output so that it is readable, also after an error. May be called twice."""
        ...


@runtime_checkable
class ResultSink(Protocol):
    """A sink that also receives the final results."""

    def write_result(self, result: RunResult) -> None:
        """Write the revised trajectory and the map, once, between `write_truth` and `close`."""
        ...


@runtime_checkable
class CovarianceSink(Protocol):
    """A sink that also receives the covariance of each pose."""

    def write_covariance(self, stamp_ns: int, covariance: NDArray[np.float64]) -> None:
        """Set the covariance (6, 6) [m, rad] of the next pose, in base, by its module."""
        ...


@runtime_checkable
class MapSink(Protocol):
    """A sink that also shows a map while the run goes on."""

    def write_map(self, moved: MovedMap) -> None:
        """Correct the map: loops or a loaded map moved it. Called before the next `write`."""
        ...


@runtime_checkable
class Steering(Protocol):
    """A sink through which an operator controls the run."""

    def commands(self) -> Sequence[Command]:
        """Return the commands since the last call, oldest first; called before every step."""
        ...


class LiveMapper(Protocol):
    """Builds a map during the run from measurements at the reported poses."""

    @property
    def sensors(self) -> frozenset[Sensor]:
        """Return the sensors whose measurements it draws; `add` gets at least one of them."""
        ...

    def open(self, rig: Rig) -> None:
        """Start with an empty map."""
        ...

    def add(self, observation: Observation, T_map_base: Transform, T_map_then: Transform) -> None:
        """Add an observation at T_map_base (4, 4) [m]; at its scan's stamp, base was T_map_then."""
        ...

    def move(self, moved: MovedMap) -> None:
        """Move what was drawn to where it is now."""
        ...

    def map(self) -> HybridMap:
        """Return the current map, in `map`."""
        ...


class TrajectoryLog(Protocol):
    """The calls of an atlas, in order; repeated on another atlas, they give the same result.

    Poses and transforms are (4, 4) [m], covariances (6, 6) or None, as for the atlas.
    """

    def add_observation(self, stamp_ns: int) -> None:
        """Record that an observation was processed, and its pose reported as it is now."""
        ...

    def add_session(self, module: str, T_map_local: Transform, T_new_told: Transform) -> None:
        """Record that a session of a module begins."""
        ...

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Record a pose of the session's trajectory."""
        ...

    def add_pose(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: NDArray[np.float64] | None,
        map_covariance: NDArray[np.float64] | None,
    ) -> None:
        """Record a pose of the global trajectory; module "": bridged."""
        ...

    def add_rewind(self, stamp_ns: int, T_new_told: Transform | None) -> None:
        """Record that the poses from a stamp on are removed."""
        ...

    def add_correction(self, stamps_ns: NDArray[np.int64], T_new_old: NDArray[np.float64]) -> None:
        """Record a correction T_new_old (N, 4, 4) of the poses, at rising stamps (N,).

        At other stamps that were recorded before, it is as before.
        """
        ...

    def add_final(self, stamps_ns: NDArray[np.int64], T_new_old: NDArray[np.float64]) -> None:
        """Record the correction of the end in place of all others, of the poses as revised."""
        ...

    def add_end(self, session: int, revised: Trajectory) -> None:
        """Record the revised poses of a session; empty if not revised."""
        ...
