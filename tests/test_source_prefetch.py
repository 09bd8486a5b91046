"""Decoding ahead, and bringing streams together."""

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from sceneslam.sources.bag.synchronise import Sample, SynchronisedSamples, Synchroniser
from sceneslam.sources.faults import FaultLog
from sceneslam.sources.prefetch import prefetched
from sceneslam.types import se3
from sceneslam.types.rig import Sensor

MS = 1_000_000


def jobs(count: int, drawn: list[int] | None = None) -> Iterator[Callable[[], int]]:
    for number in range(count):
        if drawn is not None:
            drawn.append(number)
        yield lambda number=number: number


def decode_threads() -> int:
    return sum(thread.name.startswith("decode") for thread in threading.enumerate())


def test_results_come_in_order() -> None:
    assert list(prefetched(jobs(100), workers=4, ahead=7)) == list(range(100))


def test_no_more_than_ahead_is_drawn() -> None:
    drawn: list[int] = []
    results = prefetched(jobs(100, drawn), ahead=3)
    assert next(results) == 0
    assert len(drawn) == 4
    results.close()
    assert decode_threads() == 0


def test_an_exception_comes_where_its_result_would() -> None:
    def fail() -> int:
        raise ValueError("broken")

    results = prefetched([lambda: 1, fail, lambda: 3])
    assert next(results) == 1
    with pytest.raises(ValueError, match="broken"):
        next(results)
    assert decode_threads() == 0


def bundles(
    primary: Sensor, samples: list[tuple[Sensor, int, object]], tolerance_s: float = 0.02
) -> list[SynchronisedSamples]:
    streams = frozenset(sensor for sensor, _, _ in samples)
    synchroniser = Synchroniser(primary, streams, tolerance_s)
    found: list[SynchronisedSamples] = []
    for sensor, stamp_ms, value in samples:
        found += synchroniser.add(
            sensor, Sample(stamp_ns=stamp_ms * MS, arrived_ns=stamp_ms * MS, value=value)
        )
    return [*found, *synchroniser.flush()]


def test_depth_goes_to_the_nearest_image_once() -> None:
    found = bundles(
        Sensor.IMAGE,
        [
            (Sensor.IMAGE, 100, "a"),
            (Sensor.DEPTH, 95, 1),
            (Sensor.DEPTH, 101, 2),
            (Sensor.IMAGE, 110, "b"),
            (Sensor.IMAGE, 112, "c"),
        ],
    )
    assert [one.depth and one.depth.value for one in found] == [2, 1, None]


def test_depth_may_be_recorded_after_its_image() -> None:
    found = bundles(
        Sensor.IMAGE,
        [
            (Sensor.IMAGE, 100, "a"),
            (Sensor.IMAGE, 133, "b"),
            (Sensor.DEPTH, 100, 1),
            (Sensor.DEPTH, 133, 2),
        ],
    )
    assert [one.depth.value for one in found] == [1, 2]


def test_the_last_scan_since_the_image_before_is_taken() -> None:
    scans = [(Sensor.SCAN, stamp, stamp) for stamp in (10, 90, 120, 150, 210)]
    images = [(Sensor.IMAGE, stamp, "") for stamp in (100, 160, 170)]
    found = bundles(Sensor.IMAGE, sorted(scans + images, key=lambda one: one[1]))
    assert [one.scan and one.scan.value for one in found] == [90, 150, None]


def test_all_gyro_samples_since_the_image_before_are_taken() -> None:
    gyro = [(Sensor.GYRO, stamp, stamp) for stamp in range(5, 300, 10)]
    images = [(Sensor.IMAGE, stamp, "") for stamp in (100, 200)]
    found = bundles(Sensor.IMAGE, sorted(gyro + images, key=lambda one: one[1]))
    assert [sample.value for sample in found[1].samples[Sensor.GYRO]] == list(range(105, 200, 10))


def test_odometry_is_interpolated_and_not_across_a_gap() -> None:
    poses = [(Sensor.ODOMETRY, t, se3.from_xy_yaw(t * 0.01, 0, 0)) for t in (0, 100, 200, 5000)]
    images = [(Sensor.IMAGE, stamp, "") for stamp in (100, 150, 2500)]
    found = bundles(Sensor.IMAGE, sorted(poses + images, key=lambda one: one[1]))
    xs = [None if one.T_odom_base is None else one.T_odom_base[0, 3] for one in found]
    assert xs[2] is None
    np.testing.assert_allclose(xs[:2], [1.0, 1.5])


def test_a_stream_that_stopped_holds_nothing_up_for_long() -> None:
    streams = frozenset({Sensor.IMAGE, Sensor.ODOMETRY})
    synchroniser = Synchroniser(Sensor.IMAGE, streams, 0.02)
    times_ns = [index * 100 * MS for index in range(30)]
    images = [Sample(stamp_ns=at_ns, arrived_ns=at_ns, value="") for at_ns in times_ns]
    given = [len(list(synchroniser.add(Sensor.IMAGE, image))) for image in images]
    assert sum(given) >= 18


@pytest.mark.parametrize("ahead_s", [0, 37, -37])
def test_clock_of_one_sensor_does_not_take_the_others_apart(ahead_s: int) -> None:
    streams = frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.SCAN})
    synchroniser = Synchroniser(Sensor.IMAGE, streams, 0.02)
    found: list[SynchronisedSamples] = []
    for begin_ms in range(0, 10_000, 100):
        for sensor, after_ms in ((Sensor.IMAGE, 0), (Sensor.SCAN, 3), (Sensor.DEPTH, 6)):
            shift_ns = ahead_s * 1000 * MS if sensor is Sensor.SCAN else 0
            stamp_ns, arrived_ns = begin_ms * MS + shift_ns, (begin_ms + after_ms) * MS
            sample = Sample(stamp_ns=stamp_ns, arrived_ns=arrived_ns, value=begin_ms)
            found += synchroniser.add(sensor, sample)
    found += synchroniser.flush()
    assert len(found) == 100
    assert all(one.depth and one.depth.value == one.primary.value for one in found)


@pytest.mark.parametrize(("bad", "off_s"), [(0, 1000), (20, 1000), (20, -30), (20, -1000)])
@pytest.mark.parametrize("sensor", [Sensor.IMAGE, Sensor.DEPTH, Sensor.ODOMETRY, Sensor.GYRO])
def test_one_wrong_stamp_costs_one_sample_and_is_counted(
    sensor: Sensor, bad: int, off_s: int
) -> None:
    streams = (Sensor.IMAGE, Sensor.DEPTH, Sensor.ODOMETRY, Sensor.GYRO)
    faults = FaultLog()
    synchroniser = Synchroniser(Sensor.IMAGE, frozenset(streams), 0.02, faults=faults)
    found: list[SynchronisedSamples] = []
    for number in range(100):
        for each in streams:
            at_ns = number * 33 * MS
            off_ns = off_s * 10**9 if (each, number) == (sensor, bad) else 0
            value = se3.identity() if each is Sensor.ODOMETRY else number
            sample = Sample(stamp_ns=at_ns + off_ns, arrived_ns=at_ns, value=value)
            found += synchroniser.add(each, sample)
    found += synchroniser.flush()
    assert len(found) >= 99
    assert sum(one.depth is None for one in found) <= 1
    assert sum(one.T_odom_base is None for one in found) <= 2
    assert sum(len(one.samples[Sensor.GYRO]) for one in found) >= 98
    (fault,) = faults.sentences()
    where = "ahead of the next one" if off_s > 0 else "behind the one before"
    assert f"{sensor.value} left out, its stamp is {where}: 1 time" in fault


def live_sets(
    late_ms: Callable[[int], int | None], count: int = 90
) -> list[tuple[int, SynchronisedSamples]]:
    """Return sets of images of 30 Hz with an IMU, and the delay [ms] at which each is given.

    Depth of image i comes `late_ms(i)` after it, or not at all.
    """
    arrivals = [(at_ms, Sensor.GYRO, at_ms) for at_ms in range(0, count * 40, 5)]
    for index in range(count):
        arrivals.append((index * 33, Sensor.IMAGE, index * 33))
        late = late_ms(index)
        if late is not None:
            arrivals.append((index * 33 + late, Sensor.DEPTH, index * 33))
    streams = frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.GYRO})
    synchroniser = Synchroniser(Sensor.IMAGE, streams, 0.02, patience_s=0.05)
    found: list[tuple[int, SynchronisedSamples]] = []
    for at_ms, sensor, stamp_ms in sorted(arrivals, key=lambda one: one[0]):
        sample = Sample(stamp_ns=stamp_ms * MS, arrived_ns=at_ms * MS, value=stamp_ms)
        found += [(at_ms - one.primary.value, one) for one in synchroniser.add(sensor, sample)]
    return found


@pytest.mark.parametrize("late_ms", [(0, 4), (70, 70), (100, 100), (55, 80)])
def test_live_depth_that_comes_late_is_waited_for_and_no_longer(late_ms: tuple[int, int]) -> None:
    found = live_sets(lambda index: late_ms[index % 2])[5:]
    assert len(found) > 75
    assert all(one.depth and one.depth.value == one.primary.value for _, one in found)
    assert max(delay for delay, _ in found) <= late_ms[1] + 5


@pytest.mark.parametrize(
    ("late_ms", "longest_ms"),
    [
        (lambda index: 4 if index < 30 else None, 60),  # it stops
        (lambda index: 80 if index < 30 else None, 135),
        (lambda index: 4 if index % 10 == 0 else None, 60),  # it is slow
        (lambda index: 700, 60),  # hopeless
    ],
)
def test_live_depth_that_is_missing_is_waited_for_as_long_as_it_would_take(
    late_ms: Callable[[int], int | None], longest_ms: int
) -> None:
    assert max(delay for delay, _ in live_sets(late_ms)) <= longest_ms
