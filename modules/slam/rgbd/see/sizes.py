"""Check the images' sizes."""

from __future__ import annotations

from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera


def check_sizes(observation: Observation, camera: Camera) -> None:
    """Raise InputError if an array does not have the camera's size."""
    width, height = camera.size_wh
    image_bgr, depth_m = observation.image_bgr, observation.depth_m
    if image_bgr is not None and image_bgr.shape != (height, width, 3):
        raise InputError(f"image_bgr: expected ({height}, {width}, 3), got {image_bgr.shape}")
    if depth_m is not None and depth_m.shape != (height, width):
        raise InputError(f"depth_m: expected ({height}, {width}), got {depth_m.shape}")
