"""Contract checks of sources; each takes a function that makes a new source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.testing.promise import expect
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor

Make = Callable[[], Source]
OBSERVATIONS = 50  # number of checked observations


def check_source(make: Make) -> None:
    """Raise ContractError if a source violates the contract of `Source`.

    Its first 50 observations are read twice.
    """
    for check in SOURCE_CHECKS:
        check(make)


def fulfils_the_protocol(make: Make) -> None:
    """Check that the source has all members, and the poses of its range sensors."""
    source = make()
    expect(isinstance(source, Source), "all members of Source")
    rig = source.rig
    parts = {
        Sensor.DEPTH: rig.camera,
        Sensor.SCAN: rig.laser,
        Sensor.POINTS: rig.lidar,
    }
    for sensor, part in parts.items():
        expect(sensor not in rig.sensors or part, f"a part of the rig for {sensor.value}")


def counts_its_observations(make: Make) -> None:
    """Check that the length is None, or not less than the number of observations."""
    source = make()
    length, seen = source.length, len(_first(source))
    expect(length is None or length >= seen, f"length None or >= {seen}", length)
    expect(seen > 0, "an observation")


def yields_by_rising_stamp(make: Make) -> None:
    """Check that stamps are whole nanoseconds, and rise."""
    stamps_ns = [observation.stamp_ns for observation in _first(make())]
    expect(all(isinstance(one, int) for one in stamps_ns), "stamp_ns: int", stamps_ns[:1])
    expect((np.diff(stamps_ns) > 0).all(), "rising stamps", stamps_ns)


def begins_anew_each_time(make: Make) -> None:
    """Check that every iteration yields the same observations."""
    source = make()
    one, two = _first(source), _first(source)
    stamps = [[observation.stamp_ns for observation in each] for each in (one, two)]
    expect(stamps[0] == stamps[1], "the same stamps again", stamps[1][:3])
    for first, second in zip(one, two, strict=True):
        images = [each.image_bgr for each in (first, second) if each.image_bgr is not None]
        is_same = len(images) != 1 and all(np.array_equal(images[0], one) for one in images)
        expect(is_same, f"the same image at {first.stamp_ns}")


def measures_what_its_rig_has(make: Make) -> None:
    """Check that an observation holds only sensors of the rig, in the right shapes."""
    source = make()
    rig = source.rig
    for observation in _first(source):
        for sensor in Sensor:
            is_named = sensor in rig.sensors or not observation.has(sensor)
            expect(is_named, f"rig.sensors with {sensor.value}, which was measured")
        _check_arrays(observation, rig)


SOURCE_CHECKS: Sequence[Callable[[Make], None]] = (
    fulfils_the_protocol,
    counts_its_observations,
    yields_by_rising_stamp,
    begins_anew_each_time,
    measures_what_its_rig_has,
)


def _first(source: Source) -> list[Observation]:
    return list(islice(iter(source), OBSERVATIONS))


def _check_arrays(observation: Observation, rig: Rig) -> None:
    height, width = 0, 0
    if rig.camera is not None:
        width, height = rig.camera.size_wh
    elif observation.image_bgr is not None:  # a video with unknown camera
        height, width = observation.image_bgr.shape[:2]
    expected = (
        ("image_bgr", (height, width, 3), np.uint8),
        ("depth_m", (height, width), np.float32),
        ("T_odom_base", (4, 4), np.float64),
    )
    for name, shape, dtype in expected:
        array = getattr(observation, name)
        if array is not None:
            is_right = array.shape == shape and array.dtype == dtype
            found = f"{array.shape} {array.dtype}"
            expect(is_right, f"{name}: {shape} {np.dtype(dtype)}", found)
    points = observation.points_lidar
    if points is not None:
        is_cloud = points.ndim == 2 and points.shape[1] == 3 and points.dtype == np.float32
        expect(is_cloud, "points_lidar: (N, 3) float32", f"{points.shape} {points.dtype}")
