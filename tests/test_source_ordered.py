"""Any source, wrapped so that its stamps rise."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.interfaces import Source
from sceneslam.sources.contract.ordered import Ordered
from sceneslam.sources.spanned import TimeSpan
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.truth import GroundTruth


@dataclass
class Listed:
    """A source that gives the observations of a list."""

    observations: Sequence[Observation]
    faults: Sequence[str] = ()
    rig: Rig = field(default_factory=lambda: Rig(sensors=frozenset({Sensor.POINTS})))

    @property
    def length(self) -> int:
        return len(self.observations)

    @property
    def span(self) -> TimeSpan | None:
        return None

    def __iter__(self) -> Iterator[Observation]:
        return iter(self.observations)

    def ground_truth(self) -> GroundTruth | None:
        return None


def at(*seconds: float) -> Listed:
    return Listed([Observation(stamp_ns=round(second * 1e9)) for second in seconds])


def seconds(source: Source) -> list[float]:
    return [observation.stamp_ns / 1e9 for observation in source]


def test_a_sound_source_passes_unchanged() -> None:
    inner = at(1, 2, 3)
    ordered = Ordered(inner)
    assert isinstance(ordered, Source)
    assert list(ordered) == list(inner.observations)
    assert ordered.faults == []
    assert ordered.length == 3


def test_repeated_and_backward_stamps_are_left_out_and_counted() -> None:
    ordered = Ordered(at(1, 2, 2, 1.5, 3))
    assert seconds(ordered) == [1, 2, 3]
    (fault,) = ordered.faults
    assert "2 times, first at stamp 2.000000 s" in fault


def test_one_stamp_far_ahead_does_not_cost_the_rest() -> None:
    ordered = Ordered(at(1, 2, 900, 3, 4))
    assert seconds(ordered) == [1, 2, 3, 4]
    assert len(ordered.faults) == 1
    assert seconds(Ordered(at(900, 1, 2, 3))) == [1, 2, 3]


@pytest.mark.parametrize("wrong", [1.4, 2.0, 5.0, 90.0])
def test_one_stamp_somewhat_ahead_does_not_cost_those_it_overtakes(wrong: float) -> None:
    times = [0.1 * index for index in range(10)]
    assert seconds(Ordered(at(*times, wrong, 1.0, 1.1))) == pytest.approx([*times, 1.0, 1.1])


def test_frames_that_are_missing_are_no_wrong_stamps() -> None:
    times = [0.0, 0.1, 0.2, 0.9, 1.0, 1.01, 1.1, 1.11, 3.0, 3.1]
    assert seconds(Ordered(at(*times))) == times


def test_a_gap_is_told_and_nothing_is_left_out() -> None:
    ordered = Ordered(at(1, 2, 10, 11), max_gap_s=5.0)
    assert seconds(ordered) == [1, 2, 10, 11]
    assert ordered.faults == ["no observation for 8.0 s: 1 time at stamp 2.000000 s"]


def test_reading_twice_counts_once() -> None:
    ordered = Ordered(at(1, 1))
    assert seconds(ordered) == seconds(ordered) == [1]
    assert "1 time" in ordered.faults[0]


def test_points_that_are_no_numbers_and_empty_images_are_dropped() -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [np.inf, 0, 0]], np.float32)
    observation = Observation(
        stamp_ns=1,
        points_lidar=points,
        point_times_s=np.array([0.0, 0.1, 0.2]),
        image_bgr=np.zeros((0, 5, 3), np.uint8),
        depth_m=np.zeros((0, 5), np.float32),
    )
    ordered = Ordered(Listed([observation]))
    (found,) = ordered
    assert found.image_bgr is None
    assert found.depth_m is None
    np.testing.assert_array_equal(found.points_lidar, points[:1])
    assert len(found.point_times_s) == 1
    assert len(ordered.faults) == 3


def pictures(*sizes_wh: tuple[int, int]) -> list[Observation]:
    """Return observations with images and depth of sizes [px]."""
    return [
        Observation(
            stamp_ns=stamp_ns,
            image_bgr=np.zeros((height, width, 3), np.uint8),
            depth_m=np.ones((height, width), np.float32),
        )
        for stamp_ns, (width, height) in enumerate(sizes_wh)
    ]


def test_images_of_another_size_than_the_cameras_are_left_out() -> None:
    camera = Camera(size_wh=(8, 6), fx=5.0, fy=5.0, cx=4.0, cy=3.0)
    rig = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH}), camera=camera)
    ordered = Ordered(Listed(pictures((8, 6), (4, 3), (8, 6), (6, 8)), rig=rig))
    seen = [(one.image_bgr is not None, one.depth_m is not None) for one in ordered]
    assert seen == [(True, True), (False, False), (True, True), (False, False)]
    assert list(ordered.faults) == [
        f"{name} was left out, it has {size} pixels, not 8x6: 1 time at stamp 0.000000 s"
        for size in ("4x3", "6x8")
        for name in ("image_bgr", "depth_m")
    ]


def test_images_of_any_size_pass_where_the_rig_has_no_camera() -> None:
    ordered = Ordered(Listed(pictures((8, 6), (4, 3))))
    assert all(one.image_bgr is not None and one.depth_m is not None for one in ordered)
    assert ordered.faults == []


def test_a_point_whose_time_is_no_number_has_that_of_its_observation() -> None:
    points, times_s = np.ones((3, 3), np.float32), np.array([0.0, np.nan, 0.1])
    bad = Observation(stamp_ns=0, points_lidar=points, point_times_s=times_s)
    points = points.copy()
    points[1] = np.nan  # of a point that is none, the time does not matter
    fine = Observation(stamp_ns=1, points_lidar=points, point_times_s=times_s)
    source = Ordered(Listed([bad, fine]))
    one, other = source
    np.testing.assert_array_equal(one.point_times_s, [0.0, 0.0, 0.1])
    assert len(one.points_lidar) == 3
    np.testing.assert_array_equal(other.point_times_s, [0.0, 0.1])
    assert "times of points that are not finite: 1 time at stamp 0.000000 s" in source.faults


def test_depth_that_is_no_number_is_missing_and_no_fault() -> None:
    depth_m = np.array([[np.nan, np.inf, -np.inf, 1.5]], np.float32)
    depth_m.flags.writeable = False
    ordered = Ordered(Listed([Observation(stamp_ns=1, depth_m=depth_m)]))
    (found,) = ordered
    np.testing.assert_array_equal(found.depth_m, np.array([[0, 0, 0, 1.5]], np.float32))
    assert found.depth_m.dtype == np.float32
    assert not found.depth_m.flags.writeable
    assert np.isnan(depth_m[0, 0])
    assert ordered.faults == []


def test_depth_without_one_number_is_told() -> None:
    blank = [
        Observation(stamp_ns=stamp_ns, depth_m=np.full((2, 3), np.nan, np.float32))
        for stamp_ns in (1, 2)
    ]
    zero = Observation(stamp_ns=3, depth_m=np.zeros((2, 3), np.float32))
    ordered = Ordered(Listed([*blank, zero]))
    assert all(not observation.depth_m.any() for observation in ordered)
    (fault,) = ordered.faults
    assert fault == "depth image without one finite value: 2 times, first at stamp 0.000000 s"


def test_gyro_samples_that_are_no_numbers_are_dropped_and_counted() -> None:
    gyro = np.arange(16, dtype=np.float64).reshape(4, 4)
    gyro[1, 2] = np.nan
    gyro[3, 1] = np.inf
    some = Observation(stamp_ns=1, gyro_base=gyro)
    none = Observation(stamp_ns=2, gyro_base=np.full((2, 4), np.nan))
    ordered = Ordered(Listed([some, none]))
    first, second = ordered
    np.testing.assert_array_equal(first.gyro_base, gyro[[0, 2]])
    assert not first.gyro_base.flags.writeable
    assert second.gyro_base is None
    (fault,) = ordered.faults
    assert fault == "gyro sample that is not finite: 4 times, first at stamp 0.000000 s"


def test_odometry_that_is_no_number_is_left_out() -> None:
    T_odom_base = np.eye(4)
    T_odom_base[0, 3] = np.nan
    ordered = Ordered(Listed([Observation(stamp_ns=1, T_odom_base=T_odom_base)]))
    (found,) = ordered
    assert found.T_odom_base is None
    assert len(ordered.faults) == 1


def test_sound_arrays_pass_as_they_are() -> None:
    sound = Observation(
        stamp_ns=1,
        depth_m=np.ones((2, 3), np.float32),
        points_lidar=np.ones((2, 3), np.float32),
        gyro_base=np.ones((2, 4)),
        T_odom_base=np.eye(4),
    )
    assert list(Ordered(Listed([sound]))) == [sound]


def test_the_sources_own_faults_come_first() -> None:
    assert Ordered(Listed([], faults=["broken"])).faults == ["broken"]


def test_a_gap_of_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match="max_gap_s"):
        Ordered(at(1), max_gap_s=0.0)


@given(st.lists(st.integers(0, 60), max_size=30))
def test_stamps_always_rise(places: list[int]) -> None:
    found = seconds(Ordered(at(*places)))
    assert all(before < after for before, after in pairwise(found))
