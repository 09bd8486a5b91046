"""SE(3): the laws that every transform obeys."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.types import se3

number = st.floats(-3.0, 3.0, allow_nan=False)
twists = st.lists(number, min_size=6, max_size=6).map(lambda xi: se3.exp(np.array(xi)))
tiny = st.lists(st.floats(-1e-7, 1e-7), min_size=6, max_size=6).map(np.array)


@given(twists)
def test_inverse_undoes(T_a_b):
    np.testing.assert_allclose(se3.inverse(T_a_b) @ T_a_b, np.eye(4), atol=1e-9)


@given(twists, twists, twists)
def test_composition_is_associative(T_a_b, T_b_c, T_c_d):
    np.testing.assert_allclose((T_a_b @ T_b_c) @ T_c_d, T_a_b @ (T_b_c @ T_c_d), atol=1e-9)


@given(twists)
def test_exp_undoes_log(T_a_b):
    np.testing.assert_allclose(se3.exp(se3.log(T_a_b)), T_a_b, atol=1e-8)


@given(tiny)
def test_log_undoes_exp_near_identity(xi):
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-12)


@given(twists, tiny)
def test_rounding_is_taken_out_of_a_rotation(T_a_b, off):
    rough = T_a_b.copy()
    rough[:3, :3] @= np.eye(3) + np.diag(off[:3])
    found = se3.orthonormal(rough)
    np.testing.assert_allclose(se3.inverse(found) @ found, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(found, T_a_b, atol=1e-6)


@given(twists)
def test_quaternion_and_its_negative_are_one_rotation(T_a_b):
    quat_xyzw = se3.to_quat_xyzw(T_a_b)
    for q in (quat_xyzw, -quat_xyzw):
        np.testing.assert_allclose(se3.from_quat_xyzw(T_a_b[:3, 3], q), T_a_b, atol=1e-9)


@given(twists, st.floats(0.0, 1.0))
def test_interpolation_ends_at_its_ends(T_w_0, ratio):
    T_w_1 = T_w_0 @ se3.from_xy_yaw(1.0, 0.5, 0.8)
    np.testing.assert_allclose(se3.interpolate(T_w_0, T_w_1, 0.0), T_w_0, atol=1e-9)
    np.testing.assert_allclose(se3.interpolate(T_w_0, T_w_1, 1.0), T_w_1, atol=1e-9)
    half = se3.rotation_angle_rad(se3.inverse(T_w_0) @ se3.interpolate(T_w_0, T_w_1, ratio))
    np.testing.assert_allclose(half, 0.8 * ratio, atol=1e-9)


@given(twists, twists, st.floats(0.0, 1.0))
def test_a_stack_is_interpolated_as_its_poses(T_w_0, T_w_1, ratio):
    first, second = np.stack([T_w_0, T_w_1]), np.stack([T_w_1, T_w_1])
    shares = np.array([ratio, 1.0 - ratio])
    expected = [se3.interpolate(*one) for one in zip(first, second, shares, strict=True)]
    np.testing.assert_allclose(se3.interpolate(first, second, shares), expected, atol=1e-9)


@given(st.floats(-3.1, 3.1))
def test_yaw_of_a_planar_motion_is_its_yaw(yaw):
    T_a_b = se3.from_xy_yaw(1.0, 2.0, yaw)
    np.testing.assert_allclose(se3.yaw_rad(T_a_b), yaw, atol=1e-12)
    np.testing.assert_allclose(se3.rotation_angle_rad(T_a_b), abs(yaw), atol=1e-9)


def test_points_move_with_their_frame():
    points_b = np.array([[1.0, 0.0, 0.0]], np.float32)
    points_a = se3.apply(se3.from_xy_yaw(1.0, 0.0, np.pi / 2), points_b)
    np.testing.assert_allclose(points_a, [[1.0, 1.0, 0.0]], atol=1e-6)
    assert points_a.dtype == np.float32


def test_no_rounding_adds_up_in_a_chain():
    step = se3.exp(np.array([0.01, 0.0, 0.002, 0.003, -0.002, 0.01]))
    step[:3, :3] *= 1.0 + 1e-12
    chain = product = se3.identity()
    for _ in range(10_000):
        chain, product = se3.chained(chain, step), product @ step
    off = [np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() for T in (chain, product)]
    assert off[0] < 1e-11 < 1e-9 < off[1]
    assert chain == pytest.approx(product, abs=1e-6)


def test_a_mean_of_poses_is_weighted_by_information_and_as_certain_as_one_of_them():
    first, off = se3.from_xy_yaw(1.0, 2.0, 0.5), np.array([0.03, -0.06, 0.0, 0.0, 0.0, 0.09])
    covariances = [np.eye(6), 0.5 * np.eye(6)]
    mean, covariance = se3.mean([first, first @ se3.exp(off)], covariances)
    np.testing.assert_allclose(mean, first @ se3.exp(2 / 3 * off), atol=1e-12)
    np.testing.assert_allclose(covariance, 2 / 3 * np.eye(6), atol=1e-12)
    same, covariance = se3.mean([first] * 3, [np.eye(6)] * 3)
    np.testing.assert_allclose(same, first, atol=1e-12)
    np.testing.assert_allclose(covariance, np.eye(6), atol=1e-12)


def test_a_skew_is_how_far_a_matrix_is_from_a_rotation():
    turned = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, -0.2, 0.1]))
    longer, mirrored = turned.copy(), turned.copy()
    longer[:3, :3] *= 1.1
    mirrored[:3, 0] *= -1.0
    np.testing.assert_allclose(
        se3.skew(np.stack([turned, longer, np.zeros((4, 4)), mirrored])),
        [0.0, 0.21, 1.0, np.inf],
        atol=1e-12,
    )
    assert se3.skew(turned).shape == () and se3.skew(np.zeros((0, 4, 4))).shape == (0,)
