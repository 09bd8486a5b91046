"""The laser module in a corridor, with wheels that lie for five seconds."""

import numpy as np
import pytest
from test_laser import active, errors
from test_laser_world import box, corridor, drive, scan_at
from test_motion import Drive

from sceneslam.modules.slam.laser.field import LikelihoodField
from sceneslam.modules.slam.laser.matcher import Matcher
from sceneslam.modules.slam.laser.prior import MotionPrior
from sceneslam.types import se3

PERIOD_S, SPEED_M_S = 0.2, 0.5
LIE = slice(100, 125)  # 5 s


def with_posts():
    """Return a corridor with posts of 0.4 m on either side, at irregular distances."""
    rng = np.random.default_rng(5)
    places = [(x + rng.uniform(-0.7, 0.7), side) for x in range(-4, 28, 2) for side in (-1, 1)]
    return np.concatenate(
        [corridor(), *(box(x - 0.2, y - 0.2, x + 0.2, y + 0.2) for x, y in places)]
    )


def driven(walls, *, factor, turn_rad=0.0, seed=1):
    """Return path, wheels and trackings; the wheels' distance is off by `factor` for 5 s."""
    count = 170
    turns = np.zeros(count)
    turns[LIE] = turn_rad
    path = np.column_stack(
        [SPEED_M_S * PERIOD_S * np.arange(count), np.zeros(count), np.cumsum(turns)]
    )
    steps_m = np.full(count, SPEED_M_S * PERIOD_S)
    steps_m[LIE] *= factor
    told = np.column_stack([np.cumsum(steps_m) - steps_m[0], np.zeros(count), np.zeros(count)])
    if factor == 1.0:
        told[:, 2] = path[:, 2]
    module, rng = active(), np.random.default_rng(seed)
    observations = drive(walls, path, odometry=told, rng=rng, period_ns=round(PERIOD_S * 1e9))
    return errors(path, [module.track(observation) for observation in observations])


@pytest.mark.parametrize("factor", [-1.0, 2.0])
def test_wheels_that_lie_move_the_pose_by_centimetres(factor):
    error = driven(with_posts(), factor=factor)
    assert error[-1, 0] < 0.1  # the wheels are off by 1.25 to 5 m


def test_turn_that_frozen_wheels_do_not_report_is_followed():
    error = driven(with_posts(), factor=0.0, turn_rad=0.1)
    assert error[-1, 1] < 0.02  # the wheels miss 2.5 rad


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_push_is_followed_without_wheels(seed):
    count, walls = 170, with_posts()
    steps_m = np.full(count, SPEED_M_S * PERIOD_S)
    steps_m[100] = 0.6
    path = np.column_stack([np.cumsum(steps_m), np.zeros((count, 2))])
    module, rng = active(), np.random.default_rng(seed)
    observations = drive(walls, path, rng=rng, period_ns=round(PERIOD_S * 1e9))
    error = errors(path, [module.track(observation) for observation in observations])
    assert error[-1, 0] < 0.03  # 0.1 to 0.4 m if a robot without wheels moves by inertia alone


def test_motion_that_nothing_predicts_is_likelier_the_longer_scans_fit_worse():
    drive = Drive()
    for _ in range(50):
        drive.step()
    usual, worse = drive.last, drive.last.since_misfit(4.0, 2.0)
    assert drive.last.since_misfit(0.0, 2.0) is usual
    for before, after in zip(usual.alternatives, worse.alternatives, strict=True):
        assert (after.probability > before.probability) == before.is_unknown
        assert (after.covariance[0, 0] > before.covariance[0, 0]) == before.is_unknown
    assert np.sqrt(worse.alternatives[-1].covariance[0, 0]) == pytest.approx(2.0)


def test_scan_chooses_the_motion_that_it_fits():
    """The wheels stand; the robot moved on, as its inertia says."""
    walls = with_posts()
    reader = active()._front_end.reader
    here, ahead = (
        reader.read(scan_at(walls, se3.from_xy_yaw(x, 0, 0), stamp_ns=0)) for x in (0.0, 0.25)
    )
    matcher = Matcher(window_m=0.5, window_rad=0.5, degeneracy_ratio=0.01, shift_m=0.0)
    wheels = MotionPrior.of(np.zeros(3), np.diag([1e-3, 1e-3, 1e-3]) ** 2, 0.99)
    inertia = MotionPrior.of(np.array([0.2, 0.0, 0.0]), np.diag([0.1, 0.05, 0.01]) ** 2, 0.01)
    field = LikelihoodField(here, 0.05)
    moved = matcher.match(ahead, field, [wheels, inertia])
    assert moved.T_local_base == pytest.approx([0.25, 0.0, 0.0], abs=0.02)
    assert moved.probabilities[1] > 0.9
    stood = matcher.match(here, field, [wheels, inertia])
    assert stood.T_local_base == pytest.approx([0.0, 0.0, 0.0], abs=0.005)
    assert stood.probabilities[1] < 0.1
