"""Operators' requests over ROS 2 topics (services are not compatible between DDS vendors)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from typing import Any

from sceneslam.ros import decode
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.ros.transport.transport import Arrival, Qos, Transport
from sceneslam.types.command import Command, Pause, SelectModule, SelectScene
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)
INITIAL_POSE = "/initialpose"
SELECT_SCENE = "/sceneslam/select_scene"
SELECT_MODULE = "/sceneslam/select_module"
SAVE_MAP = "/sceneslam/save_map"
PAUSE = "/sceneslam/pause"
_TYPES = {
    INITIAL_POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    SELECT_SCENE: "std_msgs/msg/String",
    SELECT_MODULE: "std_msgs/msg/String",
    SAVE_MAP: "std_msgs/msg/String",
    PAUSE: "std_msgs/msg/Bool",
}


class Requests:
    """Passes requests from the network's thread to the run's."""

    def __init__(self, transport: Transport, *, map_frame: str) -> None:
        self._map_frame = map_frame
        self._commands: list[Command] = []
        self._names: list[str] = []
        self._T_frame_base: Transform | None = None
        self._lock = threading.Lock()
        self._decoder = MessageDecoder(
            {topic: TopicType.of_network(kind) for topic, kind in _TYPES.items()}
        )
        takers: dict[str, Callable[[Any], None]] = {
            INITIAL_POSE: self._place,
            SELECT_SCENE: lambda text: self._add(SelectScene(scene=str(text.data))),
            SELECT_MODULE: lambda text: self._add(SelectModule(module=str(text.data))),
            SAVE_MAP: lambda text: self._save(str(text.data)),
            PAUSE: lambda switch: self._add(Pause(is_paused=bool(switch.data))),
        }
        self._takers = takers
        for topic, kind in _TYPES.items():
            transport.subscribe(topic, kind, self._take, Qos.RELIABLE)

    def commands(self) -> Sequence[Command]:
        """Return the commands received since the last call."""
        with self._lock:
            asked, self._commands = self._commands, []
            return asked

    def maps(self) -> Sequence[str]:
        """Return the requested names of saved maps since the last call."""
        with self._lock:
            asked, self._names = self._names, []
            return asked

    def placed(self) -> Transform | None:
        """Return T_frame_base (4, 4) [m] of a new `/initialpose`, None without."""
        with self._lock:
            asked, self._T_frame_base = self._T_frame_base, None
            return asked

    def _take(self, arrival: Arrival) -> None:
        message = self._decoder.decode(arrival.topic, arrival.cdr)
        if message is None:
            _log.warning("a message of %s is invalid", arrival.topic)
            return
        self._takers[arrival.topic](message)

    def _place(self, message: Any) -> None:
        frame = decode.frame_id(message)
        if frame != self._map_frame:
            _log.warning("%s in frame %r: expected frame %r", INITIAL_POSE, frame, self._map_frame)
            return
        pose = message.pose.pose
        with self._lock:
            self._T_frame_base = decode.transform(pose.position, pose.orientation)

    def _save(self, name: str) -> None:
        with self._lock:
            self._names.append(name)

    def _add(self, command: Command) -> None:
        with self._lock:
            self._commands.append(command)
