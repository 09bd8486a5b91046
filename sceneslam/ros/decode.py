"""Conversion of decoded ROS 1 and ROS 2 messages to images, scans, cameras and poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import pixels
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.observation import SWEEP_MAX_S, LaserScan
from sceneslam.types.rig import Camera, Sensor
from sceneslam.types.se3 import Transform

# Encoding -> (dtype, channels, OpenCV conversion to BGR; None: already BGR).
_COLOR: dict[str, tuple[str, int, int | None]] = {
    "bgr8": ("u1", 3, None),
    "8UC3": ("u1", 3, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2BGR),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2BGR),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2BGR),
    "mono8": ("u1", 1, cv2.COLOR_GRAY2BGR),
    "8UC1": ("u1", 1, cv2.COLOR_GRAY2BGR),
    "mono16": ("u2", 1, cv2.COLOR_GRAY2BGR),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2BGR_YUY2),
    # ROS names a Bayer pattern by its first row, OpenCV by the second row from the second column.
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2BGR),
}
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_COMPRESSED_DEPTH_HEADER = 12  # bytes: a format number and two float32 parameters


def stamp_ns(message: Any) -> int:
    """Return a message's header stamp [ns]."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTransform:
    """The pose of a frame in its parent."""

    parent: str
    child: str
    T_parent_child: Transform


def frame_id(message: Any) -> str:
    """Return a message's frame without a leading slash (of old ROS versions)."""
    return str(message.header.frame_id).lstrip("/")


def child_frame_id(message: Any) -> str:
    """Return the frame whose pose a message reports, "" if its type or publisher names none."""
    return str(getattr(message, "child_frame_id", "")).lstrip("/")


def is_depth(message: Any, topic: str) -> bool:
    """Tell whether an Image or CompressedImage holds depth rather than colour."""
    encoding, is_compressed = _encoding(message)
    if "compressedDepth" in encoding:
        return True
    kind = encoding.split(";")[0].strip()
    if kind in ("16UC1", "32FC1"):
        return True
    if kind == "mono16":  # also of thermal cameras
        return "depth" in topic.lower()
    if kind in _COLOR or not is_compressed or "jp" in encoding:
        return False
    stored = pixels.decode(message.data.tobytes(), cv2.IMREAD_UNCHANGED)
    return stored is not None and stored.dtype == np.uint16 and stored.ndim == 2


def is_grey(message: Any) -> bool:
    """Tell whether an image message has a grey encoding."""
    return _encoding(message)[0].split(";")[0].strip() in ("mono8", "mono16", "8UC1")


def image_bgr(message: Any) -> NDArray[np.uint8] | None:
    """Return the image (H, W, 3) uint8 BGR of an Image or CompressedImage, None if damaged.

    Raises InputError for an unknown encoding.
    """
    encoding, is_compressed = _encoding(message)
    if is_compressed:
        return _compressed_bgr(message.data.tobytes(), encoding.split(";")[0].strip())
    if encoding not in _COLOR:
        allowed = ", ".join(sorted(_COLOR))
        raise InputError(f"image encoding: got {encoding!r}, allowed: {allowed}")
    dtype, channels, conversion = _COLOR[encoding]
    raw = _raw(message, dtype, channels)
    if raw is None:
        return None
    if dtype == "u2":
        raw = (raw >> 8).astype(np.uint8)
    return _converted(raw, conversion)


def depth_m(message: Any, units: pixels.DepthUnits) -> NDArray[np.float32] | None:
    """Return the depth (H, W) float32 [m] of an image message, None if it is damaged.

    Raises InputError unless its encoding is 16-bit or float depth.
    """
    encoding, is_compressed = _encoding(message)
    if not is_compressed:
        if encoding not in _DEPTH:
            raise InputError(f"depth encoding: got {encoding!r}, allowed: {', '.join(_DEPTH)}")
        raw = _raw(message, _DEPTH[encoding], 1)
        if raw is None:
            return None
        return units.of_metres(raw) if raw.dtype == np.float32 else units.of_integers(raw)
    data = message.data.tobytes()
    if "compressedDepth" in encoding and len(data) <= _COMPRESSED_DEPTH_HEADER:
        return None
    if "compressedDepth" not in encoding:
        return _integers(pixels.decode(data, cv2.IMREAD_UNCHANGED), units)
    if "rvl" in encoding.lower():
        raise InputError(f"depth encoding: got {encoding!r}, allowed: compressedDepth with PNG")
    stored = pixels.decode(data[_COMPRESSED_DEPTH_HEADER:], cv2.IMREAD_UNCHANGED)
    if encoding.startswith("32FC1") and stored is not None:
        return units.of_metres(_inverse_depth_m(stored, data[:_COMPRESSED_DEPTH_HEADER]))
    return _integers(stored, units)


def is_metric_depth(message: Any) -> bool:
    """Tell whether a depth image is in metres (float), not in integer units."""
    return _encoding(message)[0].startswith("32FC1")


def is_blank_depth(message: Any) -> bool:
    """Tell whether an uncompressed float depth image has no finite value."""
    encoding, is_compressed = _encoding(message)
    raw = None if is_compressed or encoding != "32FC1" else _raw(message, "f4", 1)
    return raw is not None and not np.isfinite(raw).any()


def inertial(imu: Any) -> dict[Sensor, NDArray[np.float64]]:
    """Return an Imu's angular velocity (3,) [rad/s] and acceleration (3,) [m/s^2], own frame."""
    measured = {
        Sensor.GYRO: (imu.angular_velocity, imu.angular_velocity_covariance),
        Sensor.ACCELEROMETER: (imu.linear_acceleration, imu.linear_acceleration_covariance),
    }
    return {
        sensor: np.array([vector.x, vector.y, vector.z])
        for sensor, (vector, covariance) in measured.items()
        if covariance[0] != -1  # -1: not measured
    }


def pose_values(odometry: Any) -> tuple[float, ...]:
    """Return an Odometry's position and quaternion as they are, x, y, z [m] and x, y, z, w."""
    at, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def speed(odometry: Any) -> float:
    """Return the greater of an Odometry's speed [m/s] and turn rate [rad/s], by its twist."""
    twist = odometry.twist.twist
    return max(hypot(one.x, one.y, one.z) for one in (twist.linear, twist.angular))


def scan(message: Any, stamp_ns: int) -> LaserScan | None:
    """Return the scan of a LaserScan message, None if its angles or range limits are invalid.

    `stamp_ns` is of its first beam. Ranges above the maximum (REP-117: also +inf) become inf; NaN,
    zero and below the minimum become NaN. The beams of a clockwise laser are reversed.
    """
    low_m, high_m = float(message.range_min), float(message.range_max)
    step_rad, start_rad = float(message.angle_increment), float(message.angle_min)
    ranges_m = np.array(message.ranges, dtype=np.float32)
    if not high_m > low_m:  # it would be blind
        return None
    if not np.isfinite([start_rad, step_rad, low_m]).all() or step_rad == 0 or not len(ranges_m):
        return None
    if step_rad < 0:
        start_rad, step_rad = start_rad + step_rad * (len(ranges_m) - 1), -step_rad
        ranges_m = ranges_m[::-1].copy()
    with np.errstate(invalid="ignore"):
        ranges_m[(ranges_m < np.float32(low_m)) | (ranges_m <= 0)] = np.nan
        ranges_m[ranges_m >= np.float32(high_m)] = np.inf
    return LaserScan(
        stamp_ns=stamp_ns + round(0.5e9 * _sweep_s(message)),
        ranges_m=pixels.locked(ranges_m),
        angle_min_rad=start_rad,
        angle_step_rad=step_rad,
        range_min_m=low_m,
        range_max_m=high_m,
    )


def _sweep_s(message: Any) -> float:
    """Return the time from the first beam of a LaserScan to the last, 0 if it is not known."""
    sweep_s = abs(float(message.time_increment)) * (len(message.ranges) - 1)
    return sweep_s if sweep_s < SWEEP_MAX_S else 0.0  # 0 for NaN, too


def lens(message: Any, *, is_rectified: bool = False) -> NDArray[np.float64]:
    """Return the lens of a CameraInfo: K (9,) and the distortion (N,), as one array.

    Rectified images have the lens of P, if it is given, without distortion.
    """
    k, d, p = (coefficients(message, letter) for letter in "kdp")
    return p.reshape(3, 4)[:, :3].ravel() if is_rectified and p[0] > 0 else np.array([*k, *d])


def is_calibrated(message: Any, *, is_rectified: bool = False) -> bool:
    """Tell whether a CameraInfo has a lens: before calibration K is zero, or no number."""
    of_images = lens(message, is_rectified=is_rectified)
    return bool(of_images[0] > 0 and of_images[4] > 0 and np.isfinite(of_images).all())


def camera(message: Any, *, is_rectified: bool = False) -> Camera | None:
    """Return the camera of a CameraInfo, None if it is not calibrated.

    Raises InputError for a lens that OpenCV does not have.
    """
    if not is_calibrated(message, is_rectified=is_rectified):
        return None
    k, d = np.split(lens(message, is_rectified=is_rectified), [9])
    model = str(message.distortion_model)
    if d.any() and model not in ("plumb_bob", "rational_polynomial", ""):
        raise InputError(f"distortion model: got {model!r}, allowed: plumb_bob")
    distortion = (*d.tolist(), 0.0, 0.0, 0.0, 0.0, 0.0)[: max(5, len(d))]
    if len(distortion) not in (5, 8, 12, 14):
        raise InputError(f"distortion: got {len(d)} coefficients, allowed: 0 to 5, 8, 12 or 14")
    return Camera(
        size_wh=(int(message.width), int(message.height)),
        fx=float(k[0]),
        fy=float(k[4]),
        cx=float(k[2]),
        cy=float(k[5]),
        distortion=distortion,
    )


def coefficients(message: Any, letter: str) -> NDArray[np.float64]:
    """Return CameraInfo's `k` (9,), `d` (N,) or `p` (12,); they are `K`, `D` and `P` in ROS 1."""
    values = vars(message)
    return np.asarray(values.get(letter, values.get(letter.upper())), dtype=np.float64)


def transforms(message: Any) -> Iterator[FrameTransform]:
    """Yield the rigid transforms of a TFMessage; none of another message or None."""
    for entry in getattr(message, "transforms", ()):
        T_parent_child = transform(entry.transform.translation, entry.transform.rotation)
        if T_parent_child is not None:
            child = str(entry.child_frame_id).lstrip("/")
            yield FrameTransform(parent=frame_id(entry), child=child, T_parent_child=T_parent_child)


def transform(at: Any, turn: Any) -> Transform | None:
    """Return T (4, 4) [m] of a Point or Vector3 and a Quaternion, None if it is not rigid."""
    quat_xyzw = np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64)
    position = np.array([at.x, at.y, at.z], dtype=np.float64)
    norm = float(np.linalg.norm(quat_xyzw))
    if not np.isfinite(position).all() or not 0.5 < norm < 2.0:
        return None
    return se3.from_quat_xyzw(position, quat_xyzw)


def _encoding(message: Any) -> tuple[str, bool]:
    if message.__msgtype__ == "sensor_msgs/msg/CompressedImage":
        return str(message.format), True
    return str(message.encoding), False


def _compressed_bgr(data: bytes, encoding: str) -> NDArray[np.uint8] | None:
    """Return the image of a file's bytes; one of a Bayer pattern may be stored as its mosaic."""
    if encoding.startswith("bayer_") and encoding in _COLOR:
        stored = pixels.decode(data, cv2.IMREAD_UNCHANGED)
        if stored is not None and stored.ndim == 2 and stored.dtype == np.uint8:
            return _converted(stored, _COLOR[encoding][2])
    return pixels.decode_bgr(data)


def _converted(raw: NDArray[Any], conversion: int | None) -> NDArray[np.uint8] | None:
    try:
        image = raw if conversion is None else cv2.cvtColor(raw, conversion)
    except cv2.error:  # an odd width, of which YUV has none
        return None
    return pixels.locked(np.ascontiguousarray(image, dtype=np.uint8))


def _raw(message: Any, dtype: str, channels: int) -> NDArray[Any] | None:
    """Return an Image's rows (H, W) or (H, W, channels) in this machine's byte order."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * np.dtype(dtype).itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if height < 1 or width < 1 or step < row_bytes or data.size < step * height:
        return None
    rows = data[: step * height].reshape(height, step)[:, :row_bytes]
    order = ">" if message.is_bigendian else "<"
    values = np.ascontiguousarray(rows).view(order + dtype).astype(dtype, copy=False)
    return values.reshape(height, width, channels) if channels > 1 else values


def _integers(stored: NDArray[Any] | None, units: pixels.DepthUnits) -> NDArray[np.float32] | None:
    if stored is None:
        return None
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise InputError(
            f"depth image: expected one 16-bit channel, got {stored.dtype} {stored.shape}"
        )
    return units.of_integers(stored)


def _inverse_depth_m(stored: NDArray[Any], header: bytes) -> NDArray[np.float32]:
    """Return the depth [m] of compressedDepth's quantised inverse depth (0 stays missing)."""
    scale, offset = np.frombuffer(header, dtype="<f4", count=2, offset=4)
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = scale / (stored.astype(np.float32) - offset)
    return np.where(stored == 0, np.float32(0), metres).astype(np.float32)
