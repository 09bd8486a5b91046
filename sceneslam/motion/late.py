"""Predict the current pose when a module's poses arrive later than their observations."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.model import MotionModel
from sceneslam.motion.motion import still
from sceneslam.types import se3
from sceneslam.types.covariance import TRIANGLE, symmetric, triangle
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig, Sensor, Wheels
from sceneslam.types.rows import Rows
from sceneslam.types.trajectory import Trajectory


class Pipeline:
    """Matches answers with observations; odometry extends the newest pose until the next one.

    Without odometry the pose is extended at constant velocity. In both cases it is DEGRADED, or
    LOST when the newest answer is older than `late_max_s`. A covariance, where the answer has one,
    grows by the motion's: by the `wheels`, None: the usual ones, or by how fast a robot changes its
    velocity.
    """

    def __init__(self, late_max_s: float, wheels: Wheels | None = None) -> None:
        self.revision = 0  # of the answers: it increases when a module corrects its past
        self._late_max_s = late_max_s
        self._rig = Rig(sensors=frozenset({Sensor.ODOMETRY}), wheels=wheels or Wheels())
        self._waiting: dict[int, se3.Transform | None] = {}  # stamp -> T_odom_base
        self._is_late = False
        self._newest: Tracking | None = None
        self._T_odom_newest: se3.Transform | None = None
        self._first_ns: int | None = None
        self._T_local_base = se3.identity()  # the last reported pose
        self._twist_s, self._kept_revision = np.zeros(6), 0
        self._step_s = 0.0  # over which the twist was measured; 0: it was not
        self._stamps_ns, self._poses = array("q"), Rows(4, 4)  # T_local_base, as it was answered
        self._covariances = Rows(TRIANGLE)  # of these poses, NaN: not reported

    def note(self, observation: Observation) -> None:
        """Record an observation that was given to the program."""
        T_odom_base = observation.T_odom_base
        self._waiting[observation.stamp_ns] = T_odom_base
        if self._first_ns is None:
            self._first_ns, self._T_odom_newest = observation.stamp_ns, T_odom_base

    def take(self, answers: Sequence[Tracking]) -> None:
        """Add answers by increasing stamp; raises ValueError for an unexpected one.

        Between answers of different revisions the map moved, not the robot.
        """
        for answer in answers:
            if answer.stamp_ns not in self._waiting:
                given = f"the last was {max(self._waiting, default=None)}"
                raise ValueError(
                    f"answered for the stamp {answer.stamp_ns}, which is not waiting ({given})"
                )
            if answer.status is not TrackingStatus.LOST:
                self._keep(answer)
                self._T_odom_newest = self._waiting[answer.stamp_ns]
            self._newest = answer
            self._waiting = {ns: T for ns, T in self._waiting.items() if ns > answer.stamp_ns}
        self._is_late = self._is_late or bool(self._waiting)

    def report(self, observation: Observation) -> Tracking:
        """Return the pose at an observation that was recorded."""
        newest = self._newest
        exact = newest if newest is not None and newest.stamp_ns == observation.stamp_ns else None
        is_lost = newest is not None and newest.status is TrackingStatus.LOST
        if is_lost:
            status = TrackingStatus.LOST
        elif exact is not None:
            status, self._T_local_base = exact.status, exact.T_local_base
        else:
            status = self._carry_on(observation)
        is_tracked = status is not TrackingStatus.LOST
        reported = newest.covariance if newest is not None and is_tracked else None
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=self._T_local_base.copy(),
            status=status,
            covariance=reported if exact is not None else self._grown(reported, observation),
            map_covariance=self._here(None if newest is None or is_lost else newest.map_covariance),
            quality_ratio=newest.quality_ratio if newest is not None else 0.0,
            inliers=newest.inliers if newest is not None else 0,
            revision=self.revision,
            can_begin=newest is not None and is_lost and newest.can_begin,
        )

    def _grown(
        self, covariance: NDArray[np.float64] | None, observation: Observation
    ) -> NDArray[np.float64] | None:
        """Return a covariance (6, 6) of the newest answer with that of the motion since then."""
        here, newest = self._here(covariance), self._newest
        if covariance is None or here is None or newest is None:
            return None
        model = MotionModel(self._rig)
        has_odometry = self._T_odom_newest is not None and observation.T_odom_base is not None
        if self._step_s > 0.0 and not has_odometry:
            T_prev_curr = se3.exp(self._twist_s * self._step_s)
            both = 2.0 * covariance  # of both poses that the velocity was measured by
            model.inertia.learn(T_prev_curr, both, guess=still(), duration_s=self._step_s)
        model.predict(Observation(stamp_ns=newest.stamp_ns, T_odom_base=self._T_odom_newest))
        now = Observation(stamp_ns=observation.stamp_ns, T_odom_base=observation.T_odom_base)
        return here + model.predict(now).covariance

    def _here(self, covariance: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
        """Return a covariance (6, 6) of the newest answer, in the axes of the pose now."""
        if covariance is None or self._newest is None:
            return None
        T_now_newest = se3.inverse(self._T_local_base) @ self._newest.T_local_base
        return se3.carried(covariance, T_now_newest)

    def trajectory(self, revised: Trajectory) -> Trajectory:
        """Return T_local_base as the program revised it, else as it answered if any was late.

        If any was late, the poses have the covariances of their answers.
        """
        if not self._is_late or revised.covariances is not None:
            return revised
        stamps_ns = np.array(self._stamps_ns, np.int64)
        answered = symmetric(np.asarray(self._covariances))
        if not len(revised):
            poses = np.asarray(self._poses)
            return Trajectory(stamps_ns=stamps_ns, T_world_base=poses, covariances=answered)
        _, rows, own = np.intersect1d(revised.stamps_ns, stamps_ns, return_indices=True)
        covariances = np.full((len(revised), 6, 6), np.nan)
        covariances[rows] = answered[own]
        return replace(revised, covariances=covariances)

    def _carry_on(self, observation: Observation) -> TrackingStatus:
        """Extend the newest pose to an observation without an answer."""
        since_ns = self._stamps_ns[-1] if self._stamps_ns else self._first_ns
        assert since_ns is not None
        gap_s = (observation.stamp_ns - since_ns) * 1e-9
        T_odom_base = self._waiting[observation.stamp_ns]
        if gap_s > self._late_max_s:
            return TrackingStatus.LOST
        T_local_newest = self._poses[-1] if self._poses else se3.identity()
        if T_odom_base is not None and self._T_odom_newest is not None:
            T_newest_base = se3.inverse(self._T_odom_newest) @ T_odom_base
        elif len(self._poses) > 1 or gap_s == 0:
            T_newest_base = se3.exp(self._twist_s * gap_s)
        else:
            return TrackingStatus.LOST
        self._T_local_base = se3.orthonormal(T_local_newest @ T_newest_base)
        return TrackingStatus.DEGRADED

    def _keep(self, answer: Tracking) -> None:
        if self._poses and answer.revision == self._kept_revision:
            T_prev_curr = se3.inverse(self._poses[-1]) @ answer.T_local_base
            self._step_s = (answer.stamp_ns - self._stamps_ns[-1]) * 1e-9
            self._twist_s = se3.log(T_prev_curr) / self._step_s
        self._stamps_ns.append(answer.stamp_ns)
        self._poses.append(answer.T_local_base)
        known = answer.covariance
        self._covariances.append(np.full(TRIANGLE, np.nan) if known is None else triangle(known))
        self._kept_revision = answer.revision
