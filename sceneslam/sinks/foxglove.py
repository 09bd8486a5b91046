"""Live view of a run in Foxglove: observations, pose, active module and decisions."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np

from sceneslam.interfaces import LiveMapper
from sceneslam.ros import names
from sceneslam.ros.encode import sensor_frames
from sceneslam.ros.pixels import image_options
from sceneslam.ros.transport.transport import Qos, Transport
from sceneslam.sinks.ros2 import requests
from sceneslam.sinks.ros2.topics import TopicSink
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, text_of
from sceneslam.types.files import replacing
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event
from sceneslam.types.se3 import Transform

EVENTS = "/sceneslam/events"
PARAMETERS = {  # parameter in Foxglove's panel -> topic on which its value is published
    "scene": requests.SELECT_SCENE,
    "module": requests.SELECT_MODULE,
    "paused": requests.PAUSE,
    "save_map": requests.SAVE_MAP,
}
LAYOUT = "foxglove_layout.json"
_SENSORS = {
    names.IMAGE: (names.TYPES[names.IMAGE], Qos.SENSOR),
    names.SCAN: (names.TYPES[names.SCAN], Qos.SENSOR),
    names.TF_STATIC: (names.TYPES[names.TF_STATIC], Qos.LATCHED),
    EVENTS: ("std_msgs/msg/String", Qos.RELIABLE),
}
_TOLD = ("scene", "decision", "refused", "fault", "warning", "command", "command_refused")
_log = logging.getLogger(__name__)


class FoxgloveSink(TopicSink):
    """A WebSocket server on this machine for Foxglove, whose panels can also send commands.

    Publishes the topics of `TopicSink`, and every `image_every`-th image, scans, all frames and
    important events. A layout for Foxglove is written to the run's folder.
    """

    def __init__(
        self,
        port: int,
        image_every: int,
        jpeg_quality: int,
        map_every_s: float,
        mapper: LiveMapper,
    ) -> None:
        if not 0 <= port <= 65535 or 0 < port < 1024:
            raise ConfigError("port", port, "1024 to 65535, or 0: any that is free")
        if image_every < 1:
            raise ConfigError("image_every", image_every, "1 or more")
        self._port, self._image_every = port, image_every
        self._jpeg = image_options("jpeg", jpeg_quality)
        super().__init__(
            self._serve,
            map_frame=names.MAP,
            odom_frame=names.ODOM,
            base_frame=names.BASE,
            tf_ahead_s=0.0,
            map_every_s=map_every_s,
            mapper=mapper,
        )

    def open(self, rig: Rig, folder: Path) -> None:
        """Start the server."""
        self._rig, self._images = rig, 0
        super().open(rig, folder)
        layout = files("sceneslam.sinks").joinpath(LAYOUT).read_text()
        path = folder / LAYOUT
        if path.is_file() and path.read_bytes() == layout.encode():  # old versions did not list it
            return
        with replacing(path) as file:
            file.write(layout)

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Publish an observation and its pose, as the robot's clock and odometry have them."""
        stamp_ns, scan = observation.stamp_ns - self._shift_ns, observation.scan
        if T_map_base is not None and observation.T_odom_base is not None:
            children = {names.BASE: se3.inverse(self._T_smooth_odom) @ observation.T_odom_base}
            self.send(names.TF, self.encoder.transforms(stamp_ns, names.ODOM, children))
        if scan is not None:
            scan = replace(scan, stamp_ns=scan.stamp_ns - self._shift_ns)
            self._show(names.SCAN, self.encoder.scan(scan.stamp_ns, scan))
        if observation.image_bgr is not None:
            self._show_image(stamp_ns, observation.image_bgr)
        super().write(observation, T_map_base, module)

    def write_event(self, event: Event) -> None:
        """Publish an event."""
        super().write_event(event)
        if event["event"] in _TOLD:
            text = json.dumps(dict(event), default=str)
            self._show(EVENTS, self.encoder.text(text))

    def _serve(self) -> Transport:
        try:
            from sceneslam.ros.transport.foxglove_server import FoxgloveTransport
        except ImportError as error:
            allowed = f"none, or pip install 'sceneslam[foxglove]' ({text_of(error)})"
            raise ConfigError("viewer", "foxglove", allowed) from error
        served = FoxgloveTransport(self._port, PARAMETERS)
        for topic, (msgtype, qos) in _SENSORS.items():
            served.publisher(topic, msgtype, qos)
        frames = sensor_frames(self._rig)
        if frames:
            cdr = self.encoder.transforms(0, names.BASE, frames)
            served.publisher(names.TF_STATIC, *_SENSORS[names.TF_STATIC]).publish(cdr)
        _log.warning(
            "Foxglove: open connection %s; layout %s in the run's folder", served.url, LAYOUT
        )
        return served

    def _show_image(self, stamp_ns: int, image_bgr: np.ndarray) -> None:
        self._images += 1
        if self._images % self._image_every != 0:
            return
        done, data = cv2.imencode(".jpeg", image_bgr, self._jpeg)
        if done:
            jpeg = np.asarray(data, np.uint8)
            self._show(names.IMAGE, self.encoder.compressed_image(stamp_ns, "jpeg", jpeg))

    def _show(self, topic: str, cdr: bytes) -> None:
        transport = self._transport
        if transport is not None:
            transport.publisher(topic, *_SENSORS[topic]).publish(cdr)
