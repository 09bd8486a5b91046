"""The laser's scan matching alone: what may pull a pose, and how much."""

from dataclasses import replace

import numpy as np
import pytest
from test_laser_world import box, room, scan_at

from sceneslam.modules.slam.laser.field import LikelihoodField
from sceneslam.modules.slam.laser.free_space import FreeSpace
from sceneslam.modules.slam.laser.matcher import Matcher, _Pairs, _residuals
from sceneslam.modules.slam.laser.prior import MotionPrior
from sceneslam.modules.slam.laser.surface import ScanSurfaceReader
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan


def test_scans_that_err_together_leave_the_pose_to_the_prediction():
    reader = ScanSurfaceReader(
        T_base_laser=se3.identity(), range_max_m=25.0, noise_m=0.01, noise_per_m=0.0
    )
    seen = reader.read(scan_at(room(), se3.from_xy_yaw(2.0, 1.5, 0.3), stamp_ns=0))
    field = LikelihoodField(seen, 0.05)
    prior = np.diag([0.01**2, 0.01**2, 0.01**2])
    predicted = np.array([0.02, 0.0, 0.0])  # and the scan says: not moved

    def told_m(shift_m, novelty):
        matcher = Matcher(window_m=0.5, window_rad=0.5, degeneracy_ratio=0.01, shift_m=shift_m)
        match = matcher.match(seen, field, [MotionPrior.of(predicted, prior)], novelty=novelty)
        return float(match.T_local_base[0])

    assert abs(told_m(0.0, 1.0)) < 0.002
    assert told_m(0.0, 0.001) == told_m(0.0, 1.0)
    assert 0.012 < told_m(0.01, 0.5) < 0.015
    assert told_m(0.01, 0.001) > 0.019


@pytest.mark.parametrize(
    ("noise_m", "least_m", "most_m"), [(0.005, 0.004, 0.01), (0.04, 0.022, 0.05)]
)
def test_noise_of_scans_is_estimated_from_how_they_fit_the_map(noise_m, least_m, most_m):
    reader = ScanSurfaceReader(
        T_base_laser=se3.identity(), range_max_m=25.0, noise_m=0.02, noise_per_m=0.0
    )
    rng = np.random.default_rng(0)
    field = LikelihoodField(reader.read(scan_at(room(), se3.identity(), stamp_ns=0)), 0.05)
    matcher = Matcher(window_m=0.5, window_rad=0.5, degeneracy_ratio=0.01, shift_m=0.0)
    prior = MotionPrior.of(np.zeros(3), np.diag([0.02**2, 0.02**2, 0.01**2]))
    deviations_m = []
    for _ in range(100):
        scan = scan_at(room(), se3.identity(), stamp_ns=0)
        ranges_m = scan.ranges_m + noise_m * rng.standard_normal(len(scan.ranges_m))
        match = matcher.match(reader.read(replace(scan, ranges_m=ranges_m)), field, [prior])
        deviations_m.append(1.0 / float(np.sqrt(match.information[0, 0])))
    assert least_m < matcher.noise.ratio * 0.02 < most_m
    assert (deviations_m[-1] < deviations_m[0]) == (noise_m < 0.02)


def pull_m(seen, new, *, beams):
    """Return by how much new walls (N, 2, 2) draw a robot at rest, whose map has the seen ones."""
    reader = ScanSurfaceReader(
        T_base_laser=se3.identity(), range_max_m=25.0, noise_m=0.01, noise_per_m=0.0
    )

    def points(walls):
        return reader.read(scan_at(walls, se3.identity(), stamp_ns=0, beams=beams))

    field = LikelihoodField(points(seen), 0.05)
    matcher = Matcher(window_m=0.5, window_rad=0.5, degeneracy_ratio=0.01, shift_m=0.0)
    prior = np.diag([0.05**2, 0.05**2, 0.01**2])
    match = matcher.match(
        points(np.concatenate([seen, new])), field, [MotionPrior.of(np.zeros(3), prior)]
    )
    return np.hypot(*match.T_local_base[:2])


def test_wall_beyond_the_end_of_the_map_hardly_pulls():
    """All that the map has of the wall ahead is the bevel in the corner before it."""
    seen = np.array([[[-2.0, 1.0], [1.8, 1.0]], [[1.8, 1.0], [2.0, 0.8]]])
    new = np.array([[[2.0, 0.8], [2.0, -1.0]]])
    assert pull_m(seen, new, beams=720) < 0.01  # 13 mm when it does


def test_wall_that_comes_into_view_behind_a_post_hardly_pulls():
    """What ends the map there is the post, which holds the pose in all directions."""
    seen = np.concatenate([[[[1.5, -1.0], [1.5, 0.4]]], box(1.39, 0.4, 1.44, 0.45)])
    new = np.array([[[1.5, 0.4], [1.5, 0.75]]])
    assert pull_m(seen, new, beams=1440) < 0.03  # 30 cm when it does


@pytest.mark.parametrize("hangs", [False, True])
def test_space_is_free_where_beams_passed_around_it(hangs):
    """A laser at (0, 0) that looks ahead, in a room of 4 m by 4 m without a wall on its left."""
    walls = box(-2, -2, 2, 2)[[0, 1, 3]]
    scan = scan_at(walls, se3.identity(), stamp_ns=0, beams=180, fov_rad=np.pi)
    clockwise = replace(
        scan,
        ranges_m=scan.ranges_m[::-1],
        angle_min_rad=float(scan.angles_rad[-1]),
        angle_step_rad=-scan.angle_step_rad,
    )
    T_base_laser = se3.identity()
    if hangs:  # its beams turn the other way
        T_base_laser = np.diag([1.0, -1.0, -1.0, 1.0])
        scan, clockwise = (
            replace(each, angle_min_rad=-each.angle_min_rad, angle_step_rad=-each.angle_step_rad)
            for each in (scan, clockwise)
        )
    expected = {
        (1.0, 0.0): True,
        (0.5, -1.5): True,
        (1.9, 0.0): False,  # nearer than 0.2 m to a wall
        (1.5, -1.9): False,
        (3.0, 0.0): False,  # behind a wall
        (-1.0, 0.0): False,  # behind the laser
        (0.3, 1.5): False,  # its beams did not return
    }
    for each in (scan, clockwise):
        free = FreeSpace([each], [np.zeros(3)], T_base_laser, 10.0)
        assert free.contains(np.array(list(expected))).tolist() == list(expected.values())


@pytest.mark.parametrize("beams", [361, 1441, 3601])
def test_a_thing_near_a_fine_laser_is_not_free(beams):
    walls = np.concatenate([box(6, -9, 6.5, 9), box(0.5, -0.025, 0.55, 0.025)])
    rng = np.random.default_rng(0)
    scan = scan_at(walls, se3.identity(), stamp_ns=0, rng=rng, beams=beams, fov_rad=np.pi)
    free = FreeSpace([scan], [np.zeros(3)], se3.identity(), 10.0)
    assert free.contains(np.array([[0.5, 0.0], [0.5, 0.3]])).tolist() == [False, True]


def test_what_was_not_seen_before_is_no_evidence_against_a_motion():
    """A robot that looks ahead moves back, so that more and more of its walls are new."""
    walls = np.concatenate([box(-20, -1, 40, 1), box(3, -1, 3.5, -0.3), box(5, 0.6, 5.5, 1)])
    reader = ScanSurfaceReader(
        T_base_laser=se3.identity(), range_max_m=25.0, noise_m=0.01, noise_per_m=0.0
    )
    rng, T_here_back = np.random.default_rng(0), se3.from_xy_yaw(-0.3, 0, 0)
    here, back = (
        scan_at(walls, T_here_laser, stamp_ns=0, rng=rng, beams=181, fov_rad=np.pi)
        for T_here_laser in (se3.identity(), T_here_back)
    )
    seen = FreeSpace([here], [np.zeros(3)], se3.identity(), 25.0)

    def cost(moved_m, free):
        field = LikelihoodField(reader.read(here), 0.05, free)
        matcher = Matcher(window_m=0.5, window_rad=0.5, degeneracy_ratio=0.01, shift_m=0.0)
        prior = MotionPrior.of(np.array([moved_m, 0.0, 0.0]), np.diag([0.01, 0.01, 0.01]) ** 2)
        return matcher.match(reader.read(back), field, [prior]).scan_cost

    assert cost(-0.3, None) > cost(0.0, None)  # all space is taken as free
    assert cost(-0.3, seen) < 0.5 * cost(0.0, seen)


def two_far_beams(ahead_m):
    """Return what a reader makes of two beams of 1 degree on a wall ahead."""
    reader = ScanSurfaceReader(
        T_base_laser=se3.identity(), range_max_m=25.0, noise_m=0.02, noise_per_m=0.0
    )
    angle = np.radians(1.0)
    return reader.read(
        LaserScan(
            stamp_ns=0,
            ranges_m=np.repeat(np.float32(ahead_m / np.cos(0.5 * angle)), 2),
            angle_min_rad=-0.5 * angle,
            angle_step_rad=angle,
            range_min_m=0.05,
            range_max_m=25.0,
        )
    )


def test_normal_of_two_far_beams_is_uncertain():
    """Two beams 0.35 m apart, with 2 cm of noise, show a wall's direction within 5 degrees."""
    two = two_far_beams(20.0)
    variance = (np.sqrt(2.0) * 0.02 / (20.0 * np.radians(1.0))) ** 2
    assert two.normal_variance == pytest.approx(np.repeat(variance, 2), rel=0.01)


@pytest.mark.parametrize(("aside_m", "ratio"), [(0.0, 1.0), (0.17, 1.0), (0.17, 0.3)])
def test_pair_off_its_point_is_uncertain_by_the_direction_of_two_beams(aside_m, ratio):
    """Half of the gap aside, the direction adds half of the range's variance, whatever that is."""
    two = two_far_beams(20.0)
    pairs = _Pairs.of(two.with_noise(ratio), LikelihoodField(two, 0.05), np.array([0, aside_m, 0]))
    away_m = min(aside_m, 20.0 * np.radians(1.0) - aside_m)
    known = 1.0 / (1.0 + 2.0 * (away_m / (20.0 * np.radians(1.0))) ** 2)
    assert pairs.certain.min() == pytest.approx(known, abs=0.02)
    assert pairs.is_sparse.all()


def test_points_between_two_beams_do_not_confirm_a_pose():
    two = two_far_beams(20.0)
    field = LikelihoodField(two, 0.05)
    pose = np.array([0.0, 0.15, 0.0])
    near, _, _ = _residuals(two, field, _Pairs.of(two, field, pose), pose, 1.0)
    assert (near > 0.1).all()


def test_a_motion_that_lets_the_scan_draw_it_on_is_tried_from_where_another_leads():
    """Wheels run backwards, surely; that nothing is known of the motion predicts nearly the same.

    The search finds nothing better: its window ends before.
    """
    reader = ScanSurfaceReader(
        T_base_laser=se3.identity(), range_max_m=25.0, noise_m=0.01, noise_per_m=0.0
    )
    field = LikelihoodField(reader.read(scan_at(room(), se3.identity(), stamp_ns=0)), 0.05)
    seen = reader.read(scan_at(room(), se3.from_xy_yaw(0.05, 0.0, 0.0), stamp_ns=0))
    wheels = MotionPrior.of(np.array([-0.01, 0.0, 0.0]), np.diag([2e-3, 2e-3, 5e-3]) ** 2, 0.99)
    any_motion = MotionPrior.of(np.zeros(3), np.diag([0.3, 0.3, 5e-3]) ** 2, 0.5)
    matcher = Matcher(window_m=0.01, window_rad=0.01, degeneracy_ratio=0.01, shift_m=0.01)
    match = matcher.match(seen, field, [wheels, any_motion], novelty=0.15)  # images at 30 Hz
    assert abs(match.T_local_base[0] - 0.05) < 0.005
    assert np.argmax(match.probabilities) == 1
