"""ROS recordings: ROS 1 bags, rosbag2 folders and bare MCAP files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

from sceneslam.ros.pixels import DepthUnits
from sceneslam.sources.bag.frames import FrameTree
from sceneslam.sources.bag.observation import PRIMARY, BundleDecoder, Decoded, measured
from sceneslam.sources.bag.open_recording import open_recording
from sceneslam.sources.bag.pace import StreamPace
from sceneslam.sources.bag.recording import Message
from sceneslam.sources.bag.rig import (
    Given,
    find_mounts,
    make_rig,
    picture_size_wh,
    recalibrated,
    sensor_topics,
    unplaced,
    unregistered,
    upward,
)
from sceneslam.sources.bag.stamps import StampReader
from sceneslam.sources.bag.synchronise import Sample, SynchronisedSamples, Synchroniser
from sceneslam.sources.bag.topics import choose_topics, describe
from sceneslam.sources.bag.truth import BASE, CAMERA, read_truth, unplaced_body
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.sources.intrinsics import checked_above_zero, given_intrinsics, given_range_m
from sceneslam.sources.prefetch import prefetched
from sceneslam.sources.spanned import TimeSpan
from sceneslam.sources.survey.bag_sample import survey_recording
from sceneslam.sources.survey.preflight import CLOCKS_APART_S
from sceneslam.sources.survey.survey import Survey
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor, Wheels
from sceneslam.types.truth import GroundTruth


class RosBag:
    """Gives one observation per message of the first of image, depth, points, scan, odometry.

    While that has no message for longer than `silent_after_s`, the next one replaces it.
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
        silent_after_s: float,
        base_frame: str | None,
        ground_truth_frame: str | None,
        wheels: Mapping[str, float] | None,
    ) -> None:
        checked_above_zero("depth_scale", depth_scale)
        checked_above_zero("sync_tolerance_s", sync_tolerance_s)
        checked_above_zero("silent_after_s", silent_after_s)
        if ground_truth_frame not in (None, CAMERA, BASE):
            raise ConfigError("ground_truth_frame", ground_truth_frame, "null, camera or base")
        given = Given(
            intrinsics=given_intrinsics(camera),
            depth_range_m=given_range_m("depth_range_m", depth_range_m),
            lidar_range_m=given_range_m("lidar_range_m", lidar_range_m),
            wheels=Wheels.given(wheels),
        )
        self._is_lens_given = given.intrinsics is not None
        self._path = given_path(path)
        self._depth_scale = depth_scale
        self._sync_tolerance_s = sync_tolerance_s
        self._silent_after_s = silent_after_s
        self._truth_frame = ground_truth_frame
        self._faults = FaultLog()
        self._recording = open_recording(self._path)
        self._stamps = StampReader(self._recording)
        try:
            self._topics = choose_topics(self._recording, topics)
            self._by_sensor = sensor_topics(self._recording, self._topics)
            if Sensor.ODOMETRY not in self._by_sensor:  # as it holds no poses
                self._topics = replace(self._topics, odometry=None)
            self._primary = self._choose_primary()
            self._frames = FrameTree(self._recording, base_frame, self._by_sensor.values())
            self._rig = make_rig(
                self._recording,
                self._topics,
                sensors=self._by_sensor,
                frames=self._frames,
                given=given,
            )
            self._mounts = find_mounts(self._recording, self._topics, self._frames)
        except InputError as err:
            raise InputError(f"{err}: {path}") from err

    @property
    def rig(self) -> Rig:
        """Return the sensors whose topics were found."""
        return self._rig

    @property
    def length(self) -> int | None:
        """Return the number of messages of the primary topic.

        None if another topic sets the pace at the beginning or the end. In a gap of this one,
        others give observations that are not counted.
        """
        if any(sensor is not self._primary for sensor in self._paces()):
            return None
        return self._recording.topics[self._by_sensor[self._primary]].count

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults of the file and of single messages."""
        return [f"{fault}: {self._path}" for fault in self._recording.faults] + [
            f"{fault}: {self._path}" for fault in self._faults.sentences()
        ]

    @property
    def span(self) -> TimeSpan | None:
        """Return the first and last stamp of what sets the pace there, None if one is missing."""
        if not self._firsts or not self._lasts:
            return None
        begin, end = self._paces()
        return TimeSpan(start_ns=self._firsts[begin].stamp_ns, end_ns=self._lasts[end].stamp_ns)

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
            silent_after_s=self._silent_after_s,
            mounts=self._mounts,
            unplaced=self._unplaced(),
            odd=list(self._assumed()),
        )

    def ground_truth(self) -> GroundTruth | None:
        """Return the poses and scenes of the ground truth topics, None without."""
        return read_truth(self._recording, self._topics, self._frames, self._rig, self._truth_frame)

    def _unplaced(self) -> list[str]:
        """Return the frames of sensors without a pose; without transforms, one may be the base."""
        found = unplaced(self._recording, self._topics, self._frames)
        return [] if self._frames.is_empty and len(found) == 1 else found

    def _assumed(self) -> Iterator[str]:
        """Yield sentences on what is assumed of transforms, depth, camera and ground truth."""
        yield from self._frames.moved()
        if not self._is_lens_given:
            yield from recalibrated(self._recording, self._topics)
        yield from unregistered(self._recording, self._topics, self._frames)
        yield from upward(self._recording, self._topics, self._frames)
        if self._truth_frame is None:
            yield from unplaced_body(self._recording, self._topics, self._frames)

    def _jobs(self) -> Iterator[Callable[[], Decoded]]:
        """Yield one decoding job per observation."""
        depth_range_m = self._rig.camera.depth_range_m if self._rig.camera else (0.0, 100.0)
        units = DepthUnits(self._depth_scale, depth_range_m)
        is_seeing = bool(self._topics.image or self._topics.depth)
        size_wh = picture_size_wh(self._recording, self._topics) if is_seeing else None
        decoders = {
            sensor: BundleDecoder(sensor, self._rig.sensors, size_wh, units) for sensor in PRIMARY
        }
        for bundle, primary in self._bundles():
            yield partial(decoders[primary].observe, bundle)

    def _bundles(self) -> Iterator[tuple[SynchronisedSamples, Sensor]]:
        """Yield synchronised samples, each with its primary sensor."""
        topics, primary = frozenset(self._by_sensor.values()), self._primary
        synchroniser = Synchroniser(
            primary, frozenset(self._by_sensor), self._sync_tolerance_s, faults=self._faults
        )
        begin_ns = min((one.arrived_ns for one in self._firsts.values()), default=0)
        paced = {one: self._by_sensor[one] for one in (self._primary, *self._firsts)}
        pace = StreamPace(paced, self._silent_after_s, begin_ns)
        for message in self._recording.messages(topics):
            samples = list(self._samples(message))
            pace.look(message.log_ns)
            if samples:
                pace.hear(message.topic, message.log_ns)
            if samples and pace.sensor is not primary:
                handed = synchroniser.hand_over(pace.sensor, samples[0][1].stamp_ns)
                yield from ((one, primary) for one in handed)
                primary = pace.sensor
            for sensor, sample in samples:
                yield from ((one, primary) for one in synchroniser.add(sensor, sample))
        yield from ((one, primary) for one in synchroniser.flush())

    @cached_property
    def _firsts(self) -> Mapping[Sensor, Sample]:
        """Return the first stamped message of each sensor that can set the pace, by rank.

        It can if its clock agrees with that of the primary sensor: observations have rising stamps.
        """
        found: dict[Sensor, Sample] = {}
        for sensor in (one for one in PRIMARY if one in self._by_sensor):
            stamped = map(self._stamped, self._recording.messages({self._by_sensor[sensor]}))
            if (one := next(filter(None, stamped), None)) is not None:
                found[sensor] = one
        delays_ns = {sensor: one.arrived_ns - one.stamp_ns for sensor, one in found.items()}
        own_ns, apart_ns = delays_ns.get(self._primary), CLOCKS_APART_S * 1e9
        return {
            sensor: one
            for sensor, one in found.items()
            if own_ns is None or abs(delays_ns[sensor] - own_ns) <= apart_ns
        }

    @cached_property
    def _lasts(self) -> Mapping[Sensor, Sample]:
        """Return the last message of each of the same sensors, if it has a stamp."""
        lasts = {one: self._recording.last(self._by_sensor[one]) for one in self._firsts}
        found = {sensor: self._stamped(one) for sensor, one in lasts.items() if one is not None}
        return {sensor: one for sensor, one in found.items() if one is not None}

    def _paces(self) -> Iterator[Sensor]:
        """Yield the sensors that set the pace at the beginning and at the end, if there are any."""
        begin_ns = min((one.arrived_ns for one in self._firsts.values()), default=0)
        end_ns = max((one.arrived_ns for one in self._lasts.values()), default=0)
        for ends, at_ns in ((self._firsts, begin_ns), (self._lasts, end_ns)):
            near_ns = self._silent_after_s * 1e9
            near = (sensor for sensor in ends if abs(ends[sensor].arrived_ns - at_ns) <= near_ns)
            yield from islice(near, 1)

    def _samples(self, message: Message) -> Iterator[tuple[Sensor, Sample]]:
        """Yield a message's samples; for an invalid message, none, and count a fault."""
        value = self._recording.decode(message)
        if value is None:
            self._faults.add(
                f"a message of {message.topic} makes no sense", at_stamp(message.log_ns)
            )
            return
        stamp_ns = self._stamps.stamp_ns(message, value)
        if stamp_ns is None:
            self._faults.add(f"a message of {message.topic} has no stamp", at_stamp(message.log_ns))
            return
        for sensor in (one for one, topic in self._by_sensor.items() if topic == message.topic):
            held = measured(value, sensor, self._mounts)
            if held is not None:
                yield sensor, Sample(stamp_ns=stamp_ns, arrived_ns=message.log_ns, value=held)
            elif sensor is Sensor.ODOMETRY:
                fault = f"a pose of {message.topic} is not a rigid transform"
                self._faults.add(fault, at_stamp(stamp_ns))

    def _stamped(self, message: Message) -> Sample | None:
        """Return a decoded message, None without a stamp; an invalid one has its recording time."""
        value, log_ns = self._recording.decode(message), message.log_ns
        stamp_ns = log_ns if value is None else self._stamps.stamp_ns(message, value)
        if stamp_ns is None:
            return None
        return Sample(stamp_ns=stamp_ns, arrived_ns=log_ns, value=value)

    def _choose_primary(self) -> Sensor:
        for sensor in PRIMARY:
            if sensor in self._by_sensor:
                return sensor
        there = describe(self._recording) or "no readable messages at all"
        there = "; ".join([there, *self._recording.faults])
        raise InputError(
            f"no image, depth, points, scan or odometry topic in the recording: {there}"
        )
