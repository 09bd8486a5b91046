"""The `direct` SLAM module: RGB-D tracking on pixels, frame to keyframe, without features.

Photometric and depth residuals are minimised by OpenCV's RGB-D odometry (after Steinbruecker, Sturm
and Cremers, "Real-Time Visual Odometry from Dense RGB-D Images", ICCVW 2011). It suits rooms with
few corners but shading. OpenCV takes no guess, and slides where an image says little: this module
holds its result against the predicted pose, and adds checks and a covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sceneslam.motion.predictor import Prediction, Predictor
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.ranges import Checked, check_above, check_inside, ranged
from sceneslam.types.rig import Rig, Sensor

from ..camera_certainty import CameraCertainty
from ..local import LocalModule
from .comparison import Comparison, compare
from .keyframes import DirectKeyframes
from .view import DirectView, Tracker

_PIXELS_MIN = 300  # smallest number of pixels that both views show
_FROZEN_NS = 100_000_000  # an image is repeated where one was lost, but not for longer


@dataclass(frozen=True, slots=True, eq=False)
class _Located:
    """The pose of a view, and its comparison with a reference view."""

    T_local_cam: se3.Transform
    comparison: Comparison


@dataclass(kw_only=True, eq=False)
class DirectSlam(LocalModule, Checked):
    """Registers images with depth; the settings are described in `conf/slam/direct.yaml`."""

    width_px: int = ranged(check_above, 0)
    keyframe_step_m: float = ranged(check_above, 0)
    keyframe_turn_rad: float = ranged(check_above, 0)
    step_max_m: float = ranged(check_above, 0)
    turn_max_rad: float = ranged(check_above, 0)
    matched_min_ratio: float = ranged(check_inside, 0, 1)
    weak_m: float = ranged(check_above, 0)
    weak_rad: float = ranged(check_above, 0)
    cloud_voxel_m: float = ranged(check_above, 0)

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return image and depth; odometry and gyro are used when present."""
        return (frozenset({Sensor.IMAGE, Sensor.DEPTH}),)

    def activate(self, rig: Rig) -> None:
        """Start a session with an empty map; raises InputError for a rig without a camera."""
        if rig.camera is None:
            raise InputError("rig: direct needs the camera's intrinsics, got none")
        self._camera = rig.camera
        self._tracker = Tracker(rig.camera, self.width_px, self.step_max_m, self.turn_max_rad)
        self._predictor = Predictor(rig)
        self._keyframes = DirectKeyframes(self._tracker, self.cloud_voxel_m)
        self._certainty = CameraCertainty(rig.camera.T_base_cam)
        self._new_ns = 0  # [ns] stamp at which the last image came first
        self._key: DirectView | None = None
        self._last: DirectView | None = None
        self._T_local_key = self._T_local_last = se3.identity()  # of cam

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m] at the observation."""
        tracking = self._follow(observation)
        if tracking.covariance is None:  # lost
            return tracking
        return replace(tracking, covariance=self._certainty.covariance(tracking.covariance))

    def _follow(self, observation: Observation) -> Tracking:
        """Return the answer by the noise of pixels alone."""
        prediction = self._predictor.predict(observation)
        image, depth_m = observation.image_bgr, observation.depth_m
        if image is None or depth_m is None:
            can_coast = self._key is not None
            return self._predictor.bridged(observation, prediction, can_coast=can_coast)
        self._camera.check_size("image_bgr", image, 3)
        self._camera.check_size("depth_m", depth_m)
        view = self._tracker.view(image, depth_m)
        can_begin = bool(np.count_nonzero(view.depth_m) >= _PIXELS_MIN)
        if self._key is None or self._last is None:
            if not can_begin:
                return self._predictor.bridged(observation, prediction)
            self._new_ns = observation.stamp_ns
            return self._begin(observation, prediction, view)
        if not view.shows_same(self._last):
            self._new_ns = observation.stamp_ns
        elif observation.stamp_ns - self._new_ns > _FROZEN_NS:
            return self._predictor.bridged(observation, prediction)
        found = self._locate(view, prediction.T_local_base @ self._camera.T_base_cam)
        if found is not None:
            return self._hold(observation, prediction, view, found)
        if prediction.is_measured and can_begin:
            return self._begin(observation, prediction, view)
        return self._predictor.bridged(observation, prediction, can_begin=can_begin)

    def get_map(self) -> MapLayers:
        """Return the keyframes' cloud, in `local`."""
        return MapLayers(points=self._keyframes.cloud())

    def _locate(self, view: DirectView, T_local_guess: se3.Transform) -> _Located | None:
        """Return the view's pose relative to the keyframe, else to the previous view.

        By OpenCV, which takes no guess, or by the guess of cam, where the views agree better.
        """
        candidates = ((self._key, self._T_local_key), (self._last, self._T_local_last))
        for other, T_local_other in candidates:
            T_other_cam = None if other is None else self._tracker.register(view, other)
            if other is None or T_other_cam is None:
                continue
            guess = se3.inverse(T_local_other) @ T_local_guess
            is_near = se3.is_within(guess, self.step_max_m, self.turn_max_rad)
            poses = [T_other_cam, guess] if is_near else [T_other_cam]
            tried = [(pose, compare(self._tracker, view, other, pose)) for pose in poses]
            agree = [one for one in tried if self._is_enough(one[1])]
            if agree:
                T_other_cam, found = min(agree, key=lambda one: one[1].misfit)
                return _Located(T_local_other @ T_other_cam, found)
        return None

    def _is_enough(self, found: Comparison) -> bool:
        """Tell whether enough is compared, and agrees."""
        return found.compared >= _PIXELS_MIN and found.matched_ratio >= self.matched_min_ratio

    def _begin(
        self, observation: Observation, prediction: Prediction, view: DirectView
    ) -> Tracking:
        """Make the first keyframe of the session, or after tracking was lost."""
        is_first = self._key is None
        is_known = is_first and not self._predictor.is_lost
        self._predictor.coast(prediction)
        T_local_base = prediction.T_local_base
        self._add_keyframe(view, T_local_base @ self._camera.T_base_cam)
        if is_first:
            self._predictor.measure(observation, T_local_base, prediction.covariance)
        status = TrackingStatus.TRACKING if is_known else TrackingStatus.DEGRADED
        return self._predictor.tracking(
            observation, T_local_base, status, quality_ratio=1.0 if is_first else 0.0
        )

    def _hold(
        self,
        observation: Observation,
        prediction: Prediction,
        view: DirectView,
        located: _Located,
    ) -> Tracking:
        """Return the pose fused from registration and prediction, weighted by their covariances."""
        found = located.comparison
        T_base_cam = self._camera.T_base_cam
        back = se3.adjoint(se3.inverse(T_base_cam))
        information = back.T @ found.information @ back
        covariance = np.asarray(np.linalg.inv(np.linalg.inv(prediction.covariance) + information))
        T_local_seen = located.T_local_cam @ se3.inverse(T_base_cam)
        off = se3.log(se3.inverse(prediction.T_local_base) @ T_local_seen)
        gain = covariance @ information
        T_local_base = se3.orthonormal(prediction.T_local_base @ se3.exp(gain @ off))
        self._predictor.measure(observation, T_local_base, covariance, information)
        T_local_cam = T_local_base @ T_base_cam
        T_key_cam = se3.inverse(self._T_local_key) @ T_local_cam
        self._certainty.follow(
            common_ratio=found.common_ratio,
            misfit=found.deeper_square,
            T_keyframe_cam=T_key_cam[None],
            away2_m2=found.away2_m2,
        )
        if not se3.is_within(T_key_cam, self.keyframe_step_m, self.keyframe_turn_rad):
            self._add_keyframe(view, T_local_cam)
        self._last, self._T_local_last = view, T_local_cam
        limits = np.repeat([self.weak_m, self.weak_rad], 3)
        is_weak = (np.diag(np.linalg.pinv(information, hermitian=True)) > limits**2).any()
        is_weak |= np.linalg.matrix_rank(information, hermitian=True) < 6
        status = TrackingStatus.DEGRADED if is_weak else TrackingStatus.TRACKING
        return self._predictor.tracking(
            observation,
            T_local_base,
            status,
            quality_ratio=found.matched_ratio,
            inliers=found.matched,
        )

    def _add_keyframe(self, view: DirectView, T_local_cam: se3.Transform) -> None:
        """Make the view the keyframe, and the last one that was tracked."""
        self._key = self._last = view
        self._T_local_key = self._T_local_last = T_local_cam
        self._keyframes.add(view, T_local_cam)
