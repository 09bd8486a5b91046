"""Covariances that stay positive where next to nothing is measured."""

import numpy as np
import pytest

from sceneslam.types.covariance import covariance_of, symmetric, triangle, updated


def turned(variances, seed=0):
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(6, 6)))[0]
    return (axes * variances) @ axes.T


def test_the_covariance_of_an_information_is_its_inverse_and_open_where_it_is_not_above_zero():
    known = turned([1e2, 1e4, 1e6, 1e7, 1e3, 1.0])
    np.testing.assert_allclose(covariance_of(known, unmeasured=1e-2), np.linalg.inv(known))
    values = [1e8, 1e8, 1e8, 1e8, 0.0, -3e-6]
    found = np.linalg.eigvalsh(covariance_of(turned(values), unmeasured=1e-2))
    np.testing.assert_allclose(found, [1e-8] * 4 + [100.0] * 2, rtol=1e-4)


def test_covariances_are_those_of_their_upper_triangles_row_by_row():
    one = np.arange(21.0)
    np.testing.assert_array_equal(symmetric(one)[:2, :3], [[0.0, 1.0, 2.0], [1.0, 6.0, 7.0]])
    many = np.stack([one, -one])[None]
    found = symmetric(many)
    np.testing.assert_array_equal(found, found.swapaxes(-1, -2))
    np.testing.assert_array_equal(triangle(found), many)
    assert symmetric(np.zeros((0, 21))).shape == (0, 6, 6)


@pytest.mark.parametrize("seed", range(5))
def test_an_update_leaves_a_covariance_positive_that_the_short_form_does_not(seed):
    before = turned([1e6, 1e5, 1e-6, 1e-6, 1e-6, 1e-6], seed)
    seen, noise = np.eye(6)[[0, 1, 5]], 1e-6 * np.eye(3)
    gain = before @ seen.T @ np.linalg.inv(seen @ before @ seen.T + noise)
    after = updated(before, gain, seen, noise)
    assert np.linalg.eigvalsh(0.5 * (after + after.T))[0] > 0.0
    short = before - gain @ seen @ before
    assert np.linalg.eigvalsh(0.5 * (short + short.T))[0] < 0.0


def test_an_update_is_that_of_kalman():
    before, seen, noise = turned([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.eye(6)[[1, 4]], np.eye(2)
    gain = before @ seen.T @ np.linalg.inv(seen @ before @ seen.T + noise)
    expected = np.linalg.inv(np.linalg.inv(before) + seen.T @ np.linalg.inv(noise) @ seen)
    np.testing.assert_allclose(updated(before, gain, seen, noise), expected, atol=1e-12)
