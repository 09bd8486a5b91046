"""Rays of a camera's pixels, whose lens bends them."""

import cv2
import numpy as np
import pytest

from sceneslam.types.lens import undistorted_rays, undistortion_maps
from sceneslam.types.rig import Camera

WIDE = {"size_wh": (640, 480), "fx": 300.0, "fy": 300.0, "cx": 320.0, "cy": 240.0}


def pixels(step_px: int = 8) -> np.ndarray:
    return np.mgrid[:640:step_px, :480:step_px].reshape(2, -1).T.astype(np.float64)


@pytest.mark.parametrize("distortion", [(-0.25, 0.05, 0.0, 0.0), (-0.28, 0.07, 0.0, 0.0)])
def test_wide_lens_has_a_ray_for_every_pixel(distortion):
    rays = undistorted_rays(Camera(**WIDE, distortion=distortion), pixels())
    off_centre = np.linalg.norm(pixels() - [320.0, 240.0], axis=1) / 300.0
    r2 = (rays**2).sum(axis=1)
    bent = np.sqrt(r2) * (1.0 + distortion[0] * r2 + distortion[1] * r2**2)
    np.testing.assert_allclose(bent, off_centre, atol=0.5 / 300.0)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_beyond_the_fold_of_a_lens_model_an_image_shows_nothing(scale):
    """There x and y of a pixel are those of another, nearer to the centre."""
    camera = Camera(**WIDE, distortion=(-0.25, 0.0, 0.0, 0.0))
    size_wh = (round(640 * scale), round(480 * scale))
    pinhole = Camera(
        size_wh=size_wh, fx=300 * scale, fy=300 * scale, cx=320 * scale, cy=240 * scale
    )
    shown = cv2.remap(np.ones((480, 640)), *undistortion_maps(camera, pinhole), cv2.INTER_NEAREST)
    rows, columns = np.mgrid[: size_wh[1], : size_wh[0]]
    ray = np.hypot(columns - pinhole.cx, rows - pinhole.cy) / pinhole.fx
    fold = 1.0 / np.sqrt(0.75)
    assert (shown[ray < fold - 0.01] == 1.0).all() and not shown[ray > fold + 0.005].any()
