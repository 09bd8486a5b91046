"""What a camera sees: views of images, in the light and in the dark, and which of them are kept."""

from dataclasses import replace

import numpy as np
import pytest
from test_views import CAMERA, HERE, base_of, finder

from sceneslam.atlas.places.view_taker import ViewTaker
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.views.grey_noise import brightened, grey_noise
from sceneslam.views.view import LandmarkViewer


def picture(seed=0):
    """A wall of grey squares."""
    rng = np.random.default_rng(seed)
    squares = rng.integers(0, 256, (24, 32), dtype=np.uint8)
    return np.repeat(np.kron(squares, np.ones((20, 20), np.uint8))[..., None], 3, axis=2)


def seen(image=None, depth_m=2.0):
    image = picture() if image is None else image
    depth = np.broadcast_to(np.float32(depth_m), image.shape[:2]).copy()
    return Observation(stamp_ns=5, image_bgr=image, depth_m=depth)


def landmarks_of(observation):
    viewer = LandmarkViewer(CAMERA)
    view = viewer.look(observation)
    unknown = np.zeros(len(view.rays))
    return viewer.landmarks(view, unknown, unknown)


def test_corners_have_their_rays_and_their_points():
    view = LandmarkViewer(CAMERA).look(seen(depth_m=2.0))
    assert len(view.rays) == len(view.depth_m) == len(view.descriptors) > 100
    assert (view.depth_m == 2.0).all()
    points_cam = landmarks_of(seen(depth_m=2.0)).points_cam
    np.testing.assert_allclose(points_cam[:, 2], 2.0, rtol=1e-5)
    np.testing.assert_allclose(points_cam[:, :2], 2.0 * view.rays, atol=1e-5)
    uv_px = view.rays * 500.0 + [320.0, 240.0]
    edges = np.abs((uv_px + 0.5) / 20.0 - np.rint((uv_px + 0.5) / 20.0)).max(axis=1)
    assert np.median(edges) < 0.15  # at the squares' corners, to 3 pixels


def test_lenses_bend_no_rays():
    bent = replace(CAMERA, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
    straight, found = (LandmarkViewer(one).look(seen()) for one in (CAMERA, bent))
    outer = np.hypot(*straight.rays.T) > 0.5
    assert outer.sum() > 10
    assert (np.hypot(*found.rays[outer].T) > 1.03 * np.hypot(*straight.rays[outer].T)).all()


def test_corners_where_a_lens_model_folds_are_left_out():
    """Near its corners rays came out a thousand times too long."""
    folded = replace(
        CAMERA, fx=280.0, fy=280.0, cx=320.0, cy=240.0, distortion=(-0.36, 0.16, 0.0, 0.0, -0.037)
    )
    view = LandmarkViewer(folded).look(seen())
    assert len(view.rays) > 50 and np.abs(view.rays).max() < 3.0


def test_what_shows_too_little_is_no_view():
    viewer = LandmarkViewer(CAMERA)
    assert viewer.look(seen(np.zeros((480, 640, 3), np.uint8))) is None  # dark
    assert landmarks_of(seen(depth_m=0.0)) is None and landmarks_of(seen(depth_m=9.0)) is None
    assert landmarks_of(Observation(stamp_ns=0, image_bgr=picture())) is None
    assert viewer.look(Observation(stamp_ns=0, depth_m=np.ones((480, 640), np.float32))) is None


RIG = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH}), camera=CAMERA)


def darkened(image, *, electrons, seed=0):
    """The image with so many photons in white, read noise, and 12 electrons per grey level."""
    rng = np.random.default_rng(seed)
    counts = rng.poisson(image[..., 0] / 255.0 * electrons) + rng.normal(0.0, 10.0, image.shape[:2])
    return np.repeat(np.clip(np.rint(counts / 12.0), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def furnished(seed=3):
    """An image of things of many sizes and greys."""
    rng, image = np.random.default_rng(seed), np.full((480, 640, 3), 120, np.uint8)
    for _ in range(400):
        x, y = rng.integers(0, [600, 440])
        width, height = rng.integers(8, 60, 2)
        image[y : y + height, x : x + width] = rng.integers(40, 255)
    return image


def test_a_place_is_recognized_in_the_dark():
    viewer, image = LandmarkViewer(CAMERA), furnished()
    known = finder((HERE, landmarks_of(seen(image))))
    night = darkened(image, electrons=100.0)
    assert np.percentile(night, 99) < 15  # grey levels
    found = known.recognize(viewer.look(seen(night)))
    off = se3.inverse(HERE) @ base_of(found)
    assert np.linalg.norm(off[:3, 3]) < 0.02 and se3.rotation_angle_rad(off) < 0.005
    assert found.matches > 100


def test_noise_is_no_place():
    viewer = LandmarkViewer(CAMERA)
    for electrons in (0.0, 20.0, 100.0):
        empty = darkened(np.full((480, 640, 3), 255, np.uint8), electrons=electrons)
        view = viewer.look(seen(empty))
        assert view is None or len(view.rays) < 100


def test_a_bright_image_is_left_as_it_is_and_a_dark_one_has_limited_noise():
    bright = picture()[..., 0]
    assert brightened(bright, noise_max=3.0) is bright
    flat = np.full((480, 640, 3), 255, np.uint8)
    for electrons in (60.0, 300.0, 1200.0):
        grey = darkened(flat, electrons=electrons)[..., 0]
        assert grey_noise(grey) == pytest.approx(grey.std(), rel=0.25)
        lit = brightened(grey, noise_max=3.0)
        assert lit.mean() > 1.5 * grey.mean() and lit.std() < 3.6


def test_only_a_camera_takes_views():
    assert LandmarkViewer.of(RIG) is not None
    assert LandmarkViewer.of(replace(RIG, sensors=frozenset({Sensor.IMAGE}))) is not None
    assert LandmarkViewer.of(replace(RIG, sensors=frozenset({Sensor.DEPTH}))) is None
    assert LandmarkViewer.of(replace(RIG, camera=None)) is None
    blind = ViewTaker(replace(RIG, camera=None), is_keeping=True)
    blind.move(0, HERE)
    assert not blind.is_kept(seen(), HERE) and blind.take(seen()) is None


def test_views_are_kept_a_third_of_a_metre_or_a_quarter_of_a_radian_apart():
    taker = ViewTaker(RIG, is_keeping=True)
    assert taker.is_kept(seen(), HERE)
    assert taker.take(seen(np.zeros((480, 640, 3), np.uint8))) is None
    assert taker.is_kept(seen(), HERE)  # it was dark
    taker.keep(HERE)
    for away, is_kept in ((0.29, False), (0.31, True)):
        assert taker.is_kept(seen(), HERE @ se3.from_xy_yaw(0.0, away, 0.0)) == is_kept
    for turn, is_kept in ((0.24, False), (-0.26, True)):
        assert taker.is_kept(seen(), HERE @ se3.from_xy_yaw(0.0, 0.0, turn)) == is_kept
    taker.take(seen())
    assert not taker.is_kept(seen(), HERE)
    assert not ViewTaker(RIG, is_keeping=False).is_kept(seen(), HERE)


def test_views_are_not_kept_in_a_fast_turn_and_carry_its_shear():
    taker = ViewTaker(RIG, is_keeping=True)
    taker.move(0, HERE)
    for rate_radps, is_kept in ((0.45, True), (0.55, False)):
        taker.move(10**9, HERE)
        after = HERE @ se3.from_xy_yaw(0.0, 0.0, 0.1 * rate_radps)
        taker.move(11 * 10**8, after)
        assert taker.is_kept(seen(), after) == is_kept
        found = taker.take(seen())
        assert found.shear_rad == pytest.approx(0.03 * rate_radps)


@pytest.mark.parametrize(
    "sizes", [((240, 320), (240, 320)), ((480, 640), (240, 320)), ((480, 640), (960, 1280))]
)
def test_images_and_depths_of_other_sizes_give_no_view(sizes):
    image = np.resize(picture(), (*sizes[0], 3))
    observation = Observation(
        stamp_ns=0, image_bgr=image, depth_m=np.full(sizes[1], 2.0, np.float32)
    )
    assert LandmarkViewer(CAMERA).look(observation) is None
