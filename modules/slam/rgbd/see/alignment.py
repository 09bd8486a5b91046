"""Map colour pixels to depth pixels when the depth image is not registered to the colours.

A rig's depth should be registered to its colours. Raw Kinect recordings are not: the depth camera
is 2.5 cm beside the colour camera, and its focal length is 10 % longer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_ROUNDS = 3  # iterations: look up a depth, correct the pixel
_FAR = 1e-3  # [1/m], inverse depth assumed where depth is missing


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """The colour camera relative to the depth camera, whose intrinsics are the rig's."""

    focal_ratio: float = 1.0  # focal length of the colour camera over that of the depth camera
    baseline_m: float = 0.0  # to the right

    @property
    def is_registered(self) -> bool:
        """Tell whether both images have the same camera model and pose."""
        return self == Alignment()

    @property
    def T_depth_color(self) -> Transform:
        """Return T_depth_color (4, 4)."""
        return se3.from_parts(np.eye(3), np.array([self.baseline_m, 0.0, 0.0]))

    def color_camera(self, camera: Camera) -> Camera:
        """Return the colour camera's intrinsics, given the depth camera's."""
        return replace(
            camera,
            fx=self.focal_ratio * camera.fx,
            fy=self.focal_ratio * camera.fy,
            T_base_cam=camera.T_base_cam @ self.T_depth_color,
        )

    def find(
        self,
        camera: Camera,
        uv_px: NDArray[np.float64],
        depths_m: NDArray[np.float32],
        images: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Return the depth pixels (N, 2) that show the same points as colour pixels (N, 2).

        `camera` is the depth camera, `images` (N,) the row of each in `depths_m` (M, H, W).
        """
        centre = np.array([camera.cx, camera.cy])
        far_px = (uv_px - centre) / self.focal_ratio + centre
        inverse_m = np.full(len(uv_px), _FAR)
        found_px = far_px.copy()
        for _ in range(_ROUNDS):
            depth_m = look_up(depths_m, images, found_px)
            inverse_m = np.where(depth_m > 0, 1.0 / np.maximum(depth_m, 0.1), inverse_m)
            found_px[:, 0] = far_px[:, 0] + camera.fx * self.baseline_m * inverse_m
        return np.asarray(found_px)


def look_up(
    depths_m: NDArray[np.float32], images: NDArray[np.int64], uv_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return depths (N,) [m] at pixels (N, 2) of `images` (N,), rows of (M, H, W); 0 outside."""
    height, width = depths_m.shape[1:]
    column, row = np.rint(uv_px).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth_m = depths_m[images, np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.asarray(np.where(inside & np.isfinite(depth_m), depth_m, 0.0), np.float64)
