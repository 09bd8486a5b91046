"""Checks for what a robot should publish: calibration, transforms, types."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sceneslam.ros import decode
from sceneslam.sources.bag.frames import FrameTree
from sceneslam.sources.bag.rig import unconnected
from sceneslam.sources.bag.topics import TYPES, first
from sceneslam.sources.ros2.live_recording import LiveRecording
from sceneslam.types.errors import ConfigError

USUAL = {  # a RealSense camera's and a robot's names; other topics are found by their type
    "image": ("/camera/color/image_raw", "/camera/camera/color/image_raw"),
    "depth": (
        "/camera/aligned_depth_to_color/image_raw",
        "/camera/camera/aligned_depth_to_color/image_raw",
    ),
    "camera_info": ("/camera/color/camera_info", "/camera/camera/color/camera_info"),
    "scan": ("/scan",),
    "odometry": ("/odom",),
    "imu": ("/imu", "/camera/imu", "/camera/camera/imu"),
}
_PLACED = (*TYPES["image"], *TYPES["scan"], *TYPES["points"], *TYPES["imu"])


def lacks_calibration(heard: LiveRecording) -> bool:
    """Tell whether there is depth but no camera_info, without which depth cannot be used."""
    kinds = list(heard.topics.items())
    if any(kind.msgtype in TYPES["camera_info"] for _, kind in kinds):
        return False
    pictures = [topic for topic, kind in kinds if kind.msgtype in TYPES["depth"]]
    messages = [(topic, first(heard, topic)) for topic in pictures]
    return any(one is not None and decode.is_depth(one, topic) for topic, one in messages)


def lacks_transforms(heard: LiveRecording, base_frame: str | None) -> bool:
    """Tell whether no transform connects a sensor with the robot's base yet."""
    try:
        frames = FrameTree(heard, base_frame)
    except ConfigError:  # the base itself is not known yet
        return True
    sensors = [topic for topic, kind in list(heard.topics.items()) if kind.msgtype in _PLACED]
    return bool(unconnected(heard, sensors, frames))


def oddities(heard: LiveRecording, named: Sequence[str]) -> Iterator[str]:
    """Yield warnings of publishers with other types, and of transforms that are not latched."""
    wanted = {name for group in USUAL.values() for name in group} | set(named)
    for topic, msgtype in sorted(heard.other_types.items()):
        used = heard.announced.get(topic)
        if used is not None:
            yield f"{topic} is published as {msgtype} too; it is read as {used}"
        elif topic in wanted:
            yield f"{topic} is {msgtype}, which is not a sensor's type: it is not read"
    if not heard.is_latched:
        yield "/tf_static is not transient local: who joins late does not hear it"
