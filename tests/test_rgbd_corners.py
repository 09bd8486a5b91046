"""Corners of an image: the strongest of every part of it, whatever image came before."""

import cv2
import numpy as np
import pytest
from rgbd_features import settings_with

from sceneslam.modules.slam.rgbd.see.corners import CornerFinder


def finder_of(count):
    return CornerFinder(settings_with(feature_count=count))


def texture(contrast_ratio=1.0):
    """Return a grey image (480, 640) with structure on many scales, the right half fainter."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 1.0, (480, 640))
    layers = [sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 4.0, 10.0)]
    gray = contrast_ratio * 60.0 * sum(layers) * np.linspace(1.0, 0.3, 640)
    return np.clip(128.0 + gray, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("contrast_ratio", [1.0, 0.25, 0.0])
def test_corners_do_not_depend_on_the_images_before(contrast_ratio):
    image, finder = texture(contrast_ratio), finder_of(500)
    fresh = finder.find(image)
    for before in (texture(), texture(), texture(0.1)):
        finder.find(before)
        again = finder.find(image)
        for name in ("uv_px", "levels", "descriptors"):
            assert np.array_equal(getattr(again, name), getattr(fresh, name)), name


def test_count_of_corners_is_kept_where_the_image_has_them():
    assert len(finder_of(500).find(texture()).levels) == 500
    assert len(finder_of(500).find(texture(0.02)).levels) < 500


def test_corners_of_all_levels_lie_where_the_image_shows_them():
    gray = np.full((480, 640), 60, np.uint8)
    cv2.rectangle(gray, (250, 200), (390, 280), 200, -1)
    corners = finder_of(100).find(gray)
    assert len(np.unique(corners.levels)) >= 6
    squares = np.array([[250, 200], [390, 200], [390, 280], [250, 280]])
    off_px = np.linalg.norm(corners.uv_px[:, None] - squares, axis=2).min(axis=1)
    assert (off_px < 4.0 * 1.2**corners.levels).all()
