"""How sure the rgbd module says that its poses are."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rgbd_features import features_at, random_descriptors
from test_rgbd import drive, make
from test_rgbd_mono import IMAGES, error_m, images

from sceneslam.modules.slam.rgbd.locate.certainty import Certainty, common_ratio, noise_ratio
from sceneslam.modules.slam.rgbd.locate.pose_solver import Linearised
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

COUNT = 600


def sighting(bend, *, size=1.0, is_monocular=False, odometry=None):
    """A view of pixels all over the image; a fix whose residuals are noise and a bent lens."""
    rng = np.random.default_rng(0)
    uv_px = rng.uniform([0, 0], [640, 480], (COUNT, 2))
    x, y = uv_px.T / 320.0 - 1.0
    one, none = np.ones(COUNT), np.zeros(COUNT)
    by_u, by_v = [one, none, y, x, x * y, 1 + x * x], [none, one, -x, y, 1 + y * y, x * y]
    residuals = rng.normal(size=(2, COUNT)) + bend * np.sin(uv_px.T / 50.0)
    linearised = Linearised(
        residuals=size * residuals.ravel(),
        jacobian=np.concatenate([by_u, by_v], axis=1),
        sigma_px=one,
        normal=np.eye(6),
    )
    features = features_at(uv_px, random_descriptors(rng, COUNT))
    image_bgr = np.zeros((480, 640, 3), np.uint8)
    covariance, prior = 1e-6 * np.eye(6), np.zeros((6, 6))
    estimate = SimpleNamespace(linearised=linearised, covariance=covariance, prior=prior)
    rows = np.arange(COUNT)
    fix = SimpleNamespace(estimate=estimate, feature_rows=rows, landmark_ids=rows)
    view = SimpleNamespace(
        image_bgr=image_bgr, features=features, is_monocular=is_monocular, odometry=odometry
    )
    return view, fix


def landmarks_with(scale_sigma):
    """Landmarks 2 m away."""
    points_local = np.tile([2.0, 0.0, 0.0], (COUNT, 1))
    return SimpleNamespace(scale_sigma=np.full(COUNT, scale_sigma), points_local=points_local)


def sigma_m(bend, *, from_keyframe_m, turned_rad=0.0, size=1.0):
    landmarks = landmarks_with(0.0)
    beside = [se3.from_xy_yaw(from_keyframe_m, 0.0, turned_rad)]
    covariance = Certainty(landmarks).covariance(*sighting(bend, size=size), se3.identity(), beside)
    return float(np.sqrt(covariance[0, 0]))


def test_independent_residuals_have_nothing_in_common():
    assert common_ratio(*sighting(bend=0.0)) == pytest.approx(1.0, abs=0.25)
    assert common_ratio(*sighting(bend=1.0)) > 2.5


def test_pixels_that_do_not_hold_a_direction_say_what_they_have_in_common_all_the_same():
    view, fix = sighting(bend=1.0)
    seen = fix.estimate.linearised
    flat = replace(seen, jacobian=seen.jacobian * np.array([[1.0]] * 5 + [[0.0]]))
    fix.estimate.linearised = flat
    assert 1.5 < common_ratio(view, fix) < 100.0


def test_what_neighbouring_residuals_have_in_common_widens_the_covariance():
    assert sigma_m(0.0, from_keyframe_m=1.0) < 1.2e-3  # of independent pixels: 1.0e-3
    near, far = sigma_m(1.0, from_keyframe_m=0.0), sigma_m(1.0, from_keyframe_m=1.0)
    assert near > 1.5e-3
    assert far == pytest.approx(np.hypot(near, 0.03), rel=0.01)  # no noise explains 3 %
    turned = sigma_m(1.0, from_keyframe_m=0.0, turned_rad=0.5)
    assert turned == pytest.approx(np.hypot(near, 0.03 * 0.5 * 2.0), rel=0.01)


@pytest.mark.parametrize(
    ("size", "noise"), [(0.6, 0.36 / 0.84), (0.2, 0.04 / 0.84), (0.0, 9e-4), (2.0, 1.0)]
)
def test_noise_is_as_large_as_residuals_show(size, noise):
    view, fix = sighting(bend=0.0, size=size)
    certainty = Certainty(landmarks_with(0.0))
    covariance = certainty.covariance(view, fix, se3.identity(), [se3.identity()])
    assert covariance[0, 0] == pytest.approx(1e-6 * noise, rel=0.3)
    assert noise_ratio(fix) == pytest.approx(size**2 / 0.84, rel=0.1)


def test_fine_residuals_do_not_make_odometry_more_certain():
    view, fix = sighting(bend=0.0, size=0.2)
    by_image = 1e-6 * np.array([100.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    fix.estimate.prior = np.diag([1e4, 0.0, 0.0, 0.0, 0.0, 0.0])
    fix.estimate.covariance = np.linalg.inv(np.diag(1 / by_image) + fix.estimate.prior)
    certainty = Certainty(landmarks_with(0.0))
    covariance = certainty.covariance(view, fix, se3.identity(), [se3.identity()])
    assert covariance[1, 1] < 0.1e-6
    assert covariance[0, 0] == pytest.approx(1 / (1e4 + 1 / (100.0 * covariance[1, 1])))


def test_what_fine_residuals_have_in_common_is_no_wrong_model():
    assert sigma_m(1.0, size=1.0, from_keyframe_m=1.0) == pytest.approx(0.03, rel=0.02)
    assert sigma_m(1.0, size=0.1, from_keyframe_m=1.0) < 0.3 * 0.03


def test_a_scale_that_nothing_holds_counts_from_where_depth_was_seen_last():
    certainty = Certainty(landmarks_with(0.1))

    def sigmas_m(x_m, *, is_monocular):
        T_local_base = se3.from_xy_yaw(x_m, 0.0, np.pi / 2)
        view, fix = sighting(0.0, is_monocular=is_monocular)
        covariance = certainty.covariance(view, fix, T_local_base, [se3.identity()])
        return np.sqrt(covariance.diagonal()[:2])

    assert sigmas_m(1.0, is_monocular=False).max() < 0.01
    along, across = sigmas_m(3.0, is_monocular=True)[[1, 0]]  # base faces y
    assert along == pytest.approx(0.2, abs=0.01)
    assert across < 0.01
    assert sigmas_m(3.0, is_monocular=False).max() < 0.01
    assert sigmas_m(3.0, is_monocular=True).max() < 0.01


def test_a_scale_that_wheels_measure_on_and_on_counts_over_the_map_around():
    certainty = Certainty(landmarks_with(0.02))
    seen = [sighting(0.0, is_monocular=k > 0, odometry=object()) for k in range(3)]
    for x_m, (view, fix) in zip((0.0, 1.0, 20.0), seen, strict=True):
        T_local_base = se3.from_xy_yaw(x_m, 0.0, 0.0)
        covariance = certainty.covariance(view, fix, T_local_base, [se3.identity()])
        expected_m = 0.02 * min(x_m, 1.5)
        assert np.sqrt(covariance[0, 0]) == pytest.approx(expected_m, abs=0.002)
        assert np.sqrt(certainty.by_wheels[0, 0]) == pytest.approx(expected_m, abs=0.002)


def test_the_longer_there_is_no_depth_the_less_sure_is_the_scale():
    module = make()
    answers = drive(module, images(depth=4, odometry=False))
    sigma_m = [np.sqrt(np.linalg.eigvalsh(a.covariance[:3, :3])[-1]) for a in answers]
    assert sigma_m[-1] > 3 * sigma_m[3]
    assert error_m(answers[-1], IMAGES - 1) < 3 * sigma_m[-1]
    is_degraded = [answer.status is TrackingStatus.DEGRADED for answer in answers]
    assert is_degraded == [sigma > 0.05 for sigma in sigma_m]
