"""Rays of a camera's pixels, whose lens bends them."""

import numpy as np
import pytest

from sceneslam.types.lens import undistorted_rays
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
