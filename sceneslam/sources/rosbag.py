"""ROS recordings: ROS 1 bags, rosbag2 folders and bare MCAP files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from sceneslam.ros import decode
from sceneslam.ros.pixels import DepthUnits
from sceneslam.sources.bag.frames import FrameTree
from sceneslam.sources.bag.observation import PRIMARY, BundleDecoder, Decoded, measured
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.sources.bag.recording import Message
from sceneslam.sources.bag.rig import (
    Given,
    find_mounts,
    make_rig,
    picture_size_wh,
    sensor_topics,
    unplaced,
    unregistered,
)
from sceneslam.sources.bag.synchronise import Sample, SynchronisedSamples, Synchroniser
from sceneslam.sources.bag.topics import choose_topics, describe
from sceneslam.sources.bag.truth import BASE, CAMERA, read_truth
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.sources.intrinsics import checked_above_zero, given_intrinsics, given_range_m
from sceneslam.sources.prefetch import prefetched
from sceneslam.sources.spanned import TimeSpan
from sceneslam.sources.survey.bag_sample import survey_recording
from sceneslam.sources.survey.survey import Survey
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor, Wheels
from sceneslam.types.truth import GroundTruth


class RosBag:
    """Gives one observation per message of the first of image, depth, points, scan, odometry.

    `topics` names the topic per sensor (null: found by type and encoding; `none`: not used).
    """

    def __init__(
        self,
        path: str,
        topics: dict[str, Any],
        camera: dict[str, Any],
        depth_scale: float,
        depth_range_m: list[float] | None,
        lidar_range_m: list[float] | None,
        sync_tolerance_s: float,
        base_frame: str | None,
        ground_truth_frame: str | None,
        wheels: Mapping[str, float] | None,
    ) -> None:
        checked_above_zero("depth_scale", depth_scale)
        checked_above_zero("sync_tolerance_s", sync_tolerance_s)
        if ground_truth_frame not in (None, CAMERA, BASE):
            raise ConfigError("ground_truth_frame", ground_truth_frame, "null, camera or base")
        given = Given(
            intrinsics=given_intrinsics(camera),
            depth_range_m=given_range_m("depth_range_m", depth_range_m),
            lidar_range_m=given_range_m("lidar_range_m", lidar_range_m),
            wheels=Wheels.given(wheels),
        )
        self._path = given_path(path)
        self._depth_scale = depth_scale
        self._sync_tolerance_s = sync_tolerance_s
        self._truth_frame = ground_truth_frame
        self._faults = FaultLog()
        self._recording = open_recording(self._path)
        try:
            self._topics = choose_topics(self._recording, topics)
            self._by_sensor = sensor_topics(self._recording, self._topics)
            self._primary = self._choose_primary()
            self._frames = FrameTree(self._recording, base_frame, self._by_sensor.values())
            self._rig = make_rig(self._recording, self._topics, self._frames, given)
            self._mounts = find_mounts(self._recording, self._topics, self._frames)
        except InputError as err:
            raise InputError(f"{err}: {path}") from err

    @property
    def rig(self) -> Rig:
        """Return the sensors whose topics were found."""
        return self._rig

    @property
    def length(self) -> int | None:
        """Return the number of messages of the primary topic."""
        return self._recording.topics[self._by_sensor[self._primary]].count

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults of the file and of single messages."""
        return [f"{fault}: {self._path}" for fault in self._recording.faults] + [
            f"{fault}: {self._path}" for fault in self._faults.sentences()
        ]

    @property
    def span(self) -> TimeSpan | None:
        """Return the first and last stamp of the primary topic."""
        topic = self._by_sensor[self._primary]
        first = next(self._recording.messages({topic}), None)
        last = self._recording.last(topic)
        if first is None or last is None:
            return None
        return TimeSpan(start_ns=self._stamp_ns(first), end_ns=self._stamp_ns(last))

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations; decodes pixels ahead in threads."""
        self._faults.clear()
        try:
            for decoded in prefetched(self._jobs()):
                for problem in decoded.problems:
                    self._faults.add(problem, at_stamp(decoded.stamp_ns))
                if decoded.observation is not None:
                    yield decoded.observation
        except InputError as err:
            raise InputError(f"{err}: {self._path}") from err

    def survey(self) -> Survey:
        """Return the topics, and samples of some time spans."""
        return survey_recording(
            self._recording,
            {sensor: self._by_sensor[sensor] for sensor in Sensor if sensor in self._by_sensor},
            depth_scale=self._depth_scale,
            sync_tolerance_s=self._sync_tolerance_s,
            mounts=self._mounts,
            unplaced=self._unplaced(),
            odd=list(unregistered(self._recording, self._topics, self._frames)),
        )

    def ground_truth(self) -> GroundTruth | None:
        """Return the poses and scenes of the ground truth topics, None without."""
        return read_truth(self._recording, self._topics, self._frames, self._rig, self._truth_frame)

    def _unplaced(self) -> list[str]:
        """Return the frames of sensors without a pose; without transforms, one may be the base."""
        found = unplaced(self._recording, self._topics, self._frames)
        return [] if self._frames.is_empty and len(found) == 1 else found

    def _jobs(self) -> Iterator[Callable[[], Decoded]]:
        """Yield one decoding job per observation."""
        depth_range_m = self._rig.camera.depth_range_m if self._rig.camera else (0.0, 100.0)
        units = DepthUnits(self._depth_scale, depth_range_m)
        is_seeing = bool(self._topics.image or self._topics.depth)
        size_wh = picture_size_wh(self._recording, self._topics) if is_seeing else None
        decoder = BundleDecoder(self._primary, self._rig.sensors, size_wh, units)
        for bundle in self._bundles():
            yield partial(decoder.observe, bundle)

    def _bundles(self) -> Iterator[SynchronisedSamples]:
        topics = frozenset(self._by_sensor.values())
        synchroniser = Synchroniser(
            self._primary, frozenset(self._by_sensor), self._sync_tolerance_s
        )
        for message in self._recording.messages(topics):
            for sensor, sample in self._samples(message):
                yield from synchroniser.add(sensor, sample)
        yield from synchroniser.flush()

    def _samples(self, message: Message) -> Iterator[tuple[Sensor, Sample]]:
        """Yield a message's samples; for an invalid message, none, and count a fault."""
        value = self._recording.decode(message)
        if value is None:
            self._faults.add(
                f"a message of {message.topic} makes no sense", at_stamp(message.log_ns)
            )
            return
        stamp_ns = decode.stamp_ns(value) or message.log_ns
        for sensor in (one for one, topic in self._by_sensor.items() if topic == message.topic):
            held = measured(value, sensor, self._mounts)
            if held is not None:
                yield sensor, Sample(stamp_ns=stamp_ns, arrived_ns=message.log_ns, value=held)
            elif sensor is Sensor.ODOMETRY:
                fault = f"a pose of {message.topic} is not a rigid transform"
                self._faults.add(fault, at_stamp(stamp_ns))

    def _stamp_ns(self, message: Message) -> int:
        decoded = self._recording.decode(message)
        return message.log_ns if decoded is None else decode.stamp_ns(decoded) or message.log_ns

    def _choose_primary(self) -> Sensor:
        for sensor in PRIMARY:
            if sensor in self._by_sensor:
                return sensor
        there = describe(self._recording) or "no readable messages at all"
        there = "; ".join([there, *self._recording.faults])
        raise InputError(
            f"no image, depth, points, scan or odometry topic in the recording: {there}"
        )
