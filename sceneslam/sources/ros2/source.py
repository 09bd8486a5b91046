"""A robot that runs ROS 2, live: over DDS without ROS, or through rclpy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from time import monotonic_ns
from typing import Any

from sceneslam.ros import decode, names
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.ros.pixels import DepthUnits
from sceneslam.ros.transport.transport import Arrival, Network, Qos, Transport, open_transport
from sceneslam.sources.bag.frames import FrameTree, is_beside, is_static
from sceneslam.sources.bag.observation import PRIMARY, BundleDecoder, measured
from sceneslam.sources.bag.rig import (
    Given,
    find_mounts,
    make_rig,
    picture_size_wh,
    sensor_topics,
    unplaced,
    unregistered,
    upward,
)
from sceneslam.sources.bag.synchronise import Sample, SynchronisedSamples, Synchroniser
from sceneslam.sources.bag.topics import NONE, TYPES, choose_topics
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.sources.intrinsics import checked_above_zero, given_intrinsics, given_range_m
from sceneslam.sources.live.clock import StampOrder
from sceneslam.sources.live.inbox import Inbox
from sceneslam.sources.live.measuring import Measuring
from sceneslam.sources.live.streams import Streams
from sceneslam.sources.ros2.expected import (
    USUAL,
    lacks_calibration,
    lacks_transforms,
    oddities,
    odometry_oddities,
)
from sceneslam.sources.ros2.live_recording import LiveRecording
from sceneslam.sources.ros2.network_watch import NetworkWatch
from sceneslam.sources.survey.bag_sample import survey_recording
from sceneslam.sources.survey.survey import Survey
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor, Wheels

_TICK_S = 0.1  # interval of checks for silent streams
_PLACES_S = 3.0  # how long transforms to the sensors are waited for: nodes start one by one
_NETWORK_S = 1.0  # between two looks at who publishes
_PATIENCE_S = 0.05  # an image waits so long for odometry: the period of 20 Hz


class Ros2(Measuring):
    """Gives one observation per message of the first of image, depth, points, scan, odometry.

    If that falls silent, the next one replaces it until it is back. `topics` is as for a bag.
    Topics are received for `listen_s` before the used ones are chosen, and until every configured
    topic has had a message; after `wait_s` without, an InputError is raised.
    """

    def __init__(
        self,
        topics: dict[str, Any],
        camera: dict[str, Any],
        depth_scale: float,
        depth_range_m: list[float] | None,
        lidar_range_m: list[float] | None,
        sync_tolerance_s: float,
        base_frame: str | None,
        transport: str,
        domain_id: int | None,
        discovery: str | None,
        listen_s: float,
        wait_s: float,
        silent_after_s: float,
        wheels: Mapping[str, float] | None,
    ) -> None:
        super().__init__()
        for key, value in (
            ("depth_scale", depth_scale),
            ("sync_tolerance_s", sync_tolerance_s),
            ("listen_s", listen_s),
            ("silent_after_s", silent_after_s),
        ):
            checked_above_zero(key, value)
        if not wait_s > listen_s:
            raise ConfigError("wait_s", wait_s, f"more than listen_s ({listen_s:g}) [s]")
        for need in topics.keys() - TYPES.keys():
            raise ConfigError(
                f"topics.{need}", topics[need], f"a topic for one of {', '.join(TYPES)}"
            )
        self._given = Given(
            intrinsics=given_intrinsics(camera),
            depth_range_m=given_range_m("depth_range_m", depth_range_m),
            lidar_range_m=given_range_m("lidar_range_m", lidar_range_m),
            wheels=Wheels.given(wheels),
        )
        self._named, self._base_frame = topics, base_frame
        self._depth_scale, self._sync_tolerance_s = depth_scale, sync_tolerance_s
        self._listen_s, self._wait_s, self._silent_after_s = listen_s, wait_s, silent_after_s
        self._network = Network(transport=transport, domain_id=domain_id, discovery=discovery)
        self._faults = FaultLog()
        self._transport: Transport | None = None
        self._inbox: Inbox[Arrival] = Inbox()
        self._stamp_ns = 0  # of the newest measurement, for events of the network
        self.heard = LiveRecording()

    @property
    def rig(self) -> Rig:
        """Return the rig of the received sensors; waits for them at the first call.

        Raises InputError if nothing is received, or not all configured topics.
        """
        if self._transport is None:
            self._listen()
        return self._rig

    @property
    def faults(self) -> Sequence[str]:
        """Return the faults of single messages."""
        return self._faults.sentences()

    def survey(self) -> Survey:
        """Return the survey of the messages received at the beginning."""
        _ = self.rig
        return survey_recording(
            self.heard,
            {sensor: self._by_sensor[sensor] for sensor in Sensor if sensor in self._by_sensor},
            depth_scale=self._depth_scale,
            sync_tolerance_s=self._sync_tolerance_s,
            silent_after_s=self._silent_after_s,
            mounts=self._mounts,
            unplaced=self._unplaced(),
            silent=sorted(self.heard.announced.keys() - self.heard.topics.keys()),
            odd=[
                *oddities(self.heard, [name for name in self._named.values() if name]),
                *self.frames.moved(),
                *unregistered(self.heard, self.topics, self.frames),
                *upward(self.heard, self.topics, self.frames),
                *odometry_oddities(self.heard, self.topics.odometry, self.frames),
            ],
        )

    def close(self) -> None:
        """Leave the domain and end the iteration."""
        self._inbox.close()
        if self._transport is not None:
            self._transport.close()

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations as they arrive, until `close`; there is no survey from here on."""
        self.heard.forget()
        for bundle, primary in self._bundles():
            if self._streams is None or not self._streams.has_begun(bundle.primary.stamp_ns):
                continue
            try:
                decoded = self._decoders[primary].observe(bundle)
            except InputError as error:  # another encoding than at the beginning, say
                self._leave_out(str(error), bundle.primary.stamp_ns)
                continue
            for problem in decoded.problems:
                self._leave_out(problem, decoded.stamp_ns)
            if decoded.observation is not None:
                yield decoded.observation

    def _listen(self) -> None:
        """Receive all topics, choose the used ones, and subscribe to these only."""
        wanted = [name for name in self._named.values() if name not in (None, NONE)]
        self._transport = open_transport(self._network)
        try:
            self.heard.listen(
                self._transport,
                wanted=wanted,
                listen_s=self._listen_s,
                wait_s=self._wait_s,
                waits_s=self._waits_s,
            )
            self._choose(wanted)
        except BaseException:
            self.close()
            raise
        self._follow(self._transport)

    def _choose(self, wanted: Sequence[str]) -> None:
        heard, missing = self.heard, sorted(set(wanted) - self.heard.topics.keys())
        if missing or not heard.topics:
            what = f"nothing on {', '.join(missing)}" if missing else "no topic with a sensor"
            raise InputError(
                f"{what} within {self._wait_s:g} s in {self._where()}: {self._there()}"
            )
        chosen = {need: self._name(need, name) for need, name in self._named.items()}
        try:
            self.topics = choose_topics(heard, chosen)
            self._by_sensor = sensor_topics(heard, self.topics, is_live=True)
            if not any(sensor in self._by_sensor for sensor in PRIMARY):
                raise InputError("no image, depth, points, scan or odometry")
            self.frames = FrameTree(heard, self._base_frame, self._by_sensor.values())
            self._rig = make_rig(
                heard,
                self.topics,
                sensors=self._by_sensor,
                frames=self.frames,
                given=self._given,
            )
            self._mounts = find_mounts(heard, self.topics, self.frames)
        except InputError as error:
            raise InputError(f"{error}: {self._where()}, {self._there()}") from error

    def _name(self, need: str, name: str | None) -> str | None:
        """Return the configured name of a topic, or the usual one if it was received."""
        usual = (one for one in USUAL.get(need, ()) if one in self.heard.topics)
        return name if name is not None else next(usual, None)

    def _follow(self, transport: Transport) -> None:
        used = {self._by_sensor[sensor] for sensor in self._by_sensor}
        types = {topic: self.heard.topics[topic].msgtype for topic in used}
        self._decoder = MessageDecoder(
            {topic: TopicType.of_network(types[topic]) for topic in used}
        )
        camera, is_seeing = self._rig.camera, bool(self.topics.image or self.topics.depth)
        units = DepthUnits(self._depth_scale, camera.depth_range_m if camera else (0.0, 100.0))
        size_wh = picture_size_wh(self.heard, self.topics) if is_seeing else None
        sensors = self._rig.sensors
        self._decoders = {
            sensor: BundleDecoder(sensor, sensors, size_wh, units, is_live=True)
            for sensor in PRIMARY
        }
        self._streams = Streams(self._by_sensor, self._silent_after_s, monotonic_ns())
        sampled = {
            topic
            for sensor, topic in self._by_sensor.items()
            if sensor.is_sampled or sensor is Sensor.ODOMETRY
        }
        for topic in sorted(used):
            qos = Qos.SAMPLES if topic in sampled else Qos.SENSOR
            transport.subscribe(topic, types[topic], self._inbox.put, qos)
        fixed = {topic for topic in self.heard.topics if is_static(topic)}
        mounts = {names.TF_STATIC, *(topic for topic in fixed if is_beside(topic, used))}
        followed = [topic for topic in (self.topics.camera_info, *sorted(mounts)) if topic]
        self._network_watch = NetworkWatch(
            types,
            camera_info=self.topics.camera_info,
            mounts=mounts,
            known=self.heard.messages(followed),
            unplaced=self._unplaced(),
            tell=self._tell,
        )
        self._network_watch.subscribe(transport)

    def _bundles(self) -> Iterator[tuple[SynchronisedSamples, Sensor]]:
        """Yield synchronised samples, each with its primary sensor."""
        assert self._streams is not None, "`rig` has to be read before iteration"
        streams, primary = self._streams, self._streams.pace
        synchroniser = Synchroniser(
            primary,
            frozenset(self._by_sensor),
            self._sync_tolerance_s,
            waits_for=streams.waits_for,
            patience_s=_PATIENCE_S,
            extrapolates=True,
            faults=self._faults,
        )
        types = {topic: self.heard.topics[topic].msgtype for topic in self._by_sensor.values()}
        stamp_ns = asked_ns = 0
        looked_ns = monotonic_ns()
        while not self._inbox.is_closed:
            arrival = self._inbox.take(_TICK_S)
            if arrival is not None:
                for sensor, sample in self._samples(arrival):
                    stamp_ns = sample.stamp_ns
                    if sensor is not streams.pace or primary is streams.pace:
                        yield from ((one, primary) for one in synchroniser.add(sensor, sample))
            # While messages are queued, the time is the arrival time of the oldest.
            now_ns = monotonic_ns() if arrival is None else arrival.arrived_ns
            if now_ns - looked_ns > _TICK_S * 1e9:
                looked_ns = now_ns
                streams.look(looked_ns, stamp_ns)
                streams.drop(self._inbox.take_dropped(), looked_ns, stamp_ns)
            if now_ns - asked_ns > _NETWORK_S * 1e9 and self._transport is not None:
                asked_ns, self._stamp_ns = now_ns, stamp_ns
                published = self._transport.publications()
                self._network_watch.look(published)
                alike = [one.topic for one in published if one.msgtype == types.get(one.topic)]
                streams.count_publishers(alike, stamp_ns, now_ns)
            primary = streams.pace
            synchroniser.follow(primary, streams.waits_for)

    def _samples(self, arrival: Arrival) -> Iterator[tuple[Sensor, Sample]]:
        """Yield a message's samples, with aligned stamps."""
        assert self._streams is not None
        topic = arrival.topic
        message = self._decoder.decode(topic, arrival.cdr)
        if message is None:
            self._leave_out(f"a message of {topic} makes no sense", self._stamp_ns)
            return
        heard = (topic, arrival.publisher, arrival.arrived_ns, self._stamp_ns)
        if not self._streams.follows(*heard):
            return
        lined = self._clock.line_up(topic, decode.stamp_ns(message), arrival.arrived_ns)
        self._streams.hear(topic, lined, arrival.arrived_ns)
        if lined.order is StampOrder.UNORDERED:
            return
        for sensor in (one for one, name in self._by_sensor.items() if name == topic):
            held = measured(message, sensor, self._mounts)
            if held is not None:
                yield (
                    sensor,
                    Sample(stamp_ns=lined.stamp_ns, arrived_ns=arrival.arrived_ns, value=held),
                )

    def _leave_out(self, problem: str, stamp_ns: int) -> None:
        """Count a message that cannot be used, and report it."""
        assert self._streams is not None
        self._faults.add(problem, at_stamp(stamp_ns))
        self._streams.tell_once("left_out", stamp_ns, monotonic_ns(), what=problem)

    def _tell(self, event: str, **fields: object) -> None:
        assert self._streams is not None
        self._streams.tell_once(event, self._stamp_ns, monotonic_ns(), **fields)

    def _waits_s(self) -> float:
        """Return how long after the first measurement to wait for what is missing."""
        if self._given.intrinsics is None and lacks_calibration(self.heard):
            return self._wait_s
        is_unplaced = lacks_transforms(self.heard, self._base_frame)
        return self._listen_s + _PLACES_S if is_unplaced else 0.0

    def _unplaced(self) -> list[str]:
        return unplaced(self.heard, self.topics, self.frames)

    def _where(self) -> str:
        reach = self._network.reach()
        return f"domain {self._network.domain()} ({reach}; ROS_DOMAIN_ID, source.discovery)"

    def _there(self) -> str:
        """Return the announced and the received topics as text."""
        announced: Mapping[str, str] = self.heard.announced
        parts = [
            f"{topic} ({msgtype}{'' if topic in self.heard.topics else ', silent'})"
            for topic, msgtype in sorted(announced.items())
        ]
        return f"there is {', '.join(parts)}" if parts else "nobody publishes a sensor there"
