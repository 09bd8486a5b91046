"""Sensor data for the Rerun viewer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from sceneslam.ros.pixels import image_options
from sceneslam.ros.writer import depth_png
from sceneslam.sinks import rerun_layout as at
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform

if TYPE_CHECKING:
    import rerun as rr


class SensorLog:
    """Logs every n-th image, depth image and scan."""

    def __init__(self, every: Mapping[str, int], jpeg_quality: int) -> None:
        for name, count in every.items():
            if count < 1:
                raise ConfigError(f"{name}_every", count, "a whole number of observations from 1")
        self._every, self._jpeg = every, image_options("jpeg", jpeg_quality)
        self._count = 0

    def place(self, recording: rr.RecordingStream, rig: Rig) -> None:
        """Log the poses of the sensors on the robot."""
        import rerun as rr

        if rig.camera is not None:
            camera = rig.camera
            pinhole = rr.Pinhole(
                image_from_camera=camera.K, resolution=camera.size_wh, image_plane_distance=0.3
            )
            recording.log(at.CAMERA, pinhole, static=True)
            recording.log(at.CAMERA, _pose(camera.T_base_cam), static=True)
        if rig.laser is not None:
            recording.log(at.LASER, _pose(rig.laser.T_base_laser), static=True)

    def write(self, recording: rr.RecordingStream, observation: Observation) -> None:
        """Log the measurements of an observation that are due."""
        import rerun as rr

        if observation.image_bgr is not None and self._is_due("image"):
            _, jpeg = cv2.imencode(".jpg", observation.image_bgr, self._jpeg)
            image = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
            recording.log(f"{at.CAMERA}/image", image)
        if observation.depth_m is not None and self._is_due("depth"):
            png = depth_png(observation.depth_m).tobytes()
            depth = rr.EncodedDepthImage(png, media_type="image/png", meter=1000.0)
            recording.log(f"{at.CAMERA}/depth", depth)
        if observation.scan is not None and self._is_due("scan"):
            recording.log(f"{at.LASER}/scan", _cloud(observation.scan))
        self._count += 1

    def _is_due(self, sensor: str) -> bool:
        return self._count % self._every[sensor] == 0


def _pose(T_a_b: Transform) -> Any:
    import rerun as rr

    quaternion = rr.Quaternion(xyzw=se3.to_quat_xyzw(T_a_b))
    return rr.Transform3D(translation=T_a_b[:3, 3], quaternion=quaternion)


def _cloud(scan: LaserScan) -> Any:
    import rerun as rr

    hit = np.isfinite(scan.ranges_m)
    ranges_m, angles_rad = scan.ranges_m[hit], scan.angles_rad[hit]
    points = np.stack([np.cos(angles_rad), np.sin(angles_rad), 0 * angles_rad], axis=1)
    return rr.Points3D(points * ranges_m[:, None], radii=[0.02])
