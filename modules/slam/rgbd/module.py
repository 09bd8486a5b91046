"""RGB-D SLAM for lit, textured scenes: ORB features tracked against a map of keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.predictor import Prediction, Predictor
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

from ..local import LocalModule
from .adjust.odometry_constraints import OdometryIntegrator, led
from .adjust.renewal import NEWEST, LocatedView, renew, seen_by
from .locate.localizer import VisualFix
from .parts import RgbdParts
from .see.alignment import Alignment
from .see.turn_rate import expected_rate
from .see.view import View
from .settings import RgbdSettings

_START_VARIANCE = 1e-8  # the map begins at its first pose


@dataclass(kw_only=True, eq=False)
class RgbdSlam(LocalModule, RgbdSettings):
    """Tracks a camera with or without depth: the map and its scale stay when depth is missing.

    After ORB-SLAM2's front end (Mur-Artal and Tardos 2017). Without depth, new landmarks are
    triangulated, with the scale of odometry or of the existing map. It closes the loops of its own
    map. The fields are the settings; `conf/slam/rgbd.yaml` describes each one.
    """

    monocular_scenes: list[str]
    closes_loops: ClassVar[bool] = True
    _ignores_depth: bool = field(default=False, init=False)
    _T_local_base: Transform = field(default_factory=se3.identity, init=False)

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sensor sets: colour with any sensor that gives the scale."""
        scales = (Sensor.DEPTH, Sensor.ODOMETRY)
        return tuple(frozenset({Sensor.IMAGE, scale}) for scale in scales)

    def activate(self, rig: Rig) -> None:
        """Start with an empty map; raises InputError for a rig without a camera."""
        if rig.camera is None:
            raise InputError("rig: rgbd needs the camera's intrinsics, got none")
        self._camera: Camera = rig.camera
        self._predictor, self._odometry = Predictor(rig), OdometryIntegrator()
        self._parts = RgbdParts(self, self._camera, None)
        self._T_local_base = se3.identity()
        self._held_ids = np.zeros(0, np.int64)  # landmarks that support the newest pose
        self._observations, self._is_lost = 0, False

    def set_scene(self, scene: str) -> None:
        """Set the scene; in `monocular_scenes` depth is not used."""
        self._ignores_depth = scene in self.monocular_scenes

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base at the observation; LOST if the image does not show the map."""
        if observation.image_bgr is not None:
            self._camera.check_size("image_bgr", observation.image_bgr, 3)
        if observation.depth_m is not None:
            self._camera.check_size("depth_m", observation.depth_m)
        if self._ignores_depth:
            observation = replace(observation, depth_m=None)
        self._observations += 1
        self._recall()
        prediction = self._predictor.predict(observation)
        odometry = self._odometry.add(prediction)
        if observation.image_bgr is None:
            return self._lose(observation, prediction)
        if self._parts.eye.is_repeated(observation.image_bgr):
            return self._repeat(observation, prediction)
        view = self._parts.eye.look(
            observation,
            observation.image_bgr,
            T_predicted=prediction.T_local_base,
            rate_base=expected_rate(observation, self._predictor),
            odometry=odometry,
        )
        fix = None
        if len(self._parts.map.keyframes):
            fix = self._parts.search.find(view, self._held_ids, is_lost=self._is_lost)
        if fix is not None:
            view, fix = self._parts.eye.settle(view, fix, self._predictor)
            answer = self._hold(view, fix, prediction)
            if self._parts.mapping.alignment is not None and not view.is_monocular:
                self._build_anew(view, self._parts.mapping.alignment)
            if answer is not None:
                return answer
        if not len(self._parts.map.keyframes) or self._is_unknown(view, prediction):
            return self._start(view, prediction)
        return self._lose(observation, prediction)

    def get_trajectory(self) -> Trajectory:
        """Return T_local_base of every tracked frame, corrected by all loops."""
        return self._parts.memory.trajectory()

    def get_map(self) -> MapLayers:
        """Return in `local` the cloud, a planar robot's grid, the pose graph and the landmarks."""
        parts = self._parts
        layers = parts.layers.build(list(parts.map.keyframes.all()))
        graph, landmarks = parts.memory.pose_graph(), parts.memory.landmarks()
        return replace(layers, pose_graph=graph, landmarks=landmarks)

    def shutdown(self) -> None:
        """Stop the workers; the map stays readable."""
        self._parts.mapping.shutdown()
        self._parts.memory.shutdown()

    def _build_anew(self, view: View, alignment: Alignment) -> None:
        """Rebuild the map from its views, as the old one assigned depths to wrong corners."""
        before, newest = self._parts, LocatedView(view=view, T_local_base=self._T_local_base)
        segment = before.memory.segment(self._held_ids)
        seen = seen_by(before.map.keyframes, before.mapping.beginning, segment, newest)
        before.mapping.shutdown()
        self._parts = RgbdParts(self, self._camera, alignment)
        poses = renew(self._parts, seen)
        self._parts.memory.follow(before.memory, poses)
        self._predictor.correct(poses[NEWEST] @ se3.inverse(self._T_local_base))
        self._T_local_base = poses[NEWEST]
        keyframes = self._parts.map.keyframes
        self._held_ids = keyframes.landmarks_of(keyframes.ids[-1:])

    def _recall(self) -> None:
        """Continue from the map as corrected by adjustment or loops."""
        for T_new_old in (self._parts.mapping.step(), self._parts.memory.step()):
            if T_new_old is not None:
                self._T_local_base = T_new_old @ self._T_local_base
                self._predictor.correct(T_new_old)

    def _is_unknown(self, view: View, prediction: Prediction) -> bool:
        is_far = self._parts.keyframe_rule.is_far(view.T_predicted, self._parts.map.keyframes)
        unmeasured_s = self._predictor.unmeasured_s(view.observation)
        return self._parts.place_rule.wants(
            view, prediction, unmeasured_s=unmeasured_s, is_far=is_far
        )

    def _start(self, view: View, prediction: Prediction) -> Tracking:
        """Begin with a keyframe at the prediction; LOST until there is depth or odometry."""
        is_scaled = not view.is_monocular or view.observation.T_odom_base is not None
        if not (view.shows_enough and is_scaled):
            return self._lose(view.observation, prediction)
        begins = not len(self._parts.map.keyframes)
        is_placed = prediction.is_measured or begins
        guessed_s = None if is_placed else self._predictor.unmeasured_s(view.observation)
        self._hold_pose(view.observation, view.T_predicted, prediction.covariance)
        self._held_ids = self._parts.insert(
            view,
            self._T_local_base,
            set(),
            predicted=prediction.covariance,
            guessed_s=guessed_s,
        )
        self._parts.memory.hold(
            view.observation.stamp_ns, self._T_local_base, np.zeros(0, np.int64)
        )
        is_first = self._observations == 1  # the motion before it is known by odometry at best
        return self._answer(
            view.observation,
            TrackingStatus.TRACKING if is_first else TrackingStatus.DEGRADED,
            covariance=_START_VARIANCE * np.eye(6) if begins else prediction.covariance,
            inliers=view.features.deep_count,
        )

    def _hold(self, view: View, found: VisualFix, prediction: Prediction) -> Tracking | None:
        """Accept a pose, and extend the map if a keyframe is due; None if the gyro contradicts."""
        fix, seen = found, found.estimate.covariance
        if prediction.is_measured:
            fused = led(
                found,
                prediction,
                partial(self._parts.localizer.together, view.features, self._held_ids),
                turn_radps=self._turn_radps(view.observation),
                duration_s=self._predictor.unmeasured_s(view.observation),
            )
            if fused is None:
                return None
            fix = fused
        status = self._parts.health.judge(fix.estimate)
        # Over a few frames odometry is more accurate than a pose by few landmarks.
        is_by_odometry = status is TrackingStatus.DEGRADED and prediction.is_measured
        if is_by_odometry:
            T_local_base = view.T_predicted
            self._hold_pose(view.observation, T_local_base, prediction.covariance)
        else:
            T_local_base = fix.estimate.T_local_base
            # Without depth the scale comes from the wheels and cannot calibrate them.
            self._hold_pose(
                view.observation,
                T_local_base,
                fix.estimate.covariance,
                seen=None if view.is_monocular else seen,
            )
        self._held_ids = fix.landmark_ids
        self._parts.map.count_sightings(fix.expected_ids, fix.landmark_ids)
        segment = self._parts.memory.segment(fix.landmark_ids)
        rule, keyframes = self._parts.keyframe_rule, self._parts.map.keyframes
        waits, wanted = rule.waits(view), rule.wants(T_local_base, fix, keyframes, segment)
        is_known = status is TrackingStatus.TRACKING or (is_by_odometry and view.is_monocular)
        if wanted and is_known and not waits:
            self._held_ids = self._parts.insert(view, T_local_base, segment, fix=fix)
        self._parts.memory.hold(view.observation.stamp_ns, T_local_base, fix.landmark_ids)
        covariance = prediction.covariance
        if not is_by_odometry:
            around = self._parts.memory.around(T_local_base)
            covariance = self._parts.certainty.covariance(view, fix, T_local_base, around)
            if self._parts.health.is_unsure(covariance - self._parts.certainty.by_wheels):
                status = TrackingStatus.DEGRADED
        if segment is not None:  # that of its position counts, too
            guessed = self._parts.memory.segments.covariance(segment, T_local_base, covariance)
            if guessed is not None:
                status, covariance = TrackingStatus.DEGRADED, guessed
        return self._answer(
            view.observation,
            status,
            covariance=covariance,
            quality_ratio=min(1.0, fix.found_ratio(view.features)),
            inliers=len(fix.landmark_ids),
        )

    def _turn_radps(self, observation: Observation) -> float | None:
        """Return the turn rate by the gyro since the last observation, None without one."""
        duration_s = self._predictor.model.duration_s
        turn = observation.turn_by_gyro(duration_s)
        return None if turn is None else float(np.linalg.norm(turn)) / duration_s

    def _hold_pose(
        self,
        observation: Observation,
        T_local_base: Transform,
        covariance: NDArray[np.float64],
        *,
        seen: NDArray[np.float64] | None = None,
    ) -> None:
        self._T_local_base, self._is_lost = T_local_base, False
        self._parts.place_rule.restart()
        information = None if seen is None else np.asarray(np.linalg.inv(seen))
        self._predictor.measure(observation, T_local_base, covariance, information)

    def _repeat(self, observation: Observation, prediction: Prediction) -> Tracking:
        """Use odometry's pose, else the last one, as the image repeats the last one."""
        if self._is_lost or not len(self._parts.map.keyframes):
            return self._lose(observation, prediction)
        self._predictor.coast(prediction)
        if prediction.is_measured:
            self._T_local_base = prediction.T_local_base
        self._parts.memory.hold(observation.stamp_ns, self._T_local_base, np.zeros(0, np.int64))
        return self._answer(observation, TrackingStatus.DEGRADED, quality_ratio=0.0)

    def _lose(self, observation: Observation, prediction: Prediction) -> Tracking:
        self._predictor.lose(prediction)
        self._is_lost = True
        return self._answer(observation, TrackingStatus.LOST, quality_ratio=0.0)

    def _answer(self, observation: Observation, status: TrackingStatus, **more: Any) -> Tracking:
        """Return the answer with the newest pose; LOST: the last one that was tracked."""
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=self._T_local_base.copy(),
            status=status,
            revision=self._parts.memory.revision,
            **more,
        )
