"""Where the depth image shows what the colour image shows, when one was not made for the other.

A rig's depth should be registered to its colours. Recordings of raw Kinects come without that: the
depth camera sits 2.5 cm beside the colour camera and has a tenth more focal length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_ROUNDS = 3  # of looking up a depth and correcting where to look
_FAR = 1e-3  # [1/m], inverse depth where there is none


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """The colour camera, looked at from the depth camera, whose intrinsics the rig tells."""

    focal_ratio: float = 1.0  # focal length of the colour camera over that of the depth camera
    baseline_m: float = 0.0  # to the right

    @property
    def is_registered(self) -> bool:
        """Tell whether both images are of one camera."""
        return self == Alignment()

    @property
    def T_depth_color(self) -> Transform:
        """Return the colour camera's place in the depth camera."""
        return se3.from_parts(np.eye(3), np.array([self.baseline_m, 0.0, 0.0]))

    def color_camera(self, camera: Camera) -> Camera:
        """Return the camera that took the colours beside a depth camera."""
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
        """Return where (N, 2) depth images show what pixels (N, 2) of colours show.

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
    """Return depth images (M, H, W) at pixels (N, 2) of the images (N,); 0 outside of them."""
    height, width = depths_m.shape[1:]
    column, row = np.rint(uv_px).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth_m = depths_m[images, np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.asarray(np.where(inside & np.isfinite(depth_m), depth_m, 0.0), np.float64)
