"""Choice of a recording's topics: one per sensor."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from sceneslam.ros import decode, names
from sceneslam.sources.bag.mcap_file import ENCODINGS
from sceneslam.sources.bag.recording import Message, Recording
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Sensor

_log = logging.getLogger(__name__)
NONE = "none"  # as a topic's name: the sensor is not used
_FIRST = 100  # messages searched: gyro and accelerometer may come in messages of their own
_FIRST_SLOW = 10  # the same where the images between have to be decompressed slowly
_LATER = 20  # messages at each of so many times, where none of the first ones measures something
_SPEED_AT_REST = 0.05  # [m/s] or [rad/s]; more than the noise of odometry that stands still
_HINTS = {"odometry": "; of a robot, the one that is odom -> base_link on /tf"}
_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
TYPES = {
    "image": _IMAGES,
    "depth": _IMAGES,
    "camera_info": ("sensor_msgs/msg/CameraInfo",),
    "scan": ("sensor_msgs/msg/LaserScan",),
    "points": ("sensor_msgs/msg/PointCloud2",),
    "odometry": ("nav_msgs/msg/Odometry",),
    "imu": ("sensor_msgs/msg/Imu",),
    "ground_truth": _POSES,
    "scene": ("std_msgs/msg/String",),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class BagTopics:
    """One topic per sensor or reference; None: not available."""

    image: str | None
    depth: str | None
    camera_info: str | None
    scan: str | None
    points: str | None
    odometry: str | None
    imu: str | None
    ground_truth: str | None
    scene: str | None


def choose_topics(recording: Recording, given: Mapping[str, str | None]) -> BagTopics:
    """Return the configured topics; the others are found by message type and encoding.

    Raises ConfigError for an unknown topic, InputError if several topics fit.
    """
    for need, name in given.items():
        _check_given(recording, need, name)
    chosen = {need: name for need, name in given.items() if name is not None}
    images = [
        name
        for name in _of_type(recording, _IMAGES)
        if name not in chosen.values() and not {"image", "depth"} <= chosen.keys()
    ]
    firsts = {name: first(recording, name) for name in images}
    depths = [name for name in images if firsts[name] and decode.is_depth(firsts[name], name)]
    colors = [name for name in images if firsts[name] and name not in depths]
    for name in [name for name in colors if _is_8_bit_depth(name, firsts[name])]:
        _log.warning("%s holds 8-bit images (8UC1), no depth: that is 16UC1 or 32FC1", name)
        colors.remove(name)
    found = {
        "image": _without_grey(_one_transport(colors), firsts),
        "depth": _prefer(_one_transport(depths), _is_registered),
        **{need: _of_type(recording, TYPES[need]) for need in ("scan", "points")},
        "imu": [] if "imu" in chosen else _gyros_first(recording),
        "odometry": [n for n in _of_type(recording, TYPES["odometry"]) if not _is_truth(n)],
        "ground_truth": [n for n in _of_type(recording, _POSES) if _is_truth(n)],
        "scene": [n for n in _of_type(recording, TYPES["scene"]) if _is_truth(n)],
    }
    for need in [need for need in found if need not in chosen]:
        chosen[need] = _only(need, found[need])
    picture = chosen["image"] if chosen["image"] != NONE else chosen["depth"]
    if "camera_info" not in chosen:
        chosen["camera_info"] = _camera_info(recording, picture)
    return BagTopics(**{need: None if name == NONE else name for need, name in chosen.items()})


def first(recording: Recording, topic: str) -> Any:
    """Return a topic's first message that can be decoded, None without."""
    for message in recording.messages({topic}):
        decoded = recording.decode(message)
        if decoded is not None:
            return decoded
    return None


def first_calibrated(recording: Recording, camera_info: str, *, is_rectified: bool = False) -> Any:
    """Return a topic's first CameraInfo with a lens, by samples of its messages; None without.

    Drivers publish zeros until they have read their calibration.
    """
    at_first = _FIRST_SLOW if recording.is_slow else _FIRST
    for message in _spread_messages(recording, camera_info, at_each=1, at_first=at_first):
        info = recording.decode(message)
        if info is not None and decode.is_calibrated(info, is_rectified=is_rectified):
            return info
    return None


def inertial_sensors(
    recording: Recording, topic: str, *, is_live: bool = False
) -> Collection[Sensor]:
    """Return which of gyro and accelerometer an Imu topic measures, by samples of its messages.

    A vector is missing if its covariance says so, or if it is exactly zero in all samples: a driver
    may fill in the orientation alone, and RealSense's publishes both vectors apart. In a live
    recording, a simulated robot that stands still may turn later: a gyro that is zero so far is
    taken to be one, unless the topic is named as an accelerometer. So are both while both are zero.
    """
    said: set[Sensor] = set()
    moved: set[Sensor] = set()
    for message in _spread_messages(recording, topic):
        imu = recording.decode(message)
        vectors = {} if imu is None else decode.inertial(imu)
        said |= vectors.keys()
        moved |= {sensor for sensor, vector in vectors.items() if vector.any()}
        if len(moved) == 2:
            break
    silent = said - moved if moved or not is_live else set()
    if is_live and "accel" not in topic.lower():
        silent -= {Sensor.GYRO}
    for sensor in silent:
        _log.warning("%s holds no %s, only zeros", topic, sensor.value)
    return said - silent


def holds_poses(recording: Recording, topic: str) -> bool:
    """Tell whether an Odometry topic reports where the robot is, by samples of its messages.

    A driver may fill in the twist alone: the pose then stays where it is while the robot drives.
    """
    poses: set[tuple[float, ...]] = set()
    speeds: list[float] = []
    for message in _spread_messages(recording, topic):
        odometry = recording.decode(message)
        if odometry is not None:
            poses.add(decode.pose_values(odometry))
            speeds.append(decode.speed(odometry))
        if len(poses) > 1:
            return True
    return len(speeds) < 2 or not np.percentile(speeds, 90) > _SPEED_AT_REST


def infos_of(recording: Recording, picture: str) -> list[str]:
    """Return the CameraInfo topic in an image topic's nearest namespace, else those of its frame.

    Those of other frames belong to other cameras.
    """
    infos, parts = _of_type(recording, TYPES["camera_info"]), picture.split("/")
    for length in range(len(parts) - 1, 0, -1):
        candidate = "/".join([*parts[:length], "camera_info"])
        if candidate in infos:
            return [candidate]
    frame = _frame(recording, picture)
    return [name for name in infos if frame is not None and _frame(recording, name) == frame]


def describe(recording: Recording) -> str:
    """Return the topics and their types as text, also those that are not read."""
    known = (f"{name} ({kind.msgtype})" for name, kind in sorted(recording.topics.items()))
    others = f"{', '.join(recording.skipped)}: only {' and '.join(ENCODINGS)} are read"
    return "; ".join(filter(None, [", ".join(known), others if recording.skipped else ""]))


def _check_given(recording: Recording, need: str, name: str | None) -> None:
    key = f"topics.{need}"
    if need not in TYPES:
        raise ConfigError(key, name, f"a topic for one of {', '.join(TYPES)}")
    if name in (None, NONE):
        return
    if not isinstance(name, str) or name not in recording.topics:
        raise ConfigError(key, name, f"{NONE}, null (find it) or one of {describe(recording)}")
    msgtype = recording.topics[name].msgtype
    if msgtype not in TYPES[need]:
        raise ConfigError(key, f"{name} ({msgtype})", f"a topic of {' or '.join(TYPES[need])}")


def _of_type(recording: Recording, types: Collection[str]) -> list[str]:
    return [
        name
        for name, kind in sorted(recording.topics.items())
        if kind.msgtype in types and not name.startswith(names.OWN_PREFIX)
    ]


def _is_truth(name: str) -> bool:
    return "ground_truth" in name.lower() or "groundtruth" in name.lower()


def _is_registered(name: str) -> bool:
    """Tell whether a depth topic's name says that depth is registered to the colour images."""
    return "align" in name.lower() or "regist" in name.lower()


def _is_8_bit_depth(name: str, message: Any) -> bool:
    """Tell whether the image is an 8-bit visualisation of depth, without its unit."""
    name = name.lower()
    is_colour = "color" in name or "rgb" in name
    return "depth" in name and not is_colour and decode.is_grey(message)


def _one_transport(topics: Sequence[str]) -> list[str]:
    """Return the topics without compressed ones whose raw images are recorded as well."""
    return [name for name in topics if name.rsplit("/", 1)[0] not in topics]


def _without_grey(topics: Sequence[str], firsts: Mapping[str, Any]) -> list[str]:
    return _prefer(topics, lambda name: not decode.is_grey(firsts[name]))


def _prefer(topics: Sequence[str], is_better: Callable[[str], bool]) -> list[str]:
    """Return the topics for which `is_better` holds; if there are none, all."""
    return [name for name in topics if is_better(name)] or list(topics)


def _gyros_first(recording: Recording) -> list[str]:
    """Return the Imu topics; of several, those with a gyro first, as bridging needs the turns."""
    imus = _of_type(recording, TYPES["imu"])
    if len(imus) < 2:
        return imus
    return sorted(imus, key=lambda name: Sensor.GYRO not in inertial_sensors(recording, name))


def _spread_messages(
    recording: Recording, topic: str, *, at_each: int = _LATER, at_first: int = _FIRST
) -> Iterator[Message]:
    """Yield a topic's first messages, then `at_each` at times from its whole length."""
    message: Message | None = None
    for message in islice(recording.messages({topic}), at_first):
        yield message
    last = recording.last(topic)
    if message is not None and last is not None:
        for at_ns in np.linspace(message.log_ns, last.log_ns, _LATER).tolist():
            yield from islice(recording.messages({topic}, int(at_ns)), at_each)


def _camera_info(recording: Recording, picture: str) -> str:
    infos = infos_of(recording, picture)
    others = ", ".join(_of_type(recording, TYPES["camera_info"]))
    if not infos and others and picture != NONE:
        _log.warning("camera_info of %s is missing, there is only %s", picture, others)
    return _only("camera_info", infos)


def _frame(recording: Recording, topic: str) -> str | None:
    """Return the frame of a topic's first message, None without one."""
    message = first(recording, topic)
    return None if message is None else decode.frame_id(message)


def _only(need: str, candidates: Sequence[str]) -> str:
    if len(candidates) > 1:
        raise InputError(
            f"topics.{need}: several topics fit ({', '.join(candidates)}): "
            f"choose one, such as source.topics.{need}={candidates[0]} "
            f"({NONE}: do without){_HINTS.get(need, '')}"
        )
    return candidates[0] if candidates else NONE
