"""Extract an observation's features and correct them for the rolling shutter."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.predictor import Predictor
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

from ..locate.localizer import VisualFix, VisualLocalizer
from ..map.keyframes import OdometryPose
from ..map.shifts import shifts_px_per_s
from ..map.visual_map import VisualMap
from .features import FeatureExtractor
from .shutter import RollingShutter, Turning, moves_px_per_s
from .turn_rate import TurnRate, measured_rate
from .view import View

_ROW_STEP = 32  # rows that are compared first
_ROUNDS = 2  # of correcting and matching again if the turn rate was unknown


class RectifyingExtractor:
    """Finds features and corrects the rolling shutter, which it calibrates by the poses found."""

    def __init__(
        self, visual_map: VisualMap, localizer: VisualLocalizer, extractor: FeatureExtractor
    ) -> None:
        self._landmarks, self._camera = visual_map.landmarks, visual_map.camera
        self._localizer = localizer
        self._extractor, self.shutter = extractor, RollingShutter(visual_map.camera)
        self.twist_per_s = np.zeros(6)  # of the newest pose, see Turning
        self._last_bgr: NDArray[np.uint8] | None = None

    def is_repeated(self, image_bgr: NDArray[np.uint8]) -> bool:
        """Tell whether an image (H, W, 3) equals the last one bit by bit, which noise rules out.

        Then the camera or its driver hangs, and nothing was measured.
        """
        last, self._last_bgr = self._last_bgr, image_bgr
        if last is None or not np.array_equal(last[::_ROW_STEP], image_bgr[::_ROW_STEP]):
            return False
        return np.array_equal(last, image_bgr)

    def look(
        self,
        observation: Observation,
        image_bgr: NDArray[np.uint8],
        *,
        T_predicted: Transform,
        rate_base: NDArray[np.float64],
        odometry: OdometryPose | None,
    ) -> View:
        """Return the view of an image taken while the base turned at `rate_base` (3,) [rad/s]."""
        gray = np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        features = self._extractor.extract(gray, observation.depth_m)
        turning = Turning(
            rate_cam=self._camera.T_base_cam[:3, :3].T @ rate_base, twist_per_s=self.twist_per_s
        )
        return View(
            observation=observation,
            image_bgr=image_bgr,
            features=self.shutter.straighten(features, turning.rate_cam),
            T_predicted=T_predicted,
            turning=turning,
            odometry=odometry,
        )

    def settle(self, view: View, fix: VisualFix, predictor: Predictor) -> tuple[View, VisualFix]:
        """Return the view and its pose, corrected by the turn rate that the pose gives."""
        turn = measured_rate(view.observation, predictor, fix.estimate.T_local_base)
        if self.shutter.readout_s and turn.is_unknown:
            for _ in range(_ROUNDS):
                view, fix = self._turn(view, fix, turn)
                fix = self._localizer.beside(view.features, fix) or fix
        view, fix = self._turn(view, fix, turn)
        return self._learn(view, fix), fix

    def _turn(self, view: View, fix: VisualFix, turn: TurnRate) -> tuple[View, VisualFix]:
        """Estimate the turn rate from the rows' residuals and the prior rate."""
        camera, seen = self._camera, fix.estimate.linearised
        rotation_cam_base = camera.T_base_cam[:3, :3].T
        change = rotation_cam_base @ turn.rate_base - view.turning.rate_cam
        uv_px = view.features.uv_px[fix.feature_rows]
        change, twist_cam = self.shutter.turn(seen, uv_px, change, turn.sigma_rad_per_s)
        features = self.shutter.straighten(view.features, change)
        moved = (features.uv_px[fix.feature_rows] - uv_px) / seen.sigma_px[:, None]
        residuals = seen.residuals - moved.T.ravel() + twist_cam @ seen.jacobian
        twist = se3.adjoint(camera.T_base_cam) @ twist_cam
        estimate = replace(
            fix.estimate,
            T_local_base=fix.estimate.T_local_base @ se3.exp(twist),
            linearised=replace(seen, residuals=residuals),
        )
        turning = replace(view.turning, rate_cam=view.turning.rate_cam + change)
        return replace(view, features=features, turning=turning), replace(fix, estimate=estimate)

    def _learn(self, view: View, fix: VisualFix) -> View:
        """Update the readout time; return the view with its pose's derivative by it."""
        uv_px = view.features.uv_px[fix.feature_rows]
        slope_px = moves_px_per_s(self._camera, uv_px, view.turning.rate_cam)
        slope_px -= shifts_px_per_s(
            self._landmarks, self._camera, fix.estimate.T_local_base, fix.landmark_ids
        )
        twist_cam = self.shutter.learn(fix.estimate.linearised, slope_px)
        self.twist_per_s = se3.adjoint(self._camera.T_base_cam) @ twist_cam
        return replace(view, turning=replace(view.turning, twist_per_s=self.twist_per_s))
