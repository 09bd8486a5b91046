"""Features of an image with their points in space, where a depth camera measured them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.views.grey_noise import brightened

_FEATURES = 500  # per image
_FAST_MIN = 10  # least contrast of a corner
_NOISE_MAX = 3.0  # a corner's least contrast is three standard deviations
_FEWEST = 40  # located features of a view; with fewer no place is recognized


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Points that a camera saw, and their ORB descriptors (Rublee et al., ICCV 2011)."""

    points_base: NDArray[np.float32]  # (N, 3) [m], base of the view
    descriptors: NDArray[np.uint8]  # (N, 32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkView:
    """The features of one image."""

    rays: NDArray[np.float32]  # (N, 2): x / z and y / z in the camera frame, undistorted
    descriptors: NDArray[np.uint8]  # (N, 32)
    depth_m: NDArray[np.float32]  # (N,), along the optical axis, 0 = missing
    landmarks: Landmarks  # of the features with a depth
    shear_rad: float = 0.0  # between its first and last row, by the camera's turn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedView:
    """What a map keeps of a view."""

    stamp_ns: int
    T_submap_base: Transform  # where it was seen from
    landmarks: Landmarks


class LandmarkViewer:
    """Makes views of observations."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._orb = cv2.ORB.create(nfeatures=_FEATURES, fastThreshold=_FAST_MIN)

    @classmethod
    def of(cls, rig: Rig) -> LandmarkViewer | None:
        """Return the viewer of a rig, None without a camera that measures depth."""
        if rig.camera is None or not {Sensor.IMAGE, Sensor.DEPTH} <= rig.sensors:
            return None
        return cls(rig.camera)

    def look(self, observation: Observation, *, shear_rad: float = 0.0) -> LandmarkView | None:
        """Return the view of an observation.

        None with too few features, without image or depth, or of another size than the camera's.
        """
        image, depth_m, camera = observation.image_bgr, observation.depth_m, self._camera
        if image is None or depth_m is None:
            return None
        if image.shape[1::-1] != tuple(camera.size_wh) or image.shape[:2] != depth_m.shape:
            return None
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        grey = brightened(grey, noise_max=_NOISE_MAX)
        corners, found = self._orb.detectAndCompute(grey, None)
        if len(corners) < _FEWEST:
            return None
        descriptors = np.asarray(found, np.uint8)
        uv_px = np.array([corner.pt for corner in corners])
        column, row = np.rint(uv_px).astype(np.int64).T
        z = depth_m[row, column]
        z = np.where(camera.measures(z), z, np.float32(0.0))
        rays = cv2.undistortPoints(uv_px[:, None], camera.K, np.array(camera.distortion))[:, 0]
        seen = np.flatnonzero(z)
        if len(seen) < _FEWEST:
            return None
        points_cam = np.column_stack([rays[seen], np.ones(len(seen))]) * z[seen, None]
        points_base = se3.apply(camera.T_base_cam, points_cam)
        return LandmarkView(
            rays=rays.astype(np.float32),
            descriptors=descriptors,
            depth_m=z,
            landmarks=Landmarks(
                points_base=points_base.astype(np.float32), descriptors=descriptors[seen]
            ),
            shear_rad=shear_rad,
        )
