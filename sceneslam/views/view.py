"""Features of an image, with their points in space where these are known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.lens import undistorted_rays
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.views.grey_noise import brightened
from sceneslam.views.rays import directions

SIGMA_PX = 1.0  # standard deviation of a corner
NEAR_M = 0.1  # nothing nearer is in view
_FEATURES = 500  # per image
_FAST_MIN = 10  # least contrast of a corner
_MARGIN_PX = 16  # half a descriptor's patch: nearer to the border, on every scale, it is cut off
_NOISE_MAX = 3.0  # a corner's least contrast is three standard deviations
_FEWEST = 40  # features of a view; with fewer no place is recognized
_NOISE_M, _NOISE_RATIO = 0.017, 0.01  # of a measured depth, and of its distance: structured light


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Landmarks:
    """Points that a camera saw, and their ORB descriptors (Rublee et al., ICCV 2011)."""

    points_cam: NDArray[np.float32]  # (N, 3) [m]
    deviation_m: NDArray[np.float32]  # (N,) standard deviations of their distances
    descriptors: NDArray[np.uint8]  # (N, 32)

    def __len__(self) -> int:
        return len(self.points_cam)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkView:
    """The features of one image."""

    rays: NDArray[np.float32]  # (N, 2): x / z and y / z in the camera frame, undistorted
    descriptors: NDArray[np.uint8]  # (N, 32)
    depth_m: NDArray[np.float32]  # (N,), along the optical axis, 0 = missing
    shear_rad: float = 0.0  # between its first and last row, by the camera's turn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedView:
    """What a map keeps of a view."""

    stamp_ns: int
    T_submap_cam: Transform  # where it was seen from
    landmarks: Landmarks


class LandmarkViewer:
    """Makes views of observations."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._orb = cv2.ORB.create(
            nfeatures=_FEATURES, fastThreshold=_FAST_MIN, edgeThreshold=_MARGIN_PX
        )

    @classmethod
    def of(cls, rig: Rig) -> LandmarkViewer | None:
        """Return the viewer of a rig, None without a camera."""
        if rig.camera is None or Sensor.IMAGE not in rig.sensors:
            return None
        return cls(rig.camera)

    def look(self, observation: Observation, *, shear_rad: float = 0.0) -> LandmarkView | None:
        """Return the view of an observation.

        None with too few features, without an image, or of another size than the camera's.
        """
        image, depth_m, camera = observation.image_bgr, observation.depth_m, self._camera
        if image is None or image.shape[1::-1] != tuple(camera.size_wh):
            return None
        if depth_m is not None and depth_m.shape != image.shape[:2]:
            return None
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        grey = brightened(grey, noise_max=_NOISE_MAX)
        corners, found = self._orb.detectAndCompute(grey, None)
        if found is None:
            return None
        uv_px = np.array([corner.pt for corner in corners])
        rays = undistorted_rays(camera, uv_px)
        known = np.isfinite(rays[:, 0])
        uv_px, rays, found = uv_px[known], rays[known], np.asarray(found, np.uint8)[known]
        if len(rays) < _FEWEST:
            return None
        z = np.zeros(len(uv_px), np.float32)
        if depth_m is not None:
            column, row = np.rint(uv_px).astype(np.int64).T
            z = depth_m[row, column]
            z = np.where(camera.measures(z), z, np.float32(0.0))
        return LandmarkView(
            rays=rays.astype(np.float32),
            descriptors=found,
            depth_m=z,
            shear_rad=shear_rad,
        )

    def landmarks(
        self,
        view: LandmarkView,
        depth_m: NDArray[np.floating],
        deviation_m: NDArray[np.floating],
    ) -> Landmarks | None:
        """Return the features with a measured depth or else one of `depth_m` (N,), 0 = unknown.

        None with too few.
        """
        is_measured = view.depth_m > 0
        z = np.where(is_measured, view.depth_m, depth_m)
        known = np.flatnonzero(z)
        if len(known) < _FEWEST:
            return None
        points_cam = directions(view.rays[known]) * z[known, None]
        noise_m = np.where(is_measured[known], depth_noise_m(z[known]), deviation_m[known])
        return Landmarks(
            points_cam=points_cam.astype(np.float32),
            deviation_m=noise_m.astype(np.float32),
            descriptors=view.descriptors[known],
        )


def depth_noise_m(far_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the standard deviations (N,) of depths (N,) [m] by a depth camera."""
    return np.asarray(_NOISE_M + _NOISE_RATIO * far_m, np.float64)
