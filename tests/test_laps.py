"""A round trip driven again and again: time, odometry and truth go on."""

from dataclasses import replace

import numpy as np
import pytest
from fakes import FakeSource
from test_source_ordered import Listed

from sceneslam.sources.changes.laps import Laps
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan


def test_stamps_and_odometry_go_on_from_lap_to_lap():
    one, many = list(FakeSource(10, 6)), list(Laps(FakeSource(10, 6), 3))
    assert len(many) == 30
    assert (np.diff([each.stamp_ns for each in many]) > 0).all()
    T_first = one[0].T_odom_base
    for lap in range(1, 3):
        T_start, T_end = many[10 * lap].T_odom_base, many[10 * lap - 1].T_odom_base
        np.testing.assert_allclose(T_start, T_end, atol=1e-12)  # it ends where it began
        for index in range(10):
            moved = se3.inverse(T_start) @ many[10 * lap + index].T_odom_base
            np.testing.assert_allclose(
                moved, se3.inverse(T_first) @ one[index].T_odom_base, atol=1e-9
            )


def test_truth_is_that_of_all_laps():
    laps = Laps(FakeSource(10, 6), 3)
    truth, stamps_ns = laps.ground_truth(), [each.stamp_ns for each in laps]
    assert truth.trajectory.stamps_ns.tolist() == stamps_ns
    assert [each.scene for each in truth.scenes] == ["Bright", "Dark"] * 3
    assert truth.scenes[2].stamp_ns == stamps_ns[10]


def test_odometry_that_begins_late_or_ends_early_goes_on():
    every = list(FakeSource(10, 6))
    for gap in (0, -1):
        one = [replace(each) for each in every]
        one[gap] = replace(one[gap], T_odom_base=None)
        known = [each.T_odom_base for each in Laps(Listed(one), 3) if each.T_odom_base is not None]
        for lap in range(1, 3):
            np.testing.assert_allclose(known[9 * lap], known[9 * lap - 1], atol=1e-12)
            np.testing.assert_allclose(
                se3.inverse(known[9 * lap]) @ known[9 * lap + 8],
                se3.inverse(known[0]) @ known[8],
                atol=1e-9,
            )


def test_truth_outside_of_a_lap_is_not_repeated():
    class Within(FakeSource):
        def __iter__(self):
            yield from list(super().__iter__())[3:8]

    laps = Laps(Within(10, 2), 3)
    truth, stamps_ns = laps.ground_truth(), [each.stamp_ns for each in laps]
    assert truth.trajectory.stamps_ns.tolist() == stamps_ns
    assert [each.scene for each in truth.scenes] == ["Dark"]
    assert 0 <= stamps_ns[0] - truth.scenes[0].stamp_ns < 33_000_000


def test_scan_is_moved_with_its_observation():
    scan = LaserScan(
        stamp_ns=90_000_000,
        ranges_m=np.ones(3, np.float32),
        angle_min_rad=0.0,
        angle_step_rad=0.1,
        range_min_m=0.1,
        range_max_m=10.0,
    )
    one = [replace(each, scan=replace(scan, stamp_ns=each.stamp_ns)) for each in FakeSource(4, 9)]
    assert all(each.scan.stamp_ns == each.stamp_ns for each in Laps(Listed(one), 2))


def test_no_lap_is_refused():
    with pytest.raises(ConfigError, match="laps"):
        Laps(FakeSource(4, 9), 0)
