"""Wheel odometry that lies on purpose: what is spoilt, and what is not."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from sceneslam.sources.changes.spoilt_odometry import SpoiltOdometry
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor

CONF = yaml.safe_load((Path(__file__).parents[1] / "conf/effects/liars.yaml").read_text())
SETTINGS = {key: value for key, value in CONF.items() if key != "_target_"} | {"seed": 3}
STEP = se3.from_xy_yaw(0.05, 0.0, 0.01)


class Drive:
    """Three minutes of a robot's wheels."""

    length, faults, span = 1800, (), None
    rig = Rig(sensors=frozenset({Sensor.ODOMETRY}))

    def __iter__(self):
        T_odom_base = se3.identity()
        for index in range(self.length):
            yield Observation(stamp_ns=index * 10**8, T_odom_base=T_odom_base)
            T_odom_base = se3.chained(T_odom_base, STEP)

    def ground_truth(self):
        return None


def motions(**settings):
    """Return the spoilt steps (N, 4, 4)."""
    source = SpoiltOdometry(Drive(), **{**SETTINGS, **settings})
    poses = np.stack([observation.T_odom_base for observation in source])
    return se3.inverse(poses[:-1]) @ poses[1:]


@pytest.mark.parametrize(
    ("lie", "factor"), [("reversed", -1.0), ("frozen", 0.0), ("slipping", 0.5)]
)
def test_lie_lasts_some_seconds_and_comes_again(lie, factor):
    forward_m = motions(lie=lie)[:, 0, 3]
    lies = np.isclose(forward_m, factor * 0.05)
    assert (lies | np.isclose(forward_m, 0.05)).all()
    lengths = np.diff(np.flatnonzero(np.diff(np.r_[0, lies, 0])))[::2]
    assert len(lengths) >= 2
    assert lengths.min() >= 29 and lengths.max() <= 81


def test_scale_pull_and_nothing():
    assert motions(lie="scaled", ratio=0.7)[:, 0, 3] == pytest.approx(0.035)
    pulled = motions(lie="turning")
    assert np.arctan2(pulled[:, 1, 0], pulled[:, 0, 0]) == pytest.approx(0.015)
    np.testing.assert_allclose(motions(lie="none"), np.broadcast_to(STEP, (1799, 4, 4)), atol=1e-9)


def test_late_odometry_is_that_of_before():
    late = [one.T_odom_base for one in SpoiltOdometry(Drive(), **{**SETTINGS, "lie": "late"})]
    true = [one.T_odom_base for one in Drive()]
    np.testing.assert_allclose(late[100], true[97], atol=1e-9)


def test_spike_is_one_pose_and_absent_is_all_of_them():
    steps_m = np.linalg.norm(motions(lie="spikes")[:, :2, 3], axis=1)
    assert 4 <= (steps_m > 0.1).sum() <= 12
    source = SpoiltOdometry(Drive(), **{**SETTINGS, "lie": "absent"})
    assert Sensor.ODOMETRY not in source.rig.sensors
    assert all(one.T_odom_base is None for one in source)


def test_same_seed_tells_the_same_lies():
    np.testing.assert_array_equal(motions(lie="reversed"), motions(lie="reversed"))
    assert not np.array_equal(motions(lie="reversed"), motions(lie="reversed", seed=4))


def test_unknown_lie_is_named():
    with pytest.raises(ConfigError, match="lie"):
        SpoiltOdometry(Drive(), **{**SETTINGS, "lie": "white"})
