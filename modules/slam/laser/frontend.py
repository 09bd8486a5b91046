"""The front end: predict, match, correct, and extend the map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.model import MotionModel
from sceneslam.motion.motion import Motion
from sceneslam.types.covariance import UNKNOWN_VELOCITY
from sceneslam.types.observation import (
    SWEEP_MAX_S,
    LaserScan,
    Observation,
    Tracking,
    TrackingStatus,
)
from sceneslam.types.planar import (
    Matrix,
    Planar,
    between,
    compose,
    from_transform,
    planar_covariance,
    propagate,
    spatial_covariance,
    to_transform,
    turn,
)
from sceneslam.types.trail import Trail

from .doubt import Doubt
from .field import LikelihoodField
from .keyframes import ScanKeyframe, ScanKeyframes
from .matcher import Match, Matcher, novelty
from .prior import MotionPrior, difference, is_apart
from .relocalizer import ScanRelocalizer
from .surface import ScanSurfaceReader, SurfacePoints

_OVERLAP_MIN_RATIO = 0.5  # with less, the map does not cover this place yet
_FAILURES_MAX = 10  # consecutive failed matches before mapping continues from dead reckoning
_REACH_SIGMAS = 2.0  # after a gap the robot may be so far from a prediction
_UNSEEN = np.diag([1e-2, 1e-2, 1e-1])  # 1/m^2, 1/rad^2: information in unconstrained directions
_DEVIATION_MIN = np.array([1e-3, 1e-3, 5e-4])  # m, m, rad: least standard deviation of a pose
_LEVEL_DEVIATION = 0.01  # m and rad: standard deviation of z, roll and pitch on a floor


@dataclass(slots=True)
class FrontEnd:
    """The pose estimation of one activation."""

    resolution_m: float  # of the likelihood field
    beams_min: int  # of a scan that is matched
    inlier_min_ratio: float  # of a match that is accepted
    predict_max_s: float  # a usual gap between scans
    matcher: Matcher
    relocalizer: ScanRelocalizer
    motion: MotionModel
    reader: ScanSurfaceReader
    keyframes: ScanKeyframes
    _pose: Planar = field(default_factory=lambda: np.zeros(3), init=False)
    _covariance: Matrix = field(default_factory=lambda: np.diag(_DEVIATION_MIN**2), init=False)
    _stamp_ns: int | None = field(default=None, init=False)
    _held_pose: Planar = field(default_factory=lambda: np.zeros(3), init=False)
    _held_covariance: Matrix = field(default_factory=lambda: np.diag(_DEVIATION_MIN**2), init=False)
    _held_ns: int | None = field(default=None, init=False)
    _seen_pose: Planar = field(default_factory=lambda: np.zeros(3), init=False)  # of its scan
    _fit_ns: int | None = field(default=None, init=False)  # scans fitted as usual until then
    _is_lost: bool = field(default=False, init=False)
    _failures: int = field(default=0, init=False)
    _field: LikelihoodField | None = field(default=None, init=False)
    _doubt: Doubt = field(default_factory=Doubt, init=False)
    _trail: Trail = field(default_factory=Trail, init=False)
    _late_s: float = field(default=0.0, init=False)  # of the first scan, until its pose is known

    def track(self, observation: Observation, scan: LaserScan | None) -> Tracking:
        """Return the pose at the observation, corrected by its scan if it has one."""
        before, before_ns, known = self._pose, self._stamp_ns, self._covariance
        motion = self.motion.predict(observation)
        self._stamp_ns = observation.stamp_ns
        T_prev_curr = from_transform(motion.T_prev_curr)
        predicted = compose(before, T_prev_curr)
        noise = planar_covariance(motion.covariance)
        self._covariance = propagate(known, before, T_prev_curr, noise)
        surfaces = self._read(scan)
        begin = before
        if scan is not None:
            then_ns = scan.stamp_ns if before_ns is None else min(scan.stamp_ns, before_ns)
            begin = compose(before, from_transform(self._trail.base_at(then_ns)))
        self._trail.move(observation.stamp_ns, motion.T_prev_curr)
        duration_s = self.motion.duration_s
        if self._late_s != 0.0 and before_ns == self._held_ns and duration_s > 0.0:
            T_prev_first = self._late_s / duration_s * T_prev_curr
            self._move_first(compose(before, T_prev_first), is_known=motion.is_measured)
        if scan is None or surfaces is None:
            return self._predict(observation, predicted, motion)
        # The scan is older than the observation, or a sweep from it on: match at the pose then.
        ratio = _share(scan.stamp_ns, before_ns, observation.stamp_ns)
        predicted_then = compose(begin, ratio * T_prev_curr)
        T_then_now = between(predicted_then, predicted)
        if self._field is None:
            self._extend(predicted_then, scan, surfaces)
            if before_ns is None or not motion.is_measured:
                self._late_s = _late_s(scan, observation)
            return self._hold(observation, predicted, None)
        is_first = self._fit_ns is None
        if self.matcher.misfit == 0.0 or is_first:
            self._fit_ns = before_ns
        motion = motion.since_misfit(self.matcher.misfit, self._since_fit_s(observation))
        priors = [self._prior(known, begin, ratio, one) for one in (motion, *motion.alternatives)]
        is_known = motion.is_measured and not motion.is_doubted
        new = novelty(between(self._seen_pose, predicted_then)) if is_known else 1.0
        match = self.matcher.match(surfaces, self._field, priors, novelty=new)
        believed = self._believes(match)
        reach = None if motion.is_measured else self._reach(match, observation)
        if reach is not None:
            again = self.relocalizer.anywhere(
                scan, surfaces, self._field, predicted_then, reach, match
            )
            if again is None:
                return self._lose(can_begin=True)
            match = again
        # At the first match the velocity is unknown, so that without wheels any motion is possible.
        elif (is_first or not believed) and (not is_known or self.matcher.misfit > 0.0):
            again = self.relocalizer.near(
                surfaces, self._field, predicted_then, self._turned_rad(is_known=is_known)
            )
            if again is not None and (not believed or _is_better(again, match)):
                match = again
        if not self._believes(match):
            return self._distrust(predicted, predicted_then, motion, match, scan, surfaces)
        if self._late_s != 0.0:
            match, T_then_now = self._with_first(match, scan, observation)
        if self._is_lost or (is_known and not match.weighs_sources):
            self.motion.skip()  # a jump, also where the wheels missed it, tells no velocity
            self.motion.inertia.reset()
        else:
            self._teach(match, T_then_now, motion)
        self._doubt.add(match, priors)
        tracking = self._hold(observation, compose(match.T_local_base, T_then_now), match)
        if self.keyframes.is_due(match.T_local_base):
            self._extend(match.T_local_base, scan, surfaces)
        return tracking

    def _prior(self, known: Matrix, before: Planar, ratio: float, motion: Motion) -> MotionPrior:
        """Return the prior of the pose after a share `ratio` of a motion from `before`."""
        T_prev_curr = from_transform(motion.T_prev_curr)
        noise = planar_covariance(motion.covariance)
        covariance = propagate(known, before, T_prev_curr, noise)
        return MotionPrior.of(compose(before, ratio * T_prev_curr), covariance, motion.probability)

    def _since_fit_s(self, observation: Observation) -> float:
        return 0.0 if self._fit_ns is None else (observation.stamp_ns - self._fit_ns) * 1e-9

    def _read(self, scan: LaserScan | None) -> SurfacePoints | None:
        if scan is None:
            return None
        surfaces = self.reader.read(scan)
        return surfaces if len(surfaces) >= self.beams_min else None

    def _reach(self, match: Match, observation: Observation) -> Planar | None:
        """Return how far (2,) [m, rad] the robot may be from a prediction that is vague, else None.

        After a gap between scans it may be outside of the matcher's window, by how it has moved so
        far. Directions that the scan does not measure follow the prediction, and do not count.
        """
        if self._held_ns is None:
            return None
        if observation.stamp_ns - self._held_ns <= self.predict_max_s * 1e9:
            return None
        H = match.information
        held = np.linalg.pinv(H, rcond=1e-9, hermitian=True) @ H
        covariance = held @ self._covariance @ held.T
        position_m2 = max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0)
        usual = self.motion.inertia.wandered((observation.stamp_ns - self._held_ns) * 1e-9)
        known = np.sqrt([position_m2, covariance[2, 2]])
        near = _REACH_SIGMAS * np.minimum(known, usual)
        is_within = near <= (self.matcher.window_m, self.matcher.window_rad)
        return None if is_within.all() else np.asarray(_REACH_SIGMAS * known)

    def _turned_rad(self, *, is_known: bool) -> float:
        """Return how far [rad] it may have turned; `is_known`: as the wheels did not, if at all."""
        assert self._stamp_ns is not None
        if is_known and self._held_ns is not None:
            return float(UNKNOWN_VELOCITY[1]) * (self._stamp_ns - self._held_ns) * 1e-9
        return float(np.sqrt(self._covariance[2, 2]))

    def _believes(self, match: Match) -> bool:
        return (
            match.inlier_ratio >= self.inlier_min_ratio
            and match.inliers >= self.beams_min // 2
            and bool(np.isfinite(match.T_local_base).all())
        )

    def _teach(self, match: Match, T_then_now: Planar, motion: Motion) -> None:
        """Calibrate the motion model by the motion since the last matched scan."""
        G = turn(-float(match.T_local_base[2]))
        known = np.linalg.inv(match.information + _UNSEEN) + self._held_covariance
        alone = compose(match.T_local_alone, T_then_now)
        self.motion.learn(
            to_transform(between(self._held_pose, alone)),
            spatial_covariance(G @ known @ G.T),
            motion.evidence(match.probabilities) if match.weighs_sources else None,
        )

    def _hold(self, observation: Observation, pose: Planar, match: Match | None) -> Tracking:
        """Accept a pose that was measured by a scan."""
        weak = match is not None and match.weak_directions > 0
        if match is None:
            self.motion.skip()
        self._pose, self._held_pose, self._held_ns = pose, pose, observation.stamp_ns
        self._failures, self._is_lost = 0, False
        if match is not None:
            self._covariance = match.covariance + np.diag(_DEVIATION_MIN**2)
            self._held_covariance = self._covariance
            self._seen_pose = match.T_local_base
        return self._answer(
            TrackingStatus.DEGRADED if weak else TrackingStatus.TRACKING,
            quality_ratio=1.0 if match is None else match.inlier_ratio,
            inliers=0 if match is None else match.inliers,
        )

    def _predict(self, observation: Observation, predicted: Planar, motion: Motion) -> Tracking:
        """Continue without a scan: short gaps between scans are normal, longer ones are not."""
        since_ns = None if self._held_ns is None else observation.stamp_ns - self._held_ns
        if since_ns is not None and since_ns <= self.predict_max_s * 1e9:
            return self._guess(predicted, TrackingStatus.TRACKING)
        if motion.is_measured:
            return self._guess(predicted, TrackingStatus.DEGRADED)
        return self._lose(can_begin=False)

    def _distrust(
        self,
        predicted: Planar,
        predicted_then: Planar,
        motion: Motion,
        match: Match,
        scan: LaserScan,
        surfaces: SurfacePoints,
    ) -> Tracking:
        """Continue without the match: by dead reckoning, or else as lost.

        `predicted_then` is the pose at the scan.
        """
        self._failures += 1
        if not motion.is_measured:
            return self._lose(can_begin=True)
        unknown = match.overlap_ratio < _OVERLAP_MIN_RATIO or self._failures >= _FAILURES_MAX
        if unknown and self.keyframes.is_due(predicted_then):
            self._extend(predicted_then, scan, surfaces)
            self._failures = 0
        return self._guess(predicted, TrackingStatus.DEGRADED)

    def _guess(
        self, predicted: Planar, status: TrackingStatus, *, can_begin: bool = False
    ) -> Tracking:
        """Continue from a pose that was not measured."""
        self._pose = predicted
        return self._answer(status, quality_ratio=0.0, inliers=0, can_begin=can_begin)

    def _lose(self, *, can_begin: bool) -> Tracking:
        """Stay at the last tracked pose; the robot may be anywhere that it can have come to."""
        self._is_lost = True
        lost_s = 0.0
        if self._stamp_ns is not None and self._held_ns is not None:
            lost_s = (self._stamp_ns - self._held_ns) * 1e-9
        moved = (UNKNOWN_VELOCITY * lost_s)[[0, 0, 1]]
        self._covariance = np.diag(moved**2) + self._held_covariance
        self.motion.stop()
        return self._guess(self._held_pose, TrackingStatus.LOST, can_begin=can_begin)

    def _answer(
        self, status: TrackingStatus, *, quality_ratio: float, inliers: int, can_begin: bool = False
    ) -> Tracking:
        """Return the answer with the newest pose, and its covariances unless it is LOST."""
        assert self._stamp_ns is not None
        drift = self._doubt.covariance(self._pose)  # which goes on from there, also if LOST
        is_lost = status is TrackingStatus.LOST
        return Tracking(
            stamp_ns=self._stamp_ns,
            T_local_base=to_transform(self._pose),
            status=status,
            covariance=None if is_lost else self._in_base(self._covariance, _LEVEL_DEVIATION**2),
            map_covariance=None if is_lost else self._in_base(drift, 0.0),
            quality_ratio=quality_ratio,
            inliers=inliers,
            can_begin=can_begin,
        )

    def _in_base(self, covariance: Matrix, level: float) -> NDArray[np.float64]:
        """Return the (6, 6) covariance in base's axes of one in those of local."""
        G = turn(-float(self._pose[2]))
        return spatial_covariance(G @ covariance @ G.T, level)

    def _move_first(self, T_local_base: Planar, *, is_known: bool) -> None:
        """Move the first keyframe, while it is the only one, to the pose at its scan."""
        (first,), late_s = self.keyframes.frames, self._late_s
        self.keyframes.clear()
        self._extend(T_local_base, first.scan, self.reader.read(first.scan))
        self._late_s = 0.0 if is_known else late_s

    def _with_first(
        self, match: Match, scan: LaserScan, observation: Observation
    ) -> tuple[Match, Planar]:
        """Return the first match as it is after the first keyframe moves with it, and T_then_now.

        Nothing but this match tells the velocity within the first sweep.
        """
        (first,) = self.keyframes.frames
        since_s = max((scan.stamp_ns - first.scan.stamp_ns) * 1e-9, abs(self._late_s))
        velocity_s = between(first.T_local_base, match.T_local_base) / since_s
        T_local_first = compose(self._held_pose, self._late_s * velocity_s)
        self._move_first(T_local_first, is_known=True)
        pose, alone = (
            compose(T_local_first, between(first.T_local_base, T_local_then))
            for T_local_then in (match.T_local_base, match.T_local_alone)
        )
        moved = replace(match, T_local_base=pose, T_local_alone=alone)
        return moved, -_late_s(scan, observation) * velocity_s

    def _extend(self, T_local_base: Planar, scan: LaserScan, surfaces: SurfacePoints) -> None:
        """Make the scan a keyframe."""
        self._late_s = 0.0
        self.keyframes.add(ScanKeyframe(T_local_base=T_local_base, scan=scan), surfaces)
        self._field = LikelihoodField(
            self.keyframes.latest(),
            self.resolution_m,
            self.keyframes.free(self.reader.T_base_laser, self.reader.range_max_m),
        )


def _is_better(match: Match, other: Match) -> bool:
    """Tell whether a match is another pose than the other, and more of the scan fits there."""
    is_other = is_apart(difference(match.T_local_base, other.T_local_base))
    return is_other and match.inliers > other.inliers


def _late_s(scan: LaserScan, observation: Observation) -> float:
    """Return how much later a scan is than its observation, at most half of the slowest sweep."""
    late_s = (scan.stamp_ns - observation.stamp_ns) * 1e-9
    return min(max(late_s, -SWEEP_MAX_S / 2), SWEEP_MAX_S / 2)


def _share(stamp_ns: int, before_ns: int | None, now_ns: int) -> float:
    """Return the position of a stamp between the last observation (0, or before) and this one (1).

    The middle of a sweep may be later, by half of the slowest one.
    """
    if before_ns is None or now_ns <= before_ns:
        return 1.0
    until_ns = min(stamp_ns, now_ns + round(SWEEP_MAX_S / 2 * 1e9))
    return max(until_ns - before_ns, 0) / (now_ns - before_ns)
