"""Samples of a ROS recording, from its beginning to its end."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np

from sceneslam.ros import decode
from sceneslam.ros.clouds import PointTimes, cloud
from sceneslam.ros.pixels import DepthUnits
from sceneslam.sources.bag.observation import Mounts, measured
from sceneslam.sources.bag.recording import Message, Recording
from sceneslam.sources.bag.stamps import StampReader
from sceneslam.sources.survey.survey import Stamps, Stream, Survey
from sceneslam.types.rig import Sensor

_STRETCHES, _STRETCH_NS = 5, 1_000_000_000
_SLOW_STRETCHES, _SLOW_STRETCH_NS = 1, 200_000_000  # bzip2 unpacks some megabytes per second
_MOST_MESSAGES = 400  # per time span
_MOST_SAMPLES = 2  # decoded depth images, scans and clouds per time span


def survey_recording(
    recording: Recording,
    topics: Mapping[Sensor, str],
    *,
    depth_scale: float,
    sync_tolerance_s: float,
    silent_after_s: float,
    mounts: Mounts,
    unplaced: Sequence[str] = (),
    silent: Sequence[str] = (),
    odd: Sequence[str] = (),
) -> Survey:
    """Return the streams of a recording, sampled in time spans of a second.

    The first and the last message of every topic are read, too.
    """
    used = sorted(set(topics.values()))
    firsts = [one for topic in used for one in islice(recording.messages({topic}), 1)]
    lasts = [one for topic in used if (one := recording.last(topic)) is not None]
    start_ns = min((one.log_ns for one in firsts), default=0)
    end_ns = max((one.log_ns for one in lasts), default=0)
    samples = _Samples(topics, DepthUnits.unlimited(depth_scale), mounts)
    stamps = StampReader(recording)
    for stretch in (firsts, *_stretches(recording, used, start_ns, end_ns), lasts):
        samples.begin()
        for message in stretch:
            value = recording.decode(message)
            stamp_ns = None if value is None else stamps.stamp_ns(message, value)
            if stamp_ns is None:
                continue
            for sensor in (one for one, topic in topics.items() if topic == message.topic):
                samples.take(sensor, stamp_ns, value, delay_ns=message.log_ns - stamp_ns)
    streams = [
        Stream(
            sensor=sensor,
            place=topic,
            count=recording.topics[topic].count,
            stamps_ns=np.unique(np.concatenate(samples.stamps_ns(sensor))),
            sampled_ns=samples.stamps_ns(sensor),
            delay_s=samples.delay_s(sensor),
        )
        for sensor, topic in topics.items()
    ]
    return Survey(
        streams=streams,
        sync_tolerance_s=sync_tolerance_s,
        silent_after_s=silent_after_s,
        depth_scale=depth_scale if samples.is_scaled else None,
        depths_m=samples.depths_m,
        scans=samples.scans,
        clouds=samples.clouds,
        odometry_ns=np.array(samples.odometry_ns, np.int64),
        T_odom_base=samples.T_odom_base,
        gyro_radps=samples.gyro_radps,
        forces_mps2=samples.forces_mps2,
        unplaced=unplaced,
        silent=silent,
        odd=[
            *odd,
            *(
                f"{topics[Sensor.POINTS]}: the times of points are {one.value}"
                for one in PointTimes
                if one is not PointTimes.GOOD and one in samples.point_times
            ),
        ],
    )


def _stretches(
    recording: Recording, topics: Collection[str], start_ns: int, end_ns: int
) -> Iterator[Iterator[Message]]:
    """Yield the messages of disjoint time spans, evenly distributed; a short recording as a whole.

    `start_ns` and `end_ns` are the recording times of the topics' first and last message.
    """
    count, length_ns = _STRETCHES, _STRETCH_NS
    if recording.is_slow:
        count, length_ns = _SLOW_STRETCHES, _SLOW_STRETCH_NS
    step_ns = max(length_ns, (end_ns - start_ns - length_ns) // max(count - 1, 1))
    for number in range(count):
        from_ns = start_ns + number * step_ns
        yield _stretch(recording, topics, from_ns, from_ns + length_ns)


def _stretch(
    recording: Recording, topics: Collection[str], from_ns: int, to_ns: int
) -> Iterator[Message]:
    messages = recording.messages(topics, from_ns)
    for _, message in zip(range(_MOST_MESSAGES), messages, strict=False):
        if message.log_ns >= to_ns:
            return
        yield message


class _Samples:
    """The contents of the sampled messages."""

    def __init__(self, sensors: Collection[Sensor], units: DepthUnits, mounts: Mounts) -> None:
        self._units, self._mounts = units, mounts
        self._stamps_ns: dict[Sensor, list[list[int]]] = {sensor: [] for sensor in sensors}
        self._delays_ns: dict[Sensor, list[int]] = {sensor: [] for sensor in sensors}
        self._counts: dict[Sensor, int] = {}
        self.is_scaled = False  # depth is stored as integers
        self.depths_m: list[Any] = []
        self.scans: list[Any] = []
        self.clouds: list[Any] = []
        self.point_times: set[PointTimes] = set()
        self.odometry_ns: list[int] = []
        self.T_odom_base: list[Any] = []
        self.gyro_radps: list[Any] = []
        self.forces_mps2: list[Any] = []

    def begin(self) -> None:
        """Begin a time span."""
        self._counts = {}
        for spans in self._stamps_ns.values():
            spans.append([])

    def take(self, sensor: Sensor, stamp_ns: int, value: Any, *, delay_ns: int) -> None:
        """Add a valid message's stamp, and its contents if it is one of its time span's first."""
        held = measured(value, sensor, self._mounts)
        if held is None:
            return
        self._stamps_ns[sensor][-1].append(stamp_ns)
        self._delays_ns[sensor].append(delay_ns)
        if sensor is Sensor.ODOMETRY:
            self.odometry_ns.append(stamp_ns)
            self.T_odom_base.append(held)
        elif sensor is Sensor.GYRO:
            self.gyro_radps.append(held)
        elif sensor is Sensor.ACCELEROMETER:
            self.forces_mps2.append(held)
        elif self._counts.get(sensor, 0) < _MOST_SAMPLES:
            self._counts[sensor] = self._counts.get(sensor, 0) + 1
            self._decode(sensor, stamp_ns, value)

    def stamps_ns(self, sensor: Sensor) -> Sequence[Stamps]:
        """Return the stamps (N,), rising, of each time span."""
        return [np.array(sorted(span), np.int64) for span in self._stamps_ns[sensor]]

    def delay_s(self, sensor: Sensor) -> float | None:
        """Return the median time [s] from stamp to recording, None without a message."""
        delays_ns = self._delays_ns[sensor]
        return float(np.median(delays_ns)) * 1e-9 if delays_ns else None

    def _decode(self, sensor: Sensor, stamp_ns: int, value: Any) -> None:
        if sensor is Sensor.DEPTH:
            depth_m = decode.depth_m(value, self._units)
            self.depths_m += [] if depth_m is None else [depth_m]
            self.is_scaled |= not decode.is_metric_depth(value)
        elif sensor is Sensor.SCAN:
            scan = decode.scan(value, stamp_ns)
            self.scans += [] if scan is None else [scan]
        elif sensor is Sensor.POINTS:
            found = cloud(value, stamp_ns)
            self.clouds += [] if found is None else [found.points_lidar]
            self.point_times |= set() if found is None else {found.times}
