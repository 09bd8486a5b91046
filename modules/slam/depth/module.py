"""The `depth` SLAM module: a hand-held or driven depth camera in 6-DoF, in light or darkness."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sceneslam.motion.predictor import Prediction, Predictor
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.maps import MapLayers, PointLayer
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.ranges import Checked, check_above, check_inside, ranged
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory

from ..camera_certainty import CameraCertainty
from ..frame_log import FrameLog
from ..local import LocalModule
from ..surfaces.registration import CameraPrior, Samples, SurfaceRegistration, samples_of
from ..surfaces.surface import DepthSurfaceReader, Doubles, Surface
from .keyframe_map import KeyframeMap
from .localizer import DepthLocalizer
from .pose_graph import DepthPoseGraph

_SAMPLES_MIN = 100


@dataclass(kw_only=True, eq=False)
class DepthSlam(LocalModule, Checked):
    """Registers depth images with keyframes; settings as in `conf/slam/depth.yaml`."""

    keyframe_overlap_ratio: float = ranged(check_inside, 0, 1)
    matched_min_ratio: float = ranged(check_inside, 0, 1)
    weak_ratio: float = ranged(check_inside, 0, 1)
    cloud_voxel_m: float = ranged(check_above, 0)
    _predictor: Predictor = field(init=False)
    _map: KeyframeMap = field(init=False)

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return depth; odometry and gyro are used when present."""
        return (frozenset({Sensor.DEPTH}),)

    @property
    def keyframe_count(self) -> int:
        """Return the number of keyframes; each takes 0.5 MB."""
        return len(self._map)

    def activate(self, rig: Rig) -> None:
        """Start a session with an empty map; raises InputError for a rig without a camera."""
        if rig.camera is None:
            raise InputError("rig: depth needs the camera's intrinsics, got none")
        self._camera = rig.camera
        self._reader = DepthSurfaceReader(rig.camera)
        self._map = KeyframeMap(self._reader.grid)
        self._graph = DepthPoseGraph(self._map, weak_ratio=self.weak_ratio)
        self._localizer = DepthLocalizer(
            self._map, matched_min_ratio=self.matched_min_ratio, weak_ratio=self.weak_ratio
        )
        self._certainty = CameraCertainty(rig.camera.T_base_cam)
        self._frames = FrameLog()
        self._predictor = Predictor(rig)
        self._reference, self._revision = 0, 0

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m] at the observation."""
        prediction = self._predictor.predict(observation)
        if observation.depth_m is None:
            can_coast = len(self._map) > 0
            return self._answer(
                self._predictor.bridged(observation, prediction, can_coast=can_coast)
            )
        self._camera.check_size("depth_m", observation.depth_m)
        surface = self._reader.read(observation.depth_m)
        samples = samples_of(surface, self._reader.grid)
        if len(samples) < _SAMPLES_MIN:
            return self._answer(self._predictor.bridged(observation, prediction))
        if not len(self._map):
            return self._start(observation, surface, samples, prediction)
        found = self._locate(observation, samples, surface, prediction)
        if found is None:
            can_begin = bool(samples.localizability().ratios[0] >= self.weak_ratio)
            return self._answer(
                self._predictor.bridged(observation, prediction, can_begin=can_begin)
            )
        return self._hold(observation, surface, samples, prediction, found)

    def get_trajectory(self) -> Trajectory:
        """Return all poses after a last optimisation."""
        self._graph.finish()
        return self._frames.trajectory(
            {index: keyframe.T_local_cam for index, keyframe in enumerate(self._map.keyframes)}
        )

    def get_map(self) -> MapLayers:
        """Return the keyframes' cloud in `local`."""
        return MapLayers(points=PointLayer(points=self._map.cloud(self.cloud_voxel_m)))

    def _start(
        self, observation: Observation, surface: Surface, samples: Samples, prediction: Prediction
    ) -> Tracking:
        """Make the first keyframe of the session."""
        T_local_cam = prediction.T_local_base @ self._camera.T_base_cam
        self._add_keyframe(surface, T_local_cam, prediction.covariance)
        status = TrackingStatus.DEGRADED if self._predictor.is_lost else TrackingStatus.TRACKING
        T_local_base = prediction.T_local_base
        self._predictor.measure(observation, T_local_base, prediction.covariance)
        tracking = self._predictor.tracking(
            observation, T_local_base, status, quality_ratio=1.0, inliers=len(samples)
        )
        return self._answer(tracking)

    def _locate(
        self, observation: Observation, samples: Samples, surface: Surface, prediction: Prediction
    ) -> SurfaceRegistration | None:
        prior = self._prior(prediction)
        before = None
        if not prediction.is_measured:
            before = self._predictor.T_local_measured @ self._camera.T_base_cam
        after_gap = self._predictor.is_long_unmeasured(observation)
        return self._localizer.locate(samples, surface, prior, before, after_gap=after_gap)

    def _prior(self, prediction: Prediction) -> CameraPrior:
        T_cam_base = se3.inverse(self._camera.T_base_cam)
        information = np.linalg.inv(se3.carried(prediction.covariance, T_cam_base))
        T_local_cam = prediction.T_local_base @ self._camera.T_base_cam
        return CameraPrior(T_local_cam, np.asarray(information, np.float64))

    def _hold(
        self,
        observation: Observation,
        surface: Surface,
        samples: Samples,
        prediction: Prediction,
        found: SurfaceRegistration,
    ) -> Tracking:
        T_base_cam = self._camera.T_base_cam
        back = se3.adjoint(se3.inverse(T_base_cam))
        self._certainty.follow(
            common_ratio=found.common_ratio,
            misfit=found.misfit,
            T_keyframe_cam=found.T_keyframe_cam,
            away2_m2=float(np.median((samples.points**2).sum(axis=1))),
        )
        covariance = np.linalg.inv(found.information + self._prior(prediction).information)
        self._predictor.measure(
            observation,
            found.T_local_cam @ se3.inverse(T_base_cam),
            se3.carried(covariance, T_base_cam),
            information=back.T @ found.information @ back,
        )
        self._extend(surface, samples, found.T_local_cam)
        is_open = found.localizability.ratios[0] < self.weak_ratio
        status = TrackingStatus.DEGRADED if is_open else TrackingStatus.TRACKING
        tracking = self._predictor.tracking(
            observation,
            self._predictor.T_local_base,
            status,
            quality_ratio=found.matched_ratio,
            inliers=found.matched,
        )
        return self._answer(tracking)

    def _extend(self, surface: Surface, samples: Samples, T_local_cam: se3.Transform) -> None:
        """Add the image to the map: as a new keyframe, or fused into an existing one."""
        overlaps = self._map.overlaps(samples, T_local_cam)
        best = overlaps[0]
        self._reference = best.index
        if best.ratio < self.keyframe_overlap_ratio:
            self._add_keyframe(surface, T_local_cam, self._predictor.covariance)
            return
        self._map[best.index].fuse(surface, T_local_cam, self._map.grid)
        if self._graph.advance():
            T_cam_local = self._map[best.index].T_cam_local
            self._graph.solve()
            T_new_old = self._map[best.index].T_local_cam @ T_cam_local
            self._predictor.correct(T_new_old)
            self._revision += 1

    def _add_keyframe(
        self, surface: Surface, T_local_cam: se3.Transform, covariance: Doubles
    ) -> None:
        """Add a keyframe at a pose by the last reference, with its covariance (6, 6), in base."""
        tracked_by, self._reference = self._reference, self._map.add(surface, T_local_cam)
        in_cam = se3.carried(covariance, se3.inverse(self._camera.T_base_cam))
        self._graph.connect(self._reference, in_cam, tracked_by=tracked_by)

    def _answer(self, tracking: Tracking) -> Tracking:
        """Return the answer with the map's revision and certainty; its pose joins the frames."""
        covariance = tracking.covariance
        if covariance is not None:  # it has a pose
            covariance = self._certainty.covariance(covariance)
            if len(self._map):
                T_key_base = self._map[self._reference].T_cam_local @ tracking.T_local_base
                self._frames.add(tracking.stamp_ns, self._reference, T_key_base)
        return replace(tracking, covariance=covariance, revision=self._revision)
