"""The laser after seconds without scans and wheels: where it is, or that it does not know."""

from dataclasses import replace

import numpy as np
import pytest
from test_laser_loop import furnished, settings
from test_laser_world import box, corridor, drive, room, scan_at

from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.types import se3
from sceneslam.types.rig import Laser, Rig, Sensor

RIG = Rig(sensors=frozenset({Sensor.SCAN}), laser=Laser())
PERIOD_NS = 100_000_000


def answers(walls, before, after, *, gap_s, seen=lambda scan: scan, **view):
    """Return the answers to scans along a path (x, y, yaw), and to those after a gap."""
    module = LaserSlam(**settings())
    module.activate(RIG)
    rng = np.random.default_rng(5)
    for one in drive(walls, before, rng=rng, period_ns=PERIOD_NS, **view):
        module.track(one)
    start_ns = len(before) * PERIOD_NS + round(gap_s * 1e9)
    found = []
    for one in drive(walls, after, rng=rng, period_ns=PERIOD_NS, **view):
        stamp_ns = start_ns + one.stamp_ns
        scan = seen(replace(one.scan, stamp_ns=stamp_ns))
        found.append(module.track(replace(one, stamp_ns=stamp_ns, scan=scan)))
    return found


def ahead(start, count, step_m=0.05, yaw=0.0):
    x, y = start
    return np.array([(x + step_m * i * np.cos(yaw), y, yaw) for i in range(count)])


def statuses(found):
    return [one.status.value for one in found]


@pytest.mark.parametrize("gap_s", [1.5, 4.0])
def test_it_is_found_where_it_was_carried_in_the_room_that_it_knows(gap_s):
    before = ahead((-1.0, 0.0), 30)
    after = ahead((-0.8, -0.6), 5, yaw=0.7)
    found = answers(room(), before, after, gap_s=gap_s)
    assert statuses(found) == ["tracking"] * 5
    T_true = se3.inverse(se3.from_xy_yaw(*before[0])) @ se3.from_xy_yaw(*after[-1])
    off = se3.inverse(T_true) @ found[-1].T_local_base
    assert np.linalg.norm(off[:2, 3]) < 0.05 and abs(se3.yaw_rad(off)) < 0.02


def test_somebody_who_stands_before_a_wall_does_not_hide_where_it_is():
    def person(scan):
        ranges = scan.ranges_m.copy()
        ranges[80:100] = 0.8  # 20 degrees of 360
        return replace(scan, ranges_m=ranges)

    after = ahead((-0.8, -0.6), 5, yaw=0.7)
    found = answers(room(), ahead((-1.0, 0.0), 30), after, gap_s=1.5, seen=person)
    assert statuses(found) == ["tracking"] * 5


def test_in_a_room_that_it_does_not_know_it_is_lost_and_could_begin():
    other = np.concatenate([box(97, -1, 102, 4), box(99, 2, 100, 3), box(101, -1, 101.5, 0)])
    walls = np.concatenate([room(), other])
    found = answers(walls, ahead((-1.0, 0.0), 30), ahead((98.0, 0.5), 5), gap_s=4.0)
    assert statuses(found) == ["lost"] * 5
    assert all(one.can_begin and one.covariance is None for one in found)


def test_in_a_square_room_it_does_not_guess_which_way_it_looks():
    before = [(0.0, 0.0, 0.02 * index) for index in range(30)]
    after = [(0.0, 0.0, 2.0)] * 5
    found = answers(box(-2, -2, 2, 2), np.array(before), np.array(after), gap_s=2.0)
    assert statuses(found) == ["lost"] * 5


def test_along_a_corridor_the_gap_counts_across_alone():
    """What a scan does not measure follows the prediction, and is not searched."""
    found = answers(corridor(), ahead((0.0, 0.0), 30), ahead((3.0, 0.1), 5), gap_s=0.7)
    assert set(statuses(found)) == {"degraded"}


def test_a_short_gap_changes_nothing():
    walls = furnished(np.random.default_rng(1))
    found = answers(walls, ahead((0.0, 0.0), 60), ahead((3.1, 0.0), 5), gap_s=0.2)
    assert statuses(found) == ["tracking"] * 5


def test_a_scan_that_shows_nothing_is_none_to_begin_with():
    module = LaserSlam(**settings())
    module.activate(RIG)
    for one in drive(room(), ahead((-1.0, 0.0), 30), period_ns=PERIOD_NS):
        module.track(one)
    scan = scan_at(room(), np.eye(4), stamp_ns=7 * 10**9)
    blind = replace(scan, ranges_m=np.full_like(scan.ranges_m, np.nan))
    answer = module.track(replace(one, stamp_ns=7 * 10**9, scan=blind))
    assert answer.status.value == "lost" and not answer.can_begin
