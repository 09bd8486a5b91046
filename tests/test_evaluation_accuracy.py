"""Our numbers against evo's (1.38.1) on published trajectories, and the laws they obey."""

from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, loop, moved, shaken, stamps
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneslam.evaluation.accuracy import (
    absolute_errors,
    relative_errors,
    root_mean_square,
    rotation_rmse_rad,
)
from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import associate, covered, interpolated, nearest
from sceneslam.evaluation.comparison import compare
from sceneslam.evaluation.correctness import CorrectLimits, correct_rate, correct_rate_observed
from sceneslam.evaluation.files import read_poses
from sceneslam.evaluation.path import length_ratio, segment_errors
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.trajectory import Trajectory

# Made with evo 1.38.1: sync.associate_trajectories(max_diff=gap), align(correct_scale=False),
# APE(translation_part): matched poses, RMSE, maximum.
GOLDEN = [
    ("freiburg1_xyz-groundtruth", "freiburg1_xyz-rgbdslam", 0.01, 785, 0.0134700888, 0.0347595459),
    ("freiburg1_xyz-groundtruth", "freiburg1_xyz-rgbdslam", 0.02, 786, 0.0134734678, 0.0347272017),
    ("fr2_desk_groundtruth", "fr2_desk_ORB", 0.01, 2174, 0.0081189776, 0.0242995937),
    ("fr2_desk_groundtruth", "fr2_desk_ORB", 0.02, 2225, 0.0081459566, 0.0243378396),
    ("KITTI_00_gt", "KITTI_00_ORB", 0.01, 4541, 1.3034497146, 3.5879491207),
    ("KITTI_00_gt", "KITTI_00_SPTAM", 0.01, 4541, 3.7384879076, 7.7689774066),
]
# RPE(translation_part, rotation_angle_rad) with delta=1 frame, all_pairs; we give frames 1 s.
GOLDEN_RELATIVE = [
    ("KITTI_00_ORB", 0.0281203770, 0.0020066665),
    ("KITTI_00_SPTAM", 0.0349193676, 0.0051729786),
]
# The same with delta=30 frames of a nominal 30 Hz: our 1 s pairs are nearly these.
GOLDEN_30_FRAMES = [
    ("freiburg1_xyz-groundtruth", "freiburg1_xyz-rgbdslam", 0.0217005791, 0.0163465120),
    ("fr2_desk_groundtruth", "fr2_desk_ORB", 0.0077019772, 0.0085362602),
]
twists = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


@pytest.mark.parametrize(("true", "name", "gap_s", "matched", "rmse_m", "max_m"), GOLDEN)
def test_absolute_error_equals_evo(shared_data, true, name, gap_s, matched, rmse_m, max_m):
    folder = shared_data / "trajectories"
    errors = absolute_errors(
        read_poses(folder / f"{name}.txt"), read_poses(folder / f"{true}.txt"), gap_s
    )
    assert len(errors.errors_m) == matched
    assert errors.rmse_m == pytest.approx(rmse_m, abs=1e-6)
    assert errors.max_m == pytest.approx(max_m, abs=1e-6)


@pytest.mark.parametrize(("name", "trans_m", "rot_rad"), GOLDEN_RELATIVE)
def test_relative_error_over_one_frame_equals_evo(shared_data, name, trans_m, rot_rad):
    folder = shared_data / "trajectories"
    errors = relative_errors(
        read_poses(folder / f"{name}.txt"), read_poses(folder / "KITTI_00_gt.txt"), 0.01, 1.0
    )
    assert root_mean_square(errors.trans_m) == pytest.approx(trans_m, abs=1e-6)
    assert root_mean_square(errors.rot_rad) == pytest.approx(rot_rad, abs=1e-6)


@pytest.mark.parametrize(("true", "name", "trans_m", "rot_rad"), GOLDEN_30_FRAMES)
def test_relative_error_over_a_second_is_near_evos_over_30_frames(
    shared_data, true, name, trans_m, rot_rad
):
    folder = shared_data / "trajectories"
    errors = relative_errors(
        read_poses(folder / f"{name}.txt"), read_poses(folder / f"{true}.txt"), 0.01, 1.0
    )
    assert root_mean_square(errors.trans_m) == pytest.approx(trans_m, rel=0.1)
    assert root_mean_square(errors.rot_rad) == pytest.approx(rot_rad, rel=0.1)


@given(twists, twists)
@settings(max_examples=30, deadline=None)
def test_absolute_error_does_not_depend_on_either_frame(xi_estimate, xi_truth):
    truth = loop(60)
    estimate = shaken(truth, 0.05)
    expected_m = absolute_errors(estimate, truth, 0.01).errors_m
    assert expected_m.max() > 0.01
    errors = absolute_errors(
        moved(estimate, se3.exp(xi_estimate)), moved(truth, se3.exp(xi_truth)), 0.01
    )
    np.testing.assert_allclose(errors.errors_m, expected_m, atol=1e-9)


@given(twists, st.integers(1, 80))
@settings(max_examples=30, deadline=None)
def test_a_trajectory_has_no_error_against_itself(xi, count):
    truth = loop(count)
    estimate = moved(truth, se3.exp(xi))
    assert absolute_errors(estimate, truth, 0.01).max_m < 1e-9
    relative = relative_errors(estimate, truth, 0.01, 1.0)
    assert np.all(relative.trans_m < 1e-9)
    assert len(relative.trans_m) == max(count - 10, 0)


@given(twists, st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_alignment_of_a_straight_path_finds_the_rotation_about_it(xi, count):
    straight = np.tile(np.eye(4), (count, 1, 1))
    straight[:, 0, 3] = np.arange(count)
    T_gt_map = se3.exp(xi)
    np.testing.assert_allclose(align(straight, T_gt_map @ straight), T_gt_map, atol=1e-6)


def test_lateral_noise_on_a_straight_path_does_not_roll_the_robot_over():
    truth = loop(100)
    truth.T_world_base[:, :3, :3] = np.eye(3)
    truth.T_world_base[:, :3, 3] = 0.0
    truth.T_world_base[:, 0, 3] = 0.1 * np.arange(100)
    true_y_m = 0.01 * np.sin(np.arange(100))
    estimate = Trajectory(stamps_ns=truth.stamps_ns, T_world_base=truth.T_world_base.copy())
    truth.T_world_base[:, 1, 3] = true_y_m
    estimate.T_world_base[:, 1, 3] = -true_y_m  # positions alone: best turned upside down
    assert correct_rate(estimate, truth, CorrectLimits(limit_m=0.1, limit_rad=0.2)) == 1.0


def test_correct_rate_counts_time_within_both_limits():
    truth = loop(101)  # 10 s
    T_world_base = truth.T_world_base.copy()
    T_world_base[80:, :3, 3] += [0.0, 0.0, 50.0]
    estimate = Trajectory(stamps_ns=truth.stamps_ns, T_world_base=T_world_base)
    assert correct_rate(
        estimate, truth, CorrectLimits(limit_m=30.0, limit_rad=3.2)
    ) == pytest.approx(0.8)
    assert correct_rate(truth, truth, CorrectLimits(limit_m=0.1, limit_rad=0.1)) == 1.0


def test_correct_rate_allows_more_the_further_was_driven():
    truth = straight(np.full(100, 1.0))  # 100 m
    bent = straight(np.full(100, 1.0), y_m=np.linspace(0.0, 1.0, 101))
    T_world_base = bent.T_world_base.copy()
    T_world_base[::2, 1, 3] *= -1.0  # off by 1 % of the distance, to either side in turn
    estimate = Trajectory(stamps_ns=bent.stamps_ns, T_world_base=T_world_base)
    limits = [
        CorrectLimits(limit_m=0.25, limit_rad=0.2, limit_ratio=ratio)
        for ratio in (0.0, 0.004, 0.01)
    ]
    rates = [correct_rate(estimate, truth, one) for one in limits]
    assert rates == pytest.approx([0.25, 0.42, 1.0], abs=0.03)


def straight(steps_m, y_m=0.0):
    """Return a drive along x, a step per tenth of a second."""
    T_world_base = np.tile(np.eye(4), (len(steps_m) + 1, 1, 1))
    T_world_base[1:, 0, 3] = np.cumsum(steps_m)
    T_world_base[:, 1, 3] = y_m
    return Trajectory(stamps_ns=stamps(len(T_world_base)), T_world_base=T_world_base)


def test_segment_error_is_the_motions_error_over_each_stretch_of_the_true_path():
    truth = straight(np.full(300, 0.1))  # 30 m
    steps_m = np.where(np.arange(300) < 150, 0.1, 0.11)  # 10 % too long from half-way on
    found = segment_errors(straight(steps_m), truth, 0.01, 9.95)
    assert len(found.trans_m) in (200, 201)  # the last by rounding
    np.testing.assert_allclose(found.trans_m[:50], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.trans_m[150:], 1.0, atol=0.02)
    assert not len(segment_errors(straight(steps_m), truth, 0.01, 31.0).trans_m)
    T_gt_map = se3.exp(np.array([3.0, -2.0, 0.5, 0.1, -0.2, 2.0]))
    aside = segment_errors(straight(steps_m), moved(truth, T_gt_map), 0.01, 9.95)
    np.testing.assert_allclose(aside.trans_m, found.trans_m, atol=1e-9)


def test_segments_do_not_span_a_way_without_poses():
    x_m = 40.0 - np.abs(np.arange(801) * 0.1 - 40.0)  # 40 m out, and back
    truth = straight(np.diff(x_m))
    drifted = straight(1.01 * np.diff(x_m))
    seen = np.flatnonzero(np.abs(np.arange(801) - 400) > 150)  # not around the turn
    estimate = Trajectory(
        stamps_ns=drifted.stamps_ns[seen], T_world_base=drifted.T_world_base[seen]
    )
    found = segment_errors(estimate, truth, 0.01, 9.95).trans_m
    assert len(found) == 2 * 150 and found == pytest.approx(0.1, abs=0.01)


def test_length_ratio_tells_a_scale_and_ignores_what_was_not_estimated():
    truth, twice = loop(100), loop(100)
    twice.T_world_base[:, :3, 3] *= 1.05
    assert length_ratio(twice, truth, 0.01) == pytest.approx(1.05)
    part = Trajectory(stamps_ns=twice.stamps_ns[:30], T_world_base=twice.T_world_base[:30])
    assert length_ratio(part, truth, 0.01) == pytest.approx(1.05)
    assert np.isnan(length_ratio(Trajectory.empty(), truth, 0.01))
    assert np.isnan(length_ratio(truth, straight(np.zeros(99)), 0.01))


def test_rotation_error_is_what_one_alignment_leaves():
    truth = loop(100)
    turned = truth.T_world_base.copy()
    turned[::2] = turned[::2] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2]))
    turned[1::2] = turned[1::2] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -0.2]))
    estimate = Trajectory(stamps_ns=truth.stamps_ns, T_world_base=turned)
    T_gt_map = se3.exp(np.array([3.0, -2.0, 0.5, 0.1, -0.2, 2.0]))
    assert rotation_rmse_rad(estimate, moved(truth, T_gt_map), 0.01) == pytest.approx(0.2, abs=1e-3)
    assert absolute_errors(estimate, truth, 0.01).rmse_m == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(rotation_rmse_rad(Trajectory.empty(), truth, 0.01))


def test_correct_rate_lets_a_pose_vouch_for_one_second():
    truth = loop(101)
    index = np.array([0, 5, 100])  # 0.5 s and 9.5 s to the next
    estimate = Trajectory(stamps_ns=truth.stamps_ns[index], T_world_base=truth.T_world_base[index])
    assert correct_rate(
        estimate, truth, CorrectLimits(limit_m=0.1, limit_rad=0.1)
    ) == pytest.approx(0.15)


def test_correct_rate_does_not_count_a_pause_of_the_recording():
    truth = loop(101)
    observed = np.r_[0:21, 81:101]  # 6 s without observations
    wrong = truth.T_world_base.copy()
    wrong[20] = wrong[20] @ se3.from_xy_yaw(9.0, 0.0, 0.0)
    estimate = Trajectory(stamps_ns=truth.stamps_ns[observed], T_world_base=wrong[observed])
    limits = CorrectLimits(limit_m=3.0, limit_rad=np.pi)
    rate = correct_rate_observed(estimate, truth, truth.stamps_ns[observed], limits)
    assert rate == pytest.approx(3.9 / 4.9)


def test_correct_rate_of_no_poses_is_zero_and_without_truth_unknown():
    assert correct_rate(Trajectory.empty(), loop(50), CorrectLimits(limit_m=1, limit_rad=1)) == 0.0
    assert np.isnan(
        correct_rate(loop(50), Trajectory.empty(), CorrectLimits(limit_m=1, limit_rad=1))
    )


def test_correct_rate_of_recorded_wheel_odometry_is_high(shared_data):
    """OpenLORIS home-1-1: odometry all correct, ORB-SLAM2 lost for most of it (limits 3 m, 30°)."""
    folder = shared_data / "openloris"
    truth = _openloris(folder / "gt" / "gt_home_1.txt")
    odometry = _openloris(folder / "recorded" / "odom" / "home-1-1-odom.txt")
    rate = correct_rate(odometry, truth, CorrectLimits(limit_m=3.0, limit_rad=np.pi / 6))
    assert rate == pytest.approx(1.0, abs=0.001)


def _openloris(path: Path) -> Trajectory:
    """Return sequence 1 of a file of OpenLORIS-Scene."""
    text = path.read_text().split("seq: 1\n")[1].split("seq:")[0]
    rows = np.array([line.split() for line in text.splitlines() if line.strip()], dtype=float)
    return Trajectory(
        stamps_ns=np.round(rows[:, 0] * 1e9).astype(np.int64),
        T_world_base=se3.from_quat_xyzw(rows[:, -7:-4], rows[:, -4:]),
    )


@given(
    st.lists(st.integers(0, 1000), min_size=1, max_size=30).map(sorted),
    st.lists(st.integers(-100, 1100), min_size=1, max_size=30).map(sorted),
)
def test_nearest_is_the_smallest_distance_and_the_earlier_of_two(times, wanted):
    times_ns, wanted_ns = np.array(times), np.array(wanted)
    expected = np.abs(times_ns[None, :] - wanted_ns[:, None]).argmin(axis=1)
    np.testing.assert_array_equal(nearest(times_ns, wanted_ns), expected)


def test_association_leaves_out_what_is_too_far_apart():
    matches = associate(loop(20), loop(10, START_NS + 8_000_000), 0.01)
    np.testing.assert_array_equal(matches.first, np.arange(10))
    assert len(associate(loop(20), loop(10, START_NS + 12_000_000), 0.01)) == 0
    assert len(associate(loop(20), Trajectory.empty(), 0.01)) == 0


def test_interpolation_halves_the_motion_and_stops_at_gaps():
    two = Trajectory(
        stamps_ns=np.array([0, 10**9]),
        T_world_base=np.stack([np.eye(4), se3.from_xy_yaw(2.0, 0.0, 1.0)]),
    )
    middle = interpolated(two, np.array([5 * 10**8])).T_world_base[0]
    np.testing.assert_allclose(middle, se3.from_xy_yaw(1.0, 0.0, 0.5), atol=1e-12)
    wanted = np.array([-1, 0, 2 * 10**8, 10**9, 10**9 + 1])
    np.testing.assert_array_equal(covered(two, wanted, 0.5), [1, 3])
    np.testing.assert_array_equal(covered(two, wanted, 1.0), [1, 2, 3])


def test_comparison_aligns_nothing():
    reference = loop(50)
    difference = compare(moved(reference, se3.from_xy_yaw(0.3, 0.4, 0.0)), reference, 0.01)
    assert difference.max_m == pytest.approx(0.5)
    assert difference.rms_m == pytest.approx(0.5)
    assert np.isnan(compare(reference, loop(50, START_NS + 10**12), 0.01).max_m)


def test_a_map_that_begins_later_is_laid_on_the_other():
    whole = loop(50)
    T_map_begin = whole.T_world_base[20]
    later = Trajectory(
        stamps_ns=whole.stamps_ns[20:],
        T_world_base=se3.inverse(T_map_begin) @ whole.T_world_base[20:],
    )
    assert compare(later, whole, 0.01).max_m == pytest.approx(0.0, abs=1e-9)
    assert compare(whole, later, 0.01).max_m == pytest.approx(0.0, abs=1e-9)
    in_a_loaded_map = moved(later, T_map_begin @ se3.from_xy_yaw(0.3, 0.0, 0.0))
    assert compare(in_a_loaded_map, whole, 0.01).max_m == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "holds no poses"),
        ("1 2 3\n", "line 1: expected"),
        ("1 2 3 4 5 6 7 8 9 10 11 nan\n", "twelve finite numbers"),
        ("1 2 3 4 5 6 7 8 9 10 11 12\n1 2\n", "twelve numbers"),
        ("1 0 0 5 0 1 0 6 0 0 1 7\n2 0 0 5 0 2 0 6 0 0 2 7\n", "pose 2: .* no rotation"),
        ("1 0 0 5 0 1 0 6 0 0 -1 7\n", "pose 1: .* no rotation"),
    ],
)
def test_broken_trajectory_files_are_named_in_one_sentence(tmp_path, text, complaint):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint) as caught:
        read_poses(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_stamps_of_kitti_poses_are_their_numbers(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 5 0 1 0 6 0 0 1 7\n" * 3)
    poses = read_poses(path)
    np.testing.assert_array_equal(poses.stamps_ns, [0, 10**9, 2 * 10**9])
    np.testing.assert_array_equal(poses.positions_m, [[5, 6, 7]] * 3)
    assert len(stamps(3)) == 3
