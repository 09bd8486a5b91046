"""Rolling shutters: rows are read one after the other, while the camera turns.

How long reading takes is learnt from the residuals that a turning camera leaves (after Ringaby
and Forssen 2011, who measured 26 ms for a Kinect).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

from .features import Features
from .pose_solver import Linearised

_FIRST_SIGMA_S = 0.02  # of the readout, before anything was seen
_CORRELATED = 30.0  # residuals of one image that say the same
_KEPT = 0.98  # from image to image: what was learnt first, of an untrue map, is forgotten
_MAX_READOUT_S = 0.04
_SIGNIFICANT = 3.0  # sigmas


class RollingShutter:
    """Puts features where a camera that reads all rows at once would have seen them."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._information, self._pull = _FIRST_SIGMA_S**-2, 0.0  # of the readout [1/s^2, 1/s]

    @property
    def readout_s(self) -> float:
        """Return the time from the first row to the last; 0 until it is known to be any."""
        readout_s = self._pull / self._information
        if abs(readout_s) < _SIGNIFICANT * self._information**-0.5:
            return 0.0
        return float(np.clip(readout_s, -_MAX_READOUT_S, _MAX_READOUT_S))

    def straighten(self, features: Features, rate_cam: NDArray[np.float64]) -> Features:
        """Return features as of the middle row, for a camera that turns by (3,) [rad/s]."""
        if not self.readout_s or not len(features):
            return features
        moves = self.readout_s * self._moves_px_per_s(features.uv_px, rate_cam)
        return replace(features, uv_px=features.uv_px + moves)

    def learn(
        self, seen: Linearised, uv_px: NDArray[np.float64], rate_cam: NDArray[np.float64]
    ) -> None:
        """Take in an image's residuals, at the readout that it was straightened with."""
        slope = (self._moves_px_per_s(uv_px, rate_cam) / seen.sigma_px[:, None]).T.ravel()
        # What a motion of the camera explains as well tells nothing about the shutter.
        explained = np.linalg.solve(seen.jacobian @ seen.jacobian.T, seen.jacobian @ slope)
        slope = slope - explained @ seen.jacobian
        information = float(slope @ slope) / _CORRELATED
        self._information = _KEPT * self._information + information
        self._pull = (
            _KEPT * self._pull
            + information * self.readout_s
            + float(slope @ seen.residuals) / _CORRELATED
        )

    def _moves_px_per_s(
        self, uv_px: NDArray[np.float64], rate_cam: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return how features (N, 2) move to the middle row's time, per second of readout."""
        camera = self._camera
        x = (uv_px[:, 0] - camera.cx) / camera.fx
        y = (uv_px[:, 1] - camera.cy) / camera.fy
        late = uv_px[:, 1] / camera.size_wh[1] - 0.5
        wx, wy, wz = rate_cam
        # A ray that was seen late, in the camera as it was earlier: ray + late * rate x ray.
        across = wy - wz * y - x * (wx * y - wy * x)
        down = wz * x - wx - y * (wx * y - wy * x)
        return np.stack([camera.fx * late * across, camera.fy * late * down], axis=1)
