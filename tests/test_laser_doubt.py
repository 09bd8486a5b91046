"""What a laser's pose may be off by where scans cannot tell which source of motion is right."""

from dataclasses import replace

import numpy as np
import pytest
from test_laser import active
from test_laser_lies import LIE, PERIOD_S, SPEED_M_S
from test_laser_world import box, corridor, drive

from sceneslam.modules.slam.laser.doubt import Doubt
from sceneslam.modules.slam.laser.matcher import Match
from sceneslam.modules.slam.laser.prior import MotionPrior

HERE = np.zeros(3)
PATH = np.column_stack([SPEED_M_S * PERIOD_S * np.arange(170), np.zeros((170, 2))])
WALLS = np.diag([0.0, 1e6, 1e6])  # information of a bare corridor along x
WHEELS = MotionPrior.of(np.zeros(3), np.diag([0.01, 0.01, 0.01]) ** 2, 0.9)


def posts(every_m):
    """Return a corridor with posts of 0.2 m on either side, at irregular distances."""
    rng = np.random.default_rng(5)
    places = [(x + rng.uniform(-0.7, 0.7), y) for x in range(-4, 28, every_m) for y in (-1, 1)]
    return np.concatenate(
        [corridor(), *(box(x - 0.1, y - 0.1, x + 0.1, y + 0.1) for x, y in places)]
    )


def matched(probabilities, information=WALLS):
    """A scan at the origin, where wheels say that it is."""
    return Match(
        T_local_base=np.zeros(3),
        information=information,
        covariance=np.eye(3),
        inliers=100,
        inlier_ratio=1.0,
        overlap_ratio=1.0,
        weak_directions=1,
        T_local_alone=np.zeros(3),
        cost=0.0,
        scan_cost=0.0,
        fit_cost=0.0,
        noise=1.0,
        probabilities=np.array(probabilities),
    )


def ahead(x_m, yaw_rad=0.0):
    """Another source, by which the robot is farther ahead."""
    return MotionPrior.of(np.array([x_m, 0.0, yaw_rad]), np.diag([0.05, 0.01, 0.01]) ** 2, 0.1)


def test_one_disagreement_is_one_error_and_several_are_independent():
    doubt = Doubt()
    for _ in range(10):
        doubt.add(matched([0.96, 0.04]), [WHEELS, ahead(0.1)])
    once = (10 * np.sqrt(0.04) * 0.1) ** 2
    np.testing.assert_allclose(doubt.covariance(HERE), np.diag([once, 0.0, 0.0]), atol=1e-9)
    doubt.add(matched([0.96, 0.04]), [WHEELS, ahead(0.004)])  # they agree
    for _ in range(10):
        doubt.add(matched([0.96, 0.04]), [WHEELS, ahead(-0.1)])
    np.testing.assert_allclose(doubt.covariance(HERE)[0, 0], 2.0 * once, rtol=1e-6)


def test_what_the_robot_makes_good_within_a_disagreement_is_no_error():
    doubt = Doubt()
    for x_m in (0.1, 0.1, -0.1, -0.1):
        doubt.add(matched([0.5, 0.5]), [WHEELS, ahead(x_m)])
    np.testing.assert_allclose(doubt.covariance(HERE), np.zeros((3, 3)), atol=1e-12)


def test_walls_that_hold_the_pose_leave_no_doubt():
    doubt = Doubt()
    doubt.add(matched([0.5, 0.5], np.eye(3) * 1e6), [WHEELS, ahead(0.1)])
    assert np.sqrt(doubt.covariance(HERE)[0, 0]) < 1e-3


def test_a_turn_that_is_in_doubt_counts_too():
    doubt = Doubt()
    bare = np.zeros((3, 3))
    doubt.add(matched([0.5, 0.5], bare), [WHEELS, ahead(0.001, 0.1)])
    assert doubt.covariance(HERE)[2, 2] == pytest.approx(0.5 * 0.1**2)


@pytest.mark.parametrize("count", [1, 2])
def test_a_heading_in_doubt_moves_what_comes_after_it(count):
    doubt, bare = Doubt(), np.zeros((3, 3))
    for _ in range(count):
        doubt.add(matched([0.5, 0.5], bare), [WHEELS, ahead(1e-9, 0.1)])
    if count == 2:
        doubt.add(matched([0.5, 0.5], bare), [WHEELS, ahead(0.0)])  # the disagreement is over
    yaw_rad = count * np.sqrt(0.5) * 0.1
    for there in ([3.0, 4.0, 1.0], [-2.0, 1.0, 0.0]):
        off = yaw_rad * np.array([-there[1], there[0], 1.0])
        np.testing.assert_allclose(doubt.covariance(np.array(there)), np.outer(off, off), atol=1e-9)


def test_the_source_that_is_believed_does_not_disagree_with_itself():
    doubt, likely = Doubt(), ahead(0.1)
    scan = matched([1.0, 0.0], np.diag([400.0, 1e6, 1e6]))  # 0.05 m along x
    pull = np.linalg.solve(scan.information, likely.weighed(HERE) @ likely.off(HERE))
    scan = replace(scan, T_local_alone=pull)  # it lies as far behind as the source is ahead
    assert pull[0] < -0.05
    np.testing.assert_allclose(scan.drawn_to(likely), np.zeros(3), atol=1e-12)
    doubt.add(scan, [likely, WHEELS])
    assert (doubt.covariance(HERE) == 0.0).all()


def test_a_scan_found_by_a_wide_search_leaves_the_doubt_as_it_is():
    doubt = Doubt()
    doubt.add(matched([1.0]), [WHEELS, ahead(0.1)])
    assert (doubt.covariance(HERE) == 0).all()


def deviation_after_m(walls, wheels):
    """The standard deviation along a corridor after a drive of 17 m with these wheels."""
    observations = drive(
        walls,
        PATH,
        odometry=wheels,
        rng=np.random.default_rng(2),
        period_ns=round(PERIOD_S * 1e9),
    )
    module = active()
    last = [module.track(observation) for observation in observations][-1]
    return float(np.sqrt(last.map_covariance[0, 0]))


@pytest.mark.parametrize(("factor", "every_m"), [(0.0, 6), (2.0, 6), (-1.0, 12)])
def test_the_covariance_grows_where_a_lie_is_believed_and_nowhere_else(factor, every_m):
    """Posts every 6 or 12 m are too few to tell that wheels lie; every 2 m they are not."""
    steps_m = np.full(len(PATH), SPEED_M_S * PERIOD_S)
    steps_m[LIE] *= factor
    wheels = np.column_stack([np.cumsum(steps_m) - steps_m[0], np.zeros((len(PATH), 2))])
    believed = deviation_after_m(posts(every_m), wheels)
    assert believed > 0.05  # the pose is off by metres
    assert deviation_after_m(posts(every_m), PATH) < 0.01
    assert deviation_after_m(posts(2), wheels) < 0.01
