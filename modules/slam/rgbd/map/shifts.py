"""The shift of landmarks by a longer readout time (see `shutter`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from ..see.shutter import moves_px_per_s
from .keyframes import NO_LANDMARK, Keyframe
from .landmarks import LandmarkTable

_NEAREST_M = 0.1


def shifts_px_per_s(
    landmarks: LandmarkTable,
    camera: Camera,
    T_local_base: Transform,
    landmark_ids: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the landmarks' pixel shifts (N, 2) for a fixed camera, per second of readout."""
    T_local_cam = T_local_base @ camera.T_base_cam
    points_local = landmarks.points_local.take(landmark_ids, axis=0)
    points_cam = se3.apply(se3.inverse(T_local_cam), points_local)
    shift_cam = landmarks.shift_local.take(landmark_ids, axis=0) @ T_local_cam[:3, :3]
    z = np.maximum(points_cam[:, 2:], _NEAREST_M)
    across = shift_cam[:, :2] - points_cam[:, :2] / z * shift_cam[:, 2:]
    return np.asarray(across / z * [camera.fx, camera.fy])


def learn_shifts(landmarks: LandmarkTable, camera: Camera, keyframe: Keyframe) -> None:
    """Update the landmarks' shifts per second of readout by a keyframe."""
    rows, turning = np.flatnonzero(keyframe.landmark_ids != NO_LANDMARK), keyframe.turning
    ids = keyframe.landmark_ids[rows]
    T_local_cam = keyframe.T_local_base @ camera.T_base_cam
    points_cam = se3.apply(se3.inverse(T_local_cam), landmarks.points_local[ids])
    moves_px = moves_px_per_s(camera, keyframe.features.uv_px[rows], turning.rate_cam)
    shift_cam = np.zeros((len(rows), 3))
    shift_cam[:, :2] = moves_px / [camera.fx, camera.fy] * points_cam[:, 2:]
    twist_cam = se3.adjoint(se3.inverse(camera.T_base_cam)) @ turning.twist_per_s
    shift_cam += twist_cam[:3] + np.cross(twist_cam[3:], points_cam)
    landmarks.shift(ids, shift_cam @ T_local_cam[:3, :3].T)
