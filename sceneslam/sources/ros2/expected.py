"""Checks for what a robot should publish: calibration, transforms, types."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sceneslam.ros import decode
from sceneslam.sources.bag.frames import FrameTree, is_of_transforms, is_static
from sceneslam.sources.bag.rig import unconnected
from sceneslam.sources.bag.topics import TYPES, first
from sceneslam.sources.ros2.live_recording import LiveRecording
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.se3 import Transform

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
_SAME_M, _SAME_RAD = 0.05, 0.05  # between poses that arrive one after the other, driving at 1 m/s
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


def odometry_oddities(
    heard: LiveRecording, odometry: str | None, frames: FrameTree
) -> Iterator[str]:
    """Yield a warning if /tf does not place the base as the odometry that is used does.

    The run's `map -> odom` leads to the base over that odometry alone.
    """
    above = frames.above(frames.base) if frames.base else ()
    if not above:
        return
    there = f"/tf has {frames.base!r} in {', '.join(map(repr, above))}"
    message = first(heard, odometry) if odometry else None
    if odometry is None or message is None:
        yield f"{there} and no odometry is used: map -> {frames.base} would be a second parent"
        return
    frame, child = decode.frame_id(message), decode.child_frame_id(message)
    if frame in above and _agree(heard, odometry, frame, child):
        return
    problem = "has other poses" if frame in above else f"is in frame {frame!r}"
    yield (
        f"{there} and {odometry} {problem}: choose the odometry that is on /tf, "
        "such as source.topics.odometry=/odometry/filtered"
    )


def _agree(heard: LiveRecording, odometry: str, frame: str, child: str) -> bool:
    """Tell whether a pose of odometry is about that of /tf at its arrival, if /tf has any."""
    moving = {topic for topic in heard.topics if is_of_transforms(topic) and not is_static(topic)}
    placed = [
        (message.log_ns, one.T_parent_child)
        for message in heard.messages(moving)
        for one in decode.transforms(heard.decode(message))
        if (one.parent, one.child) == (frame, child)
    ]
    for message in heard.messages({odometry}):
        decoded = heard.decode(message)
        if decoded is None or not placed:
            continue
        T_frame_child = decode.transform(decoded.pose.pose.position, decoded.pose.pose.orientation)
        _, T_there = min(placed, key=lambda one: abs(one[0] - message.log_ns))
        if T_frame_child is not None and _is_same(T_there, T_frame_child):
            return True
    return not placed


def _is_same(T_a_b: Transform, T_a_c: Transform) -> bool:
    return se3.is_within(se3.inverse(T_a_b) @ T_a_c, _SAME_M, _SAME_RAD)
