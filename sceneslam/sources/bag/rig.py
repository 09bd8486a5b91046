"""The sensors of a recording: types, intrinsics and poses on the robot."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import decode, names, pixels
from sceneslam.sources.bag.frames import FrameTree, has_base_name
from sceneslam.sources.bag.observation import Mounts
from sceneslam.sources.bag.recording import Recording
from sceneslam.sources.bag.topics import (
    NONE,
    BagTopics,
    first,
    first_calibrated,
    holds_poses,
    inertial_sensors,
    infos_of,
)
from sceneslam.sources.intrinsics import Intrinsics
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.rig import Camera, Laser, Lidar, Rig, Sensor, Wheels, optical_to_rep103
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)
_NEEDS = {  # sensor -> field of BagTopics that names its topic
    Sensor.IMAGE: "image",
    Sensor.DEPTH: "depth",
    Sensor.SCAN: "scan",
    Sensor.POINTS: "points",
    Sensor.ODOMETRY: "odometry",
    Sensor.GYRO: "imu",
    Sensor.ACCELEROMETER: "imu",
}
# Topics of image_proc and of other drivers, such as image_rect_color and image_color_rect.
_RECTIFIED = re.compile(r"image_rect|(^|[/_])rect(?=[/_]|$)")
_UPWARD = 0.7  # cosine between a camera's axis and up: its body is tilted by less than 45 degrees
_DEPTH_RANGE_M, _LIDAR_RANGE_M = (0.3, 8.0), (1.0, 100.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Given:
    """Values of the configuration that replace recorded ones; None: as recorded."""

    intrinsics: Intrinsics | None
    depth_range_m: tuple[float, float] | None
    lidar_range_m: tuple[float, float] | None
    wheels: Wheels


def sensor_topics(
    recording: Recording, topics: BagTopics, *, is_live: bool = False
) -> dict[Sensor, str]:
    """Return the topic of each recorded sensor; one Imu topic can be gyro and accelerometer."""
    chosen = {sensor: getattr(topics, need) for sensor, need in _NEEDS.items()}
    if topics.odometry and not is_live and not holds_poses(recording, topics.odometry):
        _log.warning(
            "%s: its pose does not move although its twist does; it is not used, as with "
            "source.topics.odometry=none",
            topics.odometry,
        )
        chosen[Sensor.ODOMETRY] = None
    measured = inertial_sensors(recording, topics.imu, is_live=is_live) if topics.imu else set()
    return {
        sensor: name
        for sensor, name in chosen.items()
        if name is not None and (name != topics.imu or sensor in measured)
    }


def make_rig(
    recording: Recording,
    topics: BagTopics,
    *,
    sensors: Collection[Sensor],
    frames: FrameTree,
    given: Given,
) -> Rig:
    """Return the rig; raises InputError for a camera that cannot be used, and says how to go on."""
    said = recording.metadata.get(names.RIG_METADATA, {})
    laser = lidar = None
    if topics.scan:
        laser = Laser(T_base_laser=place(recording, topics.scan, frames, is_planar=True))
    if topics.points:
        lidar = Lidar(
            range_m=given.lidar_range_m or _said(said, "lidar_range_m") or _LIDAR_RANGE_M,
            T_base_lidar=place(recording, topics.points, frames),
        )
    camera = None
    if topics.image or topics.depth:
        depth_range_m = given.depth_range_m or _said(said, "depth_range_m") or _DEPTH_RANGE_M
        try:
            camera = _camera(recording, topics, frames, given.intrinsics, depth_range_m)
        except InputError as err:
            raise InputError(f"{err}{_way_without_camera(topics)}") from err
    return Rig(
        sensors=frozenset(sensors), camera=camera, laser=laser, lidar=lidar, wheels=given.wheels
    )


def place(
    recording: Recording, topic: str, frames: FrameTree, *, is_planar: bool = False
) -> Transform:
    """Return T_base_sensor (4, 4) [m] of a topic's sensor; if it is not recorded, the usual one.

    A planar one is level even in an optical frame: that of the depth images it is computed from.
    """
    message = first(recording, topic)
    T_base_sensor = None if message is None else frames.T_base(decode.frame_id(message))
    if T_base_sensor is not None:
        return T_base_sensor
    return se3.identity() if is_planar else _usual(message)


def unplaced(recording: Recording, topics: BagTopics, frames: FrameTree) -> list[str]:
    """Return the frames of sensors that no transform places; another sensor may place an IMU.

    The frame whose pose odometry reports is one of them, unless it has a base's name.
    """
    imu = topics.imu if _T_base_imu(recording, topics, frames) is None else None
    chosen = (topics.image or topics.depth, topics.scan, topics.points, imu)
    found = unconnected(recording, [topic for topic in chosen if topic], frames)
    child = _odometry_child(recording, topics)
    is_placed = frames.is_base(child) or has_base_name(child) or frames.T_base(child) is not None
    return found if not child or is_placed or child in found else [*found, child]


def unconnected(recording: Recording, topics: Sequence[str], frames: FrameTree) -> list[str]:
    """Return the frames of the topics' first messages that no transform connects with the base."""
    messages = [first(recording, topic) for topic in topics]
    found = dict.fromkeys(decode.frame_id(one) for one in messages if one is not None)
    return [name for name in found if not frames.is_base(name) and frames.T_base(name) is None]


def unregistered(recording: Recording, topics: BagTopics, frames: FrameTree) -> Iterator[str]:
    """Yield a sentence if depth was measured through another lens or elsewhere than the images."""
    pictures = [first(recording, topic) for topic in (topics.image, topics.depth) if topic]
    seen_in = [decode.frame_id(message) for message in pictures if message is not None]
    if len(seen_in) < 2 or seen_in[0] == seen_in[1]:
        return
    T_image_depth = frames.between(*seen_in)
    is_apart = T_image_depth is not None and not np.allclose(T_image_depth, np.eye(4), atol=1e-6)
    of_depth = infos_of(recording, topics.depth or "")[:1]
    infos = [first_calibrated(recording, one) for one in (topics.camera_info, *of_depth) if one]
    lenses = [decode.coefficients(info, "k") for info in infos if info is not None]
    if is_apart or (len(lenses) == 2 and not np.allclose(lenses[0], lenses[1])):
        yield (
            f"{topics.depth} (frame {seen_in[1]!r}) has another lens or position than "
            f"{topics.image} (frame {seen_in[0]!r}): depth has to be registered to the images"
        )


def upward(recording: Recording, topics: BagTopics, frames: FrameTree) -> Iterator[str]:
    """Yield a sentence if the camera looks up by its transform, as in the frame of its body."""
    topic = topics.image or topics.depth
    message = first(recording, topic) if topic else None
    frame = "" if message is None else decode.frame_id(message)
    T_base_cam = frames.T_base(frame)
    if T_base_cam is not None and T_base_cam[2, 2] > _UPWARD and "optical" not in frame:
        yield (
            f"{topic}: by its transform, the camera of frame {frame!r} looks up; is this the frame "
            "of its body (x ahead), and not its optical frame (z ahead)?"
        )


def recalibrated(recording: Recording, topics: BagTopics) -> Iterator[str]:
    """Yield a sentence if the last camera_info has another lens than the one that is used."""
    is_rectified = _is_rectified(topics)
    last = recording.last(topics.camera_info) if topics.camera_info else None
    infos = (_used_info(recording, topics), None if last is None else recording.decode(last))
    lenses = [
        decode.lens(info, is_rectified=is_rectified)
        for info in infos
        if info is not None and decode.is_calibrated(info, is_rectified=is_rectified)
    ]
    if len(lenses) == 2 and not _is_same_lens(lenses[0], lenses[1]):
        first_px, last_px = (", ".join(f"{k[at]:g}" for at in (0, 4, 2, 5)) for k in lenses)
        yield (
            f"{topics.camera_info} changes: fx, fy, cx, cy are {first_px} at first and {last_px} "
            "at the end; the first ones are used, source.camera.fx and so on replace them"
        )


def find_mounts(recording: Recording, topics: BagTopics, frames: FrameTree) -> Mounts:
    """Return the poses of the IMU and of odometry's frame; the usual ones if not recorded."""
    T_base_imu = _T_base_imu(recording, topics, frames)
    if T_base_imu is None:
        T_base_imu = _usual(first(recording, topics.imu) if topics.imu else None)
    child = _odometry_child(recording, topics)
    T_base_child = frames.T_base(child) if child else None
    T_child_base = se3.identity() if T_base_child is None else se3.inverse(T_base_child)
    return Mounts(T_base_imu=T_base_imu, T_child_base=T_child_base)


def picture_size_wh(recording: Recording, topics: BagTopics) -> tuple[int, int]:
    """Return width and height [px] of the first undamaged image, or depth image without images."""
    topic = topics.image or topics.depth or ""
    for message in recording.messages({topic}):
        decoded = recording.decode(message)
        picture: Any = None
        if decoded is not None and topics.image:
            picture = decode.image_bgr(decoded)
        elif decoded is not None:
            picture = decode.depth_m(decoded, pixels.DepthUnits(1000.0, _DEPTH_RANGE_M))
        if picture is not None:
            return int(picture.shape[1]), int(picture.shape[0])
    raise InputError(f"none of the images of {topic} can be decoded")


def _usual(message: Any) -> Transform:
    """Return T_base_sensor (4, 4) [m] of a message's sensor that no transform places: identity.

    In an optical frame it looks along x, as a camera does.
    """
    is_optical = message is not None and decode.frame_id(message).endswith("_optical_frame")
    return optical_to_rep103() if is_optical else se3.identity()


def _odometry_child(recording: Recording, topics: BagTopics) -> str:
    """Return the frame whose pose odometry reports, "" if it is not named."""
    message = first(recording, topics.odometry) if topics.odometry else None
    return "" if message is None else decode.child_frame_id(message)


def _T_base_imu(recording: Recording, topics: BagTopics, frames: FrameTree) -> Transform | None:
    """Return T_base_imu (4, 4) [m], None if no transform connects the IMU with the base.

    Nor with a sensor that sits in base without transforms: a lidar, a laser, a camera ahead.
    """
    imu = first(recording, topics.imu) if topics.imu else None
    if imu is None:
        return None
    frame = decode.frame_id(imu)
    T_base_imu = frames.T_base(frame)
    picture = topics.image or topics.depth
    for topic in (topics.points, topics.scan, picture):
        sensor = first(recording, topic) if topic and T_base_imu is None else None
        if sensor is not None and decode.frame_id(sensor) != frame:
            T_base_sensor = optical_to_rep103() if topic == picture else _usual(sensor)
            T_sensor_imu = frames.between(decode.frame_id(sensor), frame)
            T_base_imu = None if T_sensor_imu is None else T_base_sensor @ T_sensor_imu
    return T_base_imu


def _camera(
    recording: Recording,
    topics: BagTopics,
    frames: FrameTree,
    given: Intrinsics | None,
    depth_range_m: tuple[float, float],
) -> Camera | None:
    """Return the camera of the colour images; without these, that of the depth images."""
    picture = topics.image or topics.depth or ""
    message = first(recording, picture)
    size_wh = picture_size_wh(recording, topics)
    is_recorded = given is None or given.distortion is None
    recorded = _recorded(recording, topics) if is_recorded else None
    if recorded is None and given is None:
        if topics.depth is None:
            return None
        raise InputError(
            "depth without intrinsics: the recording has no usable camera_info; "
            "give source.camera.fx, fy, cx and cy [px]"
        )
    if given is None and recorded is not None and recorded.size_wh != size_wh:
        raise InputError(
            f"camera_info is for {recorded.size_wh[0]}x{recorded.size_wh[1]} pixels but the images "
            f"have {size_wh[0]}x{size_wh[1]}: give source.camera.fx, fy, cx and cy [px]"
        )
    T_base_cam = frames.T_base(decode.frame_id(message))
    camera = recorded or Camera(size_wh=size_wh, fx=1.0, fy=1.0, cx=0.0, cy=0.0)
    if given is not None:
        camera = replace(camera, fx=given.fx, fy=given.fy, cx=given.cx, cy=given.cy)
        if given.distortion is not None:
            camera = replace(camera, distortion=given.distortion)
    return replace(
        camera,
        size_wh=size_wh,
        depth_range_m=depth_range_m,
        T_base_cam=optical_to_rep103() if T_base_cam is None else T_base_cam,
    )


def _recorded(recording: Recording, topics: BagTopics) -> Camera | None:
    """Return the camera of the first camera_info with a lens, None without."""
    info = _used_info(recording, topics)
    try:
        return None if info is None else decode.camera(info, is_rectified=_is_rectified(topics))
    except InputError as err:
        raise InputError(f"{err}; or give source.camera.fx, fy, cx, cy, distortion") from err


def _used_info(recording: Recording, topics: BagTopics) -> Any:
    """Return the first camera_info with a lens, None without."""
    if topics.camera_info is None:
        return None
    return first_calibrated(recording, topics.camera_info, is_rectified=_is_rectified(topics))


def _is_rectified(topics: BagTopics) -> bool:
    return bool(_RECTIFIED.search(topics.image or topics.depth or ""))


def _is_same_lens(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return one.shape == other.shape and np.allclose(one, other)


def _way_without_camera(topics: BagTopics) -> str:
    """Return how a run does without its camera, "" if it has no other sensor."""
    if not (topics.scan or topics.points or topics.odometry):
        return ""
    used = {need: topic for need in ("image", "depth") if (topic := getattr(topics, need))}
    keys = " ".join(f"source.topics.{need}={NONE}" for need in used)
    return f"; or do without {' and '.join(used.values())}: {keys}"


def _said(said: Any, key: str) -> tuple[float, float] | None:
    """Return a range [m] from the metadata of a SceneSLAM recording; None if missing or damaged."""
    try:
        low, high = json.loads(said[key])
        return float(low), float(high)
    except (KeyError, TypeError, ValueError):
        return None
