"""Where the robot was at a stamp of the last second."""

import numpy as np
import pytest

from sceneslam.types import se3
from sceneslam.types.trail import Trail

MS = 1_000_000


@pytest.fixture
def trail():
    """It drives 0.05 m per 100 ms, and turns by 0.1 rad at the end."""
    made = Trail()
    for index in range(4):
        made.add(100 * index * MS, se3.from_xy_yaw(0.05 * index, 0.0, 0.0))
    made.move(400 * MS, se3.from_xy_yaw(0.0, 0.0, 0.1))
    return made


@pytest.mark.parametrize(
    ("at_ms", "x_m", "yaw_rad"),
    [
        (900, 0.15, 0.35),  # no sweep has its middle later than 250 ms
        (450, 0.15, 0.15),
        (400, 0.15, 0.1),
        (350, 0.15, 0.05),
        (250, 0.125, 0.0),
        (-50, 0.0, 0.0),
    ],
)
def test_it_tells_the_pose_then_in_that_of_now(trail, at_ms, x_m, yaw_rad):
    T_w_then = se3.from_xy_yaw(0.15, 0.0, 0.1) @ trail.base_at(at_ms * MS)
    np.testing.assert_allclose(T_w_then, se3.from_xy_yaw(x_m, 0.0, yaw_rad), atol=1e-9)


def test_poses_that_are_replaced_are_forgotten(trail):
    trail.add(200 * MS, se3.from_xy_yaw(0.08, 0.0, 0.0))
    np.testing.assert_allclose(trail.base_at(150 * MS)[0, 3], -0.015)
    np.testing.assert_allclose(trail.twist_s, [0.3, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_more_than_a_second_ago_it_knows_the_oldest_alone(trail):
    trail.add(1300 * MS, se3.from_xy_yaw(0.45, 0.0, 0.0))
    np.testing.assert_allclose(trail.base_at(0)[0, 3], -0.3)


@pytest.mark.parametrize("jump", [se3.from_xy_yaw(0.0, 0.4, 0.0), se3.from_xy_yaw(0.0, 0.0, 0.4)])
def test_a_corrected_pose_is_no_motion(jump):
    """It drives on at 0.5 m/s, and a loop moves it."""
    trail = Trail()
    poses = [se3.from_xy_yaw(0.05 * index, 0.0, 0.0) for index in range(5)]
    for index, T_w_base in enumerate(poses):
        trail.add(100 * index * MS, T_w_base if index < 3 else jump @ T_w_base)
        ahead_m = 0.025 if index else 0.0
        np.testing.assert_allclose(
            trail.base_at((100 * index + 50) * MS), se3.from_xy_yaw(ahead_m, 0.0, 0.0), atol=1e-9
        )


def test_stamps_that_jitter_and_noisy_poses_are_no_jumps():
    rng, trail, forward_m_s = np.random.default_rng(0), Trail(), []
    for index in range(200):
        position_m = 1.0 * index + 10.0 * rng.normal(0.0, 0.003)
        trail.add(100 * index * MS, se3.from_xy_yaw(position_m, 0.0, 0.0))
        forward_m_s.append(trail.twist_s[0])
    np.testing.assert_allclose(forward_m_s[1:], 10.0, atol=1.5)
    np.testing.assert_allclose(trail.base_at((19900 - 800) * MS)[0, 3], -8.0, atol=0.2)


@pytest.mark.parametrize("hz", [5, 10])
def test_a_velocity_that_changed_at_once_is_the_new_one(hz):
    """After a pose that was bridged as standing, a car drives on at 12 m/s."""
    trail = Trail()
    for index in range(6):
        x_m = 12.0 / hz * index if index > 1 else 0.0
        trail.add(1000 // hz * index * MS, se3.from_xy_yaw(x_m, 0.0, 0.0))
    np.testing.assert_allclose(trail.twist_s, [12.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)
