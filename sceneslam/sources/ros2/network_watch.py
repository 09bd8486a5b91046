"""Detect changes of types, calibration and mounts while a robot drives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sceneslam.ros import decode
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.ros.transport.transport import Arrival, Publication, Qos, Transport
from sceneslam.sources.bag.recording import Message
from sceneslam.types.errors import InputError
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_TF_TYPE = "tf2_msgs/msg/TFMessage"
_SAME = 1e-6  # of transforms, which come as float64

Tell = Callable[..., None]  # event, and its fields


class NetworkWatch:
    """Reports changes of a topic that a running source cannot apply."""

    def __init__(
        self,
        types: Mapping[str, str],
        *,
        camera_info: str | None,
        mounts: Collection[str],
        known: Iterable[Message],
        unplaced: Sequence[str],
        tell: Tell,
    ) -> None:
        """Begin; `known` are the messages so far of `camera_info` and of `mounts`.

        `mounts` are the topics of fixed transforms.
        """
        self._types, self._tell = types, tell
        self._told: set[tuple[str, str]] = set()
        self._camera_info, self._unplaced = camera_info, list(unplaced)
        self._mount_topics = sorted(mounts)
        self._decoder = MessageDecoder(
            {
                **dict.fromkeys(self._mount_topics, TopicType.of_network(_TF_TYPE)),
                camera_info or "": TopicType.of_network("sensor_msgs/msg/CameraInfo"),
            }
        )
        self._camera: Camera | None = None
        self._mounts: dict[str, dict[str, Transform]] = {one: {} for one in mounts}  # by topic
        for message in known:
            decoded = self._decoder.decode(message.topic, message.data)
            if message.topic in self._mounts:
                self._mounts[message.topic] |= _mounts(decoded)
            else:
                self._camera = _camera(decoded)

    def subscribe(self, transport: Transport) -> None:
        """Listen to the calibration and to fixed transforms."""
        if self._camera_info is not None:
            kind = "sensor_msgs/msg/CameraInfo"
            transport.subscribe(self._camera_info, kind, self._take_camera)
        for topic in self._mount_topics:
            transport.subscribe(topic, _TF_TYPE, self._take_mounts, Qos.HISTORY)

    def look(self, publications: Sequence[Publication]) -> None:
        """Report publishers with another type on a topic that is used."""
        for one in publications:
            expected = self._types.get(one.topic, one.msgtype)
            if one.msgtype != expected and (one.topic, one.msgtype) not in self._told:
                self._told.add((one.topic, one.msgtype))
                self._tell("wrong_type", topic=one.topic, type=one.msgtype, expected=expected)

    def _take_camera(self, arrival: Arrival) -> None:
        message = self._decoder.decode(arrival.topic, arrival.cdr)
        camera = None if message is None else _camera(message)
        if camera is None or _lens(camera) == _lens(self._camera):
            return
        if self._camera is not None:
            self._tell("camera_info_changed", topic=arrival.topic, fx=camera.fx, fy=camera.fy)
        self._camera = camera

    def _take_mounts(self, arrival: Arrival) -> None:
        message = self._decoder.decode(arrival.topic, arrival.cdr)
        found, known = _mounts(message), self._mounts[arrival.topic]
        late = [frame for frame in found if frame not in known]
        moved = [
            frame
            for frame, T_parent_frame in found.items()
            if frame not in late and not np.allclose(known[frame], T_parent_frame, atol=_SAME)
        ]
        known |= found
        if late and self._unplaced:
            self._tell("tf_late", frames=late, missed=self._unplaced)
        if moved:
            self._tell("tf_changed", frames=moved)


def _camera(message: Any) -> Camera | None:
    """Return the camera of a CameraInfo, None for a lens that the configuration has to replace."""
    try:
        return decode.camera(message)
    except InputError:
        return None


def _lens(camera: Camera | None) -> object:
    """Return what is compared of a calibration."""
    if camera is None:
        return None
    return camera.size_wh, camera.fx, camera.fy, camera.cx, camera.cy, tuple(camera.distortion)


def _mounts(message: Any) -> dict[str, Transform]:
    """Return T_parent_frame of the frames of a TFMessage."""
    return {one.child: one.T_parent_child for one in decode.transforms(message)}
