"""The `pipelined` SLAM module: a system that returns poses later, possibly several at once."""

from __future__ import annotations

from sceneslam.interfaces import PipelinedSlam
from sceneslam.motion.late import Pipeline
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation, Tracking
from sceneslam.types.ranges import check_least
from sceneslam.types.rig import Rig
from sceneslam.types.trajectory import Trajectory

from .local import WrappedModule


class Pipelined(WrappedModule):
    """Implements `SlamModule` by a `PipelinedSlam`.

    Until the pose of an observation arrives, the newest pose is extrapolated by odometry (constant
    velocity without odometry) and reported as DEGRADED; after `late_max_s` as LOST.
    """

    _system: PipelinedSlam

    def __init__(self, system: PipelinedSlam, late_max_s: float) -> None:
        if not isinstance(system, PipelinedSlam):
            raise ConfigError("system", system, "a sceneslam.interfaces.PipelinedSlam")
        check_least(0, late_max_s=late_max_s)
        self._system, self._late_max_s = system, late_max_s
        self._pipeline = Pipeline(late_max_s)

    def activate(self, rig: Rig) -> None:
        """Start a session."""
        self._pipeline = Pipeline(self._late_max_s, rig.wheels)
        self._system.activate(rig)

    def track(self, observation: Observation) -> Tracking:
        """Return the pose at the observation; raises ValueError for poses with unknown stamps."""
        self._pipeline.note(observation)
        poses = self._system.feed(observation)
        self._pipeline.take(poses)
        newest = max((pose.revision for pose in poses), default=self._pipeline.revision)
        self._pipeline.revision = newest
        return self._pipeline.report(observation)

    def get_trajectory(self) -> Trajectory:
        """Return the system's revised poses, else those that came late, if any."""
        return self._pipeline.trajectory(self._system.get_trajectory())
