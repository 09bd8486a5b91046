"""Rolling shutter: rows are read one after the other while the camera turns.

The readout time is estimated from the residuals of a turning camera (after Ringaby and Forssen
2011, who measured 26 ms for a Kinect).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

from ..locate.pose_solver import Linearised
from .features import Features

_FIRST_SIGMA_S = 0.02  # of the readout, before the first image
_CORRELATED = 30.0  # residuals of one image with common errors
_LAST_SIGMA_S = 0.001  # forgetting keeps the deviation above this, as earlier poses were worse
_MAX_READOUT_S = 0.04
_SIGNIFICANT = 3.0  # sigmas
_STEP_S = 0.002  # smaller changes are not applied to the map


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Turning:
    """A camera's turn rate during readout, and its effect on the pose."""

    rate_cam: NDArray[np.float64]  # (3,) [rad/s]
    twist_per_s: NDArray[np.float64]  # (6,) of the base, per second of longer readout


class RollingShutter:
    """Moves features to their pixels in a global-shutter camera."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._information, self._pull = _FIRST_SIGMA_S**-2, 0.0  # of the readout [1/s^2, 1/s]
        self.readout_s = 0.0  # from the first row to the last, as applied so far

    def straighten(self, features: Features, rate_cam: NDArray[np.float64]) -> Features:
        """Return features at the time of the middle row, for a turn rate (3,) [rad/s]."""
        return straightened(self._camera, features, rate_cam, self.readout_s)

    def turn(
        self,
        seen: Linearised,
        uv_px: NDArray[np.float64],
        change: NDArray[np.float64],
        sigma_rad_per_s: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the change of turn rate (3,) and the pose's twist (6,) that fit an image best.

        `change` (3,) [rad/s]: the prior turn rate minus the one for which the image was corrected.
        """
        if not self.readout_s:
            return change, np.zeros(6)
        moves = [moves_px_per_s(self._camera, uv_px, axis) for axis in np.eye(3)]
        slopes = self.readout_s * np.stack([(m / seen.sigma_px[:, None]).T.ravel() for m in moves])
        weight = _CORRELATED / sigma_rad_per_s**2
        across = slopes @ seen.jacobian.T
        # The pose is eliminated (Schur complement).
        normal = slopes @ slopes.T - across @ np.linalg.solve(seen.normal, across.T)
        pull = slopes @ seen.residuals + weight * change
        found = np.linalg.solve(normal + weight * np.eye(3), pull)
        return np.asarray(found), seen.follow(found @ slopes)

    def learn(self, seen: Linearised, slope_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Update by an image's residuals; return its pose's derivative by the readout time.

        `slope_px` (N, 2): the pixels' shift relative to their landmarks, per second of readout.
        Returns a twist of the camera per second (6,). Shifts that a camera motion explains as well
        do not count for the readout.
        """
        slope = (slope_px / seen.sigma_px[:, None]).T.ravel()
        twist = seen.follow(slope)
        information = float(slope @ slope - twist @ seen.jacobian @ slope) / _CORRELATED
        kept = max(0.0, 1.0 - information * _LAST_SIGMA_S**2)
        self._information = kept * self._information + information
        self._pull = (
            kept * self._pull
            + information * self.readout_s
            + float(slope @ seen.residuals) / _CORRELATED
        )
        return twist

    def step_s(self) -> float:
        """Apply the new readout time, if it changed enough; return the change [s]."""
        readout_s = self._pull / self._information
        is_known = abs(readout_s) > _SIGNIFICANT * self._information**-0.5
        readout_s = float(np.clip(readout_s, -_MAX_READOUT_S, _MAX_READOUT_S))
        change_s = readout_s - self.readout_s if is_known else 0.0
        if abs(change_s) < _STEP_S:
            return 0.0
        self.readout_s = readout_s
        return change_s


def straightened(
    camera: Camera, features: Features, rate_cam: NDArray[np.float64], readout_s: float
) -> Features:
    """Return features at the time of the middle row, for a turn rate (3,) [rad/s]."""
    if not readout_s or not len(features):
        return features
    moves_px = readout_s * moves_px_per_s(camera, features.uv_px, rate_cam)
    return replace(features, uv_px=features.uv_px + moves_px)


def moves_px_per_s(
    camera: Camera, uv_px: NDArray[np.float64], rate_cam: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shift (N, 2) of pixels to the middle row's time, per second of readout."""
    x = (uv_px[:, 0] - camera.cx) / camera.fx
    y = (uv_px[:, 1] - camera.cy) / camera.fy
    late = uv_px[:, 1] / camera.size_wh[1] - 0.5
    wx, wy, wz = rate_cam
    # A ray that was seen late, in the camera as it was earlier: ray + late * rate x ray.
    across = wy - wz * y - x * (wx * y - wy * x)
    down = wz * x - wx - y * (wx * y - wy * x)
    return np.stack([camera.fx * late * across, camera.fy * late * down], axis=1)
