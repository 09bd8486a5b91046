"""The map during a run: what is drawn, when, and what happens if drawing fails."""

from threading import Condition, Event

import numpy as np
import pytest
from fakes import RIG

from sceneslam.sinks.live_map import NOTHING, LiveMap
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Sensor

IMAGE, DEPTH_M = np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32)


def scan(stamp_ns):
    ranges_m = np.ones(4, np.float32)
    limits = {"range_min_m": 0.1, "range_max_m": 10.0}
    angles = {"angle_min_rad": 0.0, "angle_step_rad": 0.1}
    return LaserScan(stamp_ns=stamp_ns, ranges_m=ranges_m, **angles, **limits)


class Notes:
    """A mapper that remembers stamps; below 0 it fails, and the map of an odd one does."""

    sensors = frozenset({Sensor.SCAN, Sensor.DEPTH})

    def __init__(self):
        self.stamps_ns, self.is_adding, self.may_go_on = [], Event(), Event()
        self.T_map_then = None
        self.may_go_on.set()

    def open(self, rig):
        pass

    def add(self, observation, T_map_base, T_map_then):
        self.T_map_then = T_map_then
        self.stamps_ns.append(observation.stamp_ns)
        self.is_adding.set()
        assert self.may_go_on.wait(10.0)
        if observation.stamp_ns < 0:
            raise ValueError("a depth of letters")

    def move(self, moved):
        self.stamps_ns.append(moved)

    def map(self):
        if self.stamps_ns[-1] % 2:
            raise ValueError("no memory for the map")
        return NOTHING


@pytest.fixture
def mapper():
    return Notes()


@pytest.fixture
def published():
    return Event()


@pytest.fixture
def live_map(mapper, published):
    made = LiveMap(mapper, every_s=0.0, publish=lambda hybrid: published.set())
    yield made
    made.close()


def add(live_map, stamp_ns, **measured):
    """Add an observation at a new place."""
    seen = Observation(stamp_ns=stamp_ns, **measured)
    live_map.add(seen, se3.from_xy_yaw(float(stamp_ns), 0.0, 0.0))


def test_a_late_scan_is_drawn_where_the_robot_was(live_map, mapper):
    live_map.open(RIG)
    add(live_map, 10)
    add(live_map, 20)
    add(live_map, 30, scan=scan(14))
    assert mapper.is_adding.wait(10.0)
    np.testing.assert_allclose(mapper.T_map_then, se3.from_xy_yaw(14.0, 0.0, 0.0), atol=1e-9)


def test_observations_that_cannot_be_drawn_replace_none_that_can(live_map, mapper):
    live_map.open(RIG)
    mapper.may_go_on.clear()
    add(live_map, 2, depth_m=DEPTH_M)
    assert mapper.is_adding.wait(10.0)
    add(live_map, 4, image_bgr=IMAGE, depth_m=DEPTH_M)
    add(live_map, 6, image_bgr=IMAGE)
    mapper.is_adding.clear()
    mapper.may_go_on.set()
    assert mapper.is_adding.wait(10.0)
    live_map.close()
    assert mapper.stamps_ns == [2, 4]


@pytest.mark.parametrize("fails_at", [-2, 1])
def test_an_error_of_drawing_costs_one_observation_and_is_raised_at_the_end(
    live_map, mapper, published, fails_at
):
    live_map.open(RIG)
    add(live_map, fails_at, depth_m=DEPTH_M)
    assert mapper.is_adding.wait(10.0)
    add(live_map, 2, depth_m=DEPTH_M)
    assert published.wait(10.0)
    with pytest.raises(ValueError, match=r"letters|memory"):
        live_map.close()
    live_map.close()


def test_a_map_that_does_not_change_is_waited_for_without_a_deadline(live_map, published):
    waits_s, has_waited = [], Event()

    class Waits(Condition):
        def wait_for(self, predicate, timeout=None):
            waits_s.append(timeout)
            has_waited.set()
            return super().wait_for(predicate, timeout)

    live_map._changed = Waits()
    live_map.open(RIG)
    assert has_waited.wait(10.0) and waits_s[0] is None
    has_waited.clear()
    add(live_map, 2, depth_m=DEPTH_M)
    assert published.wait(10.0) and has_waited.wait(10.0)
    assert waits_s == [None] * 2


def test_what_was_drawn_is_moved_before_the_next_observation(live_map, mapper):
    live_map.open(RIG)
    add(live_map, 10, depth_m=DEPTH_M)
    assert mapper.is_adding.wait(10.0)
    mapper.is_adding.clear()
    live_map.move(0)
    live_map.add(Observation(stamp_ns=12, depth_m=DEPTH_M), se3.from_xy_yaw(10.0, 0.0, 0.0))
    assert mapper.is_adding.wait(10.0)  # though the robot did not move
    assert mapper.stamps_ns == [10, 0, 12]
