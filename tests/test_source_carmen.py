"""CARMEN logs."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_recordings import make_source

from sceneslam.sources.carmen import Carmen
from sceneslam.sources.rising import (
    continued_stamps,
    longest_rising,
    measured_stamps,
    rising_stamps,
)
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.se3 import from_xy_yaw, yaw_rad


def flaser(ranges: Sequence[float], stamp: str, x: float = 1.0) -> str:
    values = " ".join(f"{one:.3f}" for one in ranges)
    return f"FLASER {len(ranges)} {values} 9 9 9 {x} 2.0 0.5 {stamp} nohost 0.1"


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines))
    return path


def test_the_intel_log_is_read_whole_and_without_fault(
    shared_data: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = make_source("carmen", shared_data / "carmen_intel" / "intel.clf")
    found = list(source)
    assert len(found) == source.length == 13631
    stamps_ns = np.array([one.stamp_ns for one in found])
    assert (np.diff(stamps_ns) > 0).all()
    logged_ns = source.logged_ns(stamps_ns)
    assert logged_ns[0] == 976052857_337530000
    assert len(np.unique(logged_ns)) == len(found)
    # Received in bursts, 0.09 s apart in the median and 631 times out of order; measured at 5 Hz.
    np.testing.assert_allclose(np.percentile(np.diff(stamps_ns), (5, 95)), 0.1975e9, rtol=0.1)
    wheels_m = np.array([one.T_odom_base[:2, 3] for one in found])
    assert np.linalg.norm(np.diff(wheels_m, axis=0), axis=1).sum() < 510  # by stamps: 661 m
    assert list(source.faults) == []
    assert caplog.records == []
    scan = found[0].scan
    assert len(scan.ranges_m) == 180
    assert scan.angle_step_rad == pytest.approx(np.pi / 180)
    assert np.isinf(scan.ranges_m[87])


@pytest.mark.parametrize(
    ("count", "step", "first"),
    [
        (180, 1.0, -90.0),
        (181, 1.0, -90.0),
        (360, 0.5, -90.0),
        (361, 0.5, -90.0),
        (400, 0.25, -49.875),
        (401, 0.25, -50.0),
        (241, 0.75, -90.0),
    ],
)
def test_the_count_tells_the_angles(tmp_path: Path, count: int, step: float, first: float) -> None:
    path = write(tmp_path / "a.log", flaser([2.0] * count, "10.5"))
    (one,) = make_source("carmen", path)
    assert np.rad2deg(one.scan.angle_min_rad) == pytest.approx(first)
    assert np.rad2deg(one.scan.angle_step_rad) == pytest.approx(step)


def test_odometry_and_stamp_are_those_of_the_line(tmp_path: Path) -> None:
    lines = ["ODOM 5 5 5 0 0 0 1.0 nohost 0", flaser([2.0] * 180, "10.123456")]
    (one,) = make_source("carmen", write(tmp_path / "a.log", *lines, "RLASER 1 2 3"))
    np.testing.assert_allclose(one.T_odom_base, from_xy_yaw(1.0, 2.0, 0.5))
    assert one.stamp_ns == 10_123456000


@pytest.mark.parametrize("codes_m", [(8.183, 8.191), (10.0,), (5.6,), (4.095,)])
def test_the_number_that_a_log_writes_for_no_return_is_no_wall(
    shared_data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, codes_m: Sequence[float]
) -> None:
    """What is beyond the first code is one of them."""
    lines = (shared_data / "carmen_aces" / "aces.clf").read_text().splitlines()
    written = []
    for line in [one for one in lines if one.startswith("FLASER")][:500]:
        words = line.split()
        ranges_m = np.array(words[2:182], dtype=float)
        is_far = ranges_m >= codes_m[0]
        ranges_m[is_far] = np.resize(codes_m, is_far.sum())
        written.append(" ".join([*words[:2], *map(str, ranges_m), *words[182:]]))
    with caplog.at_level(logging.INFO):
        found = list(make_source("carmen", write(tmp_path / "a.log", *written)))
    ranges_m = np.concatenate([one.scan.ranges_m for one in found])
    assert np.isposinf(ranges_m).mean() > 0.04
    assert ranges_m[np.isfinite(ranges_m)].max() < codes_m[0]
    assert found[0].scan.range_max_m == pytest.approx(codes_m[-1] - 0.02)
    (record,) = caplog.records
    assert f"from {codes_m[-1] - 0.02:.3f} m on" in record.getMessage()


def test_two_numbers_for_no_return_may_be_far_apart(tmp_path: Path) -> None:
    lines = [
        flaser([2.0, 3.0, 4.0 - 0.1 * at, 8.183, 9.5, 9.5], f"{at}.0", 0.1 * at) for at in range(12)
    ]
    for one in make_source("carmen", write(tmp_path / "a.log", *lines)):
        assert np.isposinf(one.scan.ranges_m[3:]).all()
        assert np.isfinite(one.scan.ranges_m[:3]).all()


def test_a_wall_is_seen_from_a_robot_that_approaches_it_or_stands(tmp_path: Path) -> None:
    """It fills a third of the view; a robot that stands reads the same number each time."""
    for name, step_m in (("still", 0.0), ("turns", 0.0), ("approaches", 0.05)):
        lines = []
        for at in range(60):
            front_m = 4.0 - step_m * at
            turned = np.roll([1.0] * 120 + [front_m] * 60, at if name == "turns" else 0)
            lines.append(flaser(list(turned), f"{at}.0", step_m * at))
        found = list(make_source("carmen", write(tmp_path / f"{name}.log", *lines)))
        assert all(np.isfinite(one.scan.ranges_m).all() for one in found)
        assert found[0].scan.range_max_m == 80.0


def test_the_parameter_places_the_laser(tmp_path: Path) -> None:
    parameter = "PARAM robot_frontlaser_offset 0.115 nohost 0"
    source = make_source("carmen", write(tmp_path / "a.log", parameter, flaser([1.0] * 180, "1.0")))
    assert source.rig.laser.T_base_laser[0, 3] == 0.115


def robotlaser(stamp: int, laser: Sequence[float], robot: Sequence[float]) -> str:
    poses = " ".join(map(str, (*laser, *robot)))
    return f"ROBOTLASER1 0 -1.0 2.0 0.5 30.0 0.01 0 3 1 2 3 0 {poses} 0 0 0 0 0 {stamp}.5 host 0"


@pytest.mark.parametrize("mount", [(0.25, 0.0, 0.0), (-0.3, 0.1, 3.14159)])
def test_a_first_line_whose_laser_is_at_the_origin_places_no_laser(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mount: Sequence[float]
) -> None:
    lines = [robotlaser(0, (0.0, 0.0, 0.0), (400.0, 30.0, 1.0))]
    for at in range(1, 9):
        T_odom_laser = from_xy_yaw(400.0 + at, 30.0, 1.0 - at) @ from_xy_yaw(*mount)
        laser = (*T_odom_laser[:2, 3], yaw_rad(T_odom_laser))
        lines.append(robotlaser(at, laser, (400.0 + at, 30.0, 1.0 - at)))
    source = make_source("carmen", write(tmp_path / "a.log", *lines))
    np.testing.assert_allclose(source.rig.laser.T_base_laser, from_xy_yaw(*mount), atol=1e-5)
    assert caplog.records == []


@pytest.mark.parametrize("scale", [0.0, 0.5, 5.0])
def test_lines_that_place_the_laser_nowhere_leave_it_to_the_parameter(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, scale: float
) -> None:
    """The laser's poses are zero, lag behind the robot's, or are far off."""
    parameter = "PARAM robot_frontlaser_offset 0.115 nohost 0"
    robots = [(0.5 * at, 1.0, 0.1 * at) for at in range(9)]
    robots += 20 * [(0.5, 0.2, 3.1)]  # where it is parked
    lines = [robotlaser(at, [scale * one for one in each], each) for at, each in enumerate(robots)]
    source = make_source("carmen", write(tmp_path / "a.log", parameter, *lines))
    np.testing.assert_allclose(source.rig.laser.T_base_laser, from_xy_yaw(0.115, 0.0, 0.0))
    (record,) = [one for one in caplog.records if one.levelname == "WARNING"]
    assert "0.115 m in front of its centre" in record.getMessage()


@pytest.mark.parametrize("offset", ["nan", "inf", "-inf", "0,115"])
def test_a_place_of_the_laser_that_is_no_number_is_named(tmp_path: Path, offset: str) -> None:
    lines = f"PARAM robot_frontlaser_offset {offset} nohost 0", flaser([1.0] * 180, "1.0")
    with pytest.raises(InputError, match=rf"robot_frontlaser_offset: .* got '{offset}': .*a\.log"):
        make_source("carmen", write(tmp_path / "a.log", *lines))


def test_new_lines_say_their_angles_and_mount(tmp_path: Path) -> None:
    line = (
        "ROBOTLASER1 0 -2.0 4.0 0.5 30.0 0.01 0 4 1.0 2.0 31.0 0.0 1 7 "
        "1.25 2.0 0.0 1.0 2.0 0.0 0 0 0.1 0.1 0 77.5 host 0.1"
    )
    source = make_source("carmen", write(tmp_path / "a.log", line))
    (one,) = source
    assert one.stamp_ns == 77_500000000
    assert one.scan.angle_min_rad == -2.0
    assert one.scan.range_max_m == 30.0
    np.testing.assert_array_equal(one.scan.ranges_m, np.array([1, 2, np.inf, np.nan], np.float32))
    np.testing.assert_allclose(source.rig.laser.T_base_laser[:2, 3], [0.25, 0.0])


@pytest.mark.parametrize(
    ("start", "step", "x"), [("nan", 0.5, 1.25), (-2.0, "nan", 1.25), (-2.0, 0.5, "nan")]
)
def test_a_line_whose_angles_or_mount_are_no_numbers_is_passed_over(
    tmp_path: Path, start: object, step: object, x: object
) -> None:
    form = (
        "ROBOTLASER1 0 {} 4.0 {} 30.0 0.01 0 4 1.0 2.0 31.0 0.0 0 "
        "{} 2.0 0.0 1.0 2.0 0.0 0 0 0.1 0.1 0 {} host 0.1"
    )
    lines = form.format(-2.0, 0.5, 1.25, 77.5), form.format(start, step, x, 78.5)
    source = make_source("carmen", write(tmp_path / "a.log", *lines))
    assert [one.stamp_ns for one in source] == [77_500000000]
    assert len(source.faults) == 1


def test_a_scan_that_is_told_in_both_ways_is_read_once(tmp_path: Path) -> None:
    new = (
        "ROBOTLASER1 0 -1.0 2.0 0.5 30.0 0.01 0 2 1.0 2.0 0 0 0 0 0 0 0 0 0 0.1 0.1 0 7.5 host 0.1"
    )
    (one,) = make_source("carmen", write(tmp_path / "a.log", new, flaser([2.0] * 180, "7.5")))
    assert len(one.scan.ranges_m) == 2


def test_a_cut_off_line_is_passed_over_and_told(tmp_path: Path) -> None:
    whole = flaser([2.0] * 180, "1.0")
    path = write(tmp_path / "a.log", whole, whole[:200], flaser([2.0] * 180, "3.0"))
    source = make_source("carmen", path)
    stamps_ns = np.array([one.stamp_ns for one in source])
    np.testing.assert_array_equal(source.logged_ns(stamps_ns), [10**9, 3 * 10**9])
    assert any("is invalid: 1 time" in fault for fault in source.faults)


def test_a_stamp_that_no_clock_has_counts_as_missing(tmp_path: Path) -> None:
    stamps = ["51.0", "52.0", "99999999999999999999.0", "54.0"]
    path = write(tmp_path / "a.log", *(flaser([2.0] * 180, stamp) for stamp in stamps))
    source = make_source("carmen", path)
    logged_ns = source.logged_ns(np.array([one.stamp_ns for one in source]))
    np.testing.assert_array_equal(logged_ns, np.arange(51, 55) * 10**9)


@pytest.mark.parametrize(("places", "order"), [((1, 2, 3), (0, 1, 2)), ((1, 3, 2), (0, 2, 1))])
def test_scans_come_in_the_order_in_which_the_robot_drove(
    tmp_path: Path, places: tuple[int, ...], order: tuple[int, ...]
) -> None:
    """Stamps of receipt can be wrong, and so can the order of the lines."""
    stamps = ["5.0", "5.9", "5.2"]
    lines = [flaser([2.0] * 180, stamp, x) for stamp, x in zip(stamps, places, strict=True)]
    source = make_source("carmen", write(tmp_path / "a.log", *lines))
    found = list(source)
    stamps_ns = np.array([one.stamp_ns for one in found])
    assert (np.diff(stamps_ns) > 0).all()
    assert [one.T_odom_base[0, 3] for one in found] == [1.0, 2.0, 3.0]
    logged_s = source.logged_ns(stamps_ns) * 1e-9
    np.testing.assert_allclose(logged_s, [float(stamps[place]) for place in order])


def test_a_clock_that_is_set_back_leaves_the_order_and_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = ["50.0", "51.0", "9.0", "52.0"]
    lines = [flaser([2.0] * 180, stamp, x) for x, stamp in enumerate(stamps)]
    source = make_source("carmen", write(tmp_path / "a.log", *lines))
    found = list(source)
    assert [one.T_odom_base[0, 3] for one in found] == [0.0, 1.0, 2.0, 3.0]
    logged_ns = source.logged_ns(np.array([one.stamp_ns for one in found]))
    np.testing.assert_array_equal(logged_ns, np.array([50.0, 51.0, 51.5, 52.0]) * 1e9)
    (record,) = caplog.records
    assert "1 of 4 scans" in record.getMessage()


@pytest.mark.parametrize("set_back_s", [10, 3600])
@pytest.mark.parametrize("wrong", [(), (20,), (20, 21), (60,), (99,)])
def test_scans_after_the_clock_was_set_back_keep_their_rate(
    set_back_s: int, wrong: tuple[int, ...]
) -> None:
    """Single stamps, and some in a row, may be missing as well."""
    true_ns = 10**18 + np.arange(100) * 200_000_000
    logged_ns = true_ns - np.where(np.arange(100) < 50, 0, set_back_s * 10**9)
    logged_ns[list(wrong)] = 0
    found_ns = continued_stamps(logged_ns, 2 * 10**9)
    assert (np.diff(found_ns) > 0).all()
    good = np.setdiff1d(np.arange(100), wrong)
    np.testing.assert_allclose(found_ns[good] - 10**18, true_ns[good] - 10**18, atol=1000)


def test_a_clock_that_was_ahead_for_a_while_is_right_again_after_a_pause() -> None:
    logged_ns = np.array([0.0, 0.2, 0.4, 1000.6, 1000.8, 4.2, 4.4]) * 1e9
    found_ns = continued_stamps(logged_ns.astype(np.int64), 2 * 10**9)
    assert (np.diff(found_ns) > 0).all()
    np.testing.assert_allclose(np.delete(found_ns, [3, 4]), np.delete(logged_ns, [3, 4]))


@pytest.mark.parametrize(("run_off_s", "later_off_s"), [(0.0, -25.0), (500.0, 0.0)])
def test_a_run_after_a_pause_is_believed_unless_its_clock_was_ahead(
    run_off_s: float, later_off_s: float
) -> None:
    """A run of 20 s after 10 s; the clock is then set back farther than the run is long."""
    true_s = np.r_[0:100:0.1, 110:130:0.1, 130:200:0.1]
    is_run, is_later = (true_s >= 110) & (true_s < 130), true_s >= 130
    logged_s = true_s + run_off_s * is_run + later_off_s * is_later
    found_ns = continued_stamps(np.rint(logged_s * 1e9).astype(np.int64), 2 * 10**9)
    assert (np.diff(found_ns) > 0).all()
    known = ~is_run if run_off_s else np.full(len(true_s), True)  # a run ahead is interpolated
    np.testing.assert_allclose(found_ns[known] * 1e-9, true_s[known], atol=1e-6)


def test_a_log_whose_stamps_are_all_zero_is_stamped_by_its_logger(tmp_path: Path) -> None:
    lines = [flaser([2.0] * 180, "0")[: -len("0.1")] + f"{0.2 * number:.1f}" for number in range(5)]
    source = make_source("carmen", write(tmp_path / "a.log", *lines))
    assert [one.stamp_ns for one in source] == [0, 2 * 10**8, 4 * 10**8, 6 * 10**8, 8 * 10**8]


def test_files_without_scans_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not found"):
        make_source("carmen", tmp_path / "nowhere.log")
    with pytest.raises(InputError, match="no scans"):
        make_source("carmen", write(tmp_path / "a.log", "ODOM 1 2 3"))
    (tmp_path / "b.log").write_bytes(b"")
    with pytest.raises(InputError, match="no scans"):
        make_source("carmen", tmp_path / "b.log")


@given(st.lists(st.integers(0, 10**6), max_size=40))
def test_stamps_are_made_to_rise_with_the_fewest_changes(places: list[int]) -> None:
    stamps_ns = np.array(places, dtype=np.int64) * 10**9
    rising = rising_stamps(stamps_ns)
    assert (np.diff(rising) > 0).all()
    assert (rising == stamps_ns).sum() >= len(longest_rising(stamps_ns))
    if places:
        assert (np.diff(continued_stamps(stamps_ns, 2 * 10**9)) > 0).all()


def test_one_late_stamp_is_set_between_its_neighbours() -> None:
    stamps_ns = np.array([1, 2, 9, 4, 5]) * 10**9
    np.testing.assert_array_equal(rising_stamps(stamps_ns), np.array([1, 2, 3, 4, 5]) * 10**9)


def test_bursts_are_spread_over_the_time_in_which_they_were_measured() -> None:
    """A computer is busy for 2 s, then stamps what has waited."""
    true_ns = np.arange(300) * 200_000_000
    received_ns = true_ns + np.random.default_rng(0).integers(0, 50_000_000, 300)
    received_ns[100:110] = received_ns[110] + np.arange(10) * 10**6
    found_ns = measured_stamps(received_ns)
    assert np.abs(np.diff(found_ns) - 200_000_000).max() < 30_000_000
    assert (received_ns >= found_ns).all()


def test_a_pause_stays_where_it_was_and_exact_stamps_stay_as_they_are() -> None:
    exact_ns = np.arange(1000) * 200_000_000
    np.testing.assert_array_equal(measured_stamps(exact_ns), exact_ns)
    exact_ns[500:] += 3 * 10**9
    np.testing.assert_array_equal(measured_stamps(exact_ns), exact_ns)


@pytest.mark.parametrize("rates", [((600, 0.5), (300, 0.2)), ((300, 0.2), (600, 0.5))])
def test_scans_of_a_rate_that_changes_stay_where_they_were(
    rates: tuple[tuple[int, float], ...],
) -> None:
    steps_ns = np.repeat([int(period_s * 1e9) for _, period_s in rates], [n for n, _ in rates])
    exact_ns = np.cumsum(steps_ns)
    np.testing.assert_allclose(measured_stamps(exact_ns), exact_ns, atol=1000, rtol=0)


@given(st.lists(st.integers(0, 10**6), max_size=60))
def test_measured_stamps_rise(places: list[int]) -> None:
    assert (np.diff(measured_stamps(np.array(places, dtype=np.int64) * 10**6)) > 0).all()


def test_noise_of_the_wheels_is_the_configuration_s(tmp_path: Path) -> None:
    path = write(tmp_path / "log.clf", flaser([1.0, 2.0], "1.0"))
    usual, given_noise = (
        Carmen(str(path), 80.0, wheels) for wheels in (None, {"noise_ratio": 0.3})
    )
    assert given_noise.rig.wheels.noise_ratio == 0.3 > usual.rig.wheels.noise_ratio
    for wrong, key in (({"noise": 0.3}, "wheels.noise"), ({"floor_m": 0.0}, "wheels.floor_m")):
        with pytest.raises(ConfigError, match=key):
            Carmen(str(path), 80.0, wrong)
