"""Where the robot was at a stamp of the last second."""

import numpy as np
import pytest

from sceneslam.types import se3
from sceneslam.types.trail import Trail

MS = 1_000_000


@pytest.fixture
def trail():
    """It drives 1 m per 100 ms, and turns by 0.1 rad at the end."""
    made = Trail()
    for index in range(4):
        made.add(100 * index * MS, se3.from_xy_yaw(float(index), 0.0, 0.0))
    made.move(400 * MS, se3.from_xy_yaw(0.0, 0.0, 0.1))
    return made


@pytest.mark.parametrize(
    ("at_ms", "x_m", "yaw_rad"),
    [
        (900, 3.0, 0.35),  # no sweep has its middle later than 250 ms
        (450, 3.0, 0.15),
        (400, 3.0, 0.1),
        (350, 3.0, 0.05),
        (250, 2.5, 0.0),
        (-50, 0.0, 0.0),
    ],
)
def test_it_tells_the_pose_then_in_that_of_now(trail, at_ms, x_m, yaw_rad):
    T_w_then = se3.from_xy_yaw(3.0, 0.0, 0.1) @ trail.base_at(at_ms * MS)
    np.testing.assert_allclose(T_w_then, se3.from_xy_yaw(x_m, 0.0, yaw_rad), atol=1e-9)


def test_poses_that_are_replaced_are_forgotten(trail):
    trail.add(200 * MS, se3.from_xy_yaw(1.5, 0.0, 0.0))
    np.testing.assert_allclose(trail.base_at(150 * MS)[0, 3], -0.25)
    np.testing.assert_allclose(trail.twist_s, [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_more_than_a_second_ago_it_knows_the_oldest_alone(trail):
    trail.add(1300 * MS, se3.from_xy_yaw(9.0, 0.0, 0.0))
    np.testing.assert_allclose(trail.base_at(0)[0, 3], -6.0)
