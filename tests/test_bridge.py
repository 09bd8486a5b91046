"""The bridge: where the robot is while no module tracks."""

from __future__ import annotations

import numpy as np
import pytest

from sceneslam.bus.bridge import Bridge
from sceneslam.types import se3
from sceneslam.types.observation import Observation

PERIOD_NS = 100_000_000


def at(step: int, *, with_odometry: bool = True) -> Observation:
    """A robot that drives 0.1 m per step."""
    T_odom_base = se3.from_xy_yaw(0.1 * step, 0.0, 0.0) if with_odometry else None
    return Observation(stamp_ns=step * PERIOD_NS, T_odom_base=T_odom_base)


@pytest.mark.parametrize("by_velocity", [True, False])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_odometry_of_any_rate_bridges_a_gap_of_any_length(every, by_velocity):
    bridge = Bridge(is_active=True)
    bridge.update(at(0), se3.from_xy_yaw(5.0, 0.0, 0.0))
    poses = [
        bridge.predict(at(step, with_odometry=step % every == 0), by_velocity=by_velocity)
        for step in range(1, 61)
    ]
    assert poses[-1] is not None
    np.testing.assert_allclose(poses[-1][0, 3], 5.0 + 6.0, atol=1e-9)


def test_a_correction_without_odometry_is_no_motion():
    bridge = Bridge(is_active=True)
    bridge.update(at(0), se3.identity())
    bridge.update(at(1, with_odometry=False), se3.from_xy_yaw(2.0, 0.0, 0.0), is_jump=True)
    bridge.predict(at(2), by_velocity=True)
    last = bridge.predict(at(3), by_velocity=True)
    assert last is not None
    np.testing.assert_allclose(last[0, 3], 2.2, atol=0.1 + 1e-9)  # or a step more or less


@pytest.mark.parametrize("by_velocity", [True, False])
def test_odometry_bridges_after_a_correction_without_it(by_velocity):
    bridge = Bridge(is_active=True)
    bridge.update(at(0), se3.identity())
    bridge.update(at(1, with_odometry=False), se3.from_xy_yaw(2.0, 0.0, 0.0), is_jump=True)
    poses = [bridge.predict(at(step), by_velocity=by_velocity) for step in range(2, 61)]
    assert poses[-1] is not None
    # How far it moved since the last odometry is not known, as the correction hides it.
    np.testing.assert_allclose(poses[-1][0, 3], 2.0 + 5.9, atol=0.11)
