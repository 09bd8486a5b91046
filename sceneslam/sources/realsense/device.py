"""Access to a RealSense camera: device, streams and factory calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic_ns
from typing import Any

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray

from sceneslam.sources.realsense.alignment import DepthAligner
from sceneslam.sources.realsense.distortion import to_opencv
from sceneslam.sources.realsense.frames import DeviceFrame, Take, Wanted
from sceneslam.types.errors import InputError
from sceneslam.types.rig import Camera, Sensor

_STREAMS = {  # name in the SDK and requested format
    Sensor.IMAGE: (rs.stream.color, rs.format.bgr8),
    Sensor.DEPTH: (rs.stream.depth, rs.format.z16),
    Sensor.GYRO: (rs.stream.gyro, rs.format.motion_xyz32f),
    Sensor.ACCELEROMETER: (rs.stream.accel, rs.format.motion_xyz32f),
}
_VIDEO = (Sensor.IMAGE, Sensor.DEPTH)


def find_device(serial: str | None) -> Any:
    """Return the camera with that serial number, or the only one; raises InputError."""
    found = {one.get_info(rs.camera_info.serial_number): one for one in rs.context().devices}
    there = ", ".join(found) or "none"
    if serial is not None and serial not in found:
        raise InputError(f"no RealSense camera with serial number {serial}: connected is {there}")
    if not found:
        raise InputError("no RealSense camera is connected (USB 3, udev rules of librealsense)")
    if serial is None and len(found) > 1:
        raise InputError(f"source.serial: {len(found)} RealSense cameras are connected: {there}")
    return found[serial] if serial is not None else next(iter(found.values()))


class Device:
    """An open camera; after `start`, the SDK's threads deliver every measurement."""

    def __init__(self, device: Any, wanted: Wanted) -> None:
        self._sensors: dict[Sensor, Any] = {}  # the SDK's sensor of each
        self._profiles: dict[Sensor, Any] = {}
        for part in device.query_sensors():
            for sensor in _STREAMS:
                profile = _profile(part, sensor, wanted)
                if profile is not None:
                    self._sensors[sensor], self._profiles[sensor] = part, profile
        for sensor in _VIDEO:
            if sensor not in self._profiles:
                raise InputError(_missing(device, sensor, wanted))
        depth = self._sensors[Sensor.DEPTH]
        self._depth_scale_m = float(depth.get_option(rs.option.depth_units))
        if depth.supports(rs.option.emitter_enabled):
            depth.set_option(rs.option.emitter_enabled, float(wanted.is_emitting))
        self._alignment = DepthAligner()

    @property
    def sensors(self) -> frozenset[Sensor]:
        """Return the available sensors."""
        return frozenset(self._profiles)

    def camera(self) -> Camera:
        """Return the colour camera by its factory calibration, at the origin of `base`."""
        found = self._profiles[Sensor.IMAGE].as_video_stream_profile().get_intrinsics()
        return Camera(
            size_wh=(found.width, found.height),
            fx=found.fx,
            fy=found.fy,
            cx=found.ppx,
            cy=found.ppy,
            distortion=to_opencv(found),
        )

    def rotations(self) -> Mapping[Sensor, NDArray[np.float64]]:
        """Return the rotations R_cam_sensor (3, 3) of gyro and accelerometer."""
        colour = self._profiles[Sensor.IMAGE]
        return {
            sensor: np.array(profile.get_extrinsics_to(colour).rotation).reshape(3, 3).T
            for sensor, profile in self._profiles.items()
            if sensor not in _VIDEO
        }

    def start(self, take: Take) -> None:
        """Start all streams."""
        parts: dict[int, tuple[Any, list[Sensor]]] = {}
        for sensor, part in self._sensors.items():
            parts.setdefault(id(part), (part, []))[1].append(sensor)
        for part, sensors in parts.values():
            part.open([self._profiles[sensor] for sensor in sensors])
            part.start(_taker(take))

    def depth_m(self, depth: DeviceFrame, image: DeviceFrame) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] at a colour image's pixels, 0 = missing."""
        units = self._alignment.registered(depth.frame, image.frame)
        return units.astype(np.float32) * np.float32(self._depth_scale_m)

    def stop(self) -> None:
        """Stop all streams; errors of an unplugged camera are ignored."""
        for part in {id(part): part for part in self._sensors.values()}.values():
            try:
                part.stop()
                part.close()
            except RuntimeError:
                continue


def _taker(take: Take) -> Callable[[Any], None]:
    kinds = {stream: sensor for sensor, (stream, _) in _STREAMS.items()}

    def taken(frame: Any) -> None:
        arrived_ns = monotonic_ns()
        sensor = kinds.get(frame.get_profile().stream_type())
        if sensor is not None:
            frame.keep()
            stamp_ns = round(frame.get_timestamp() * 1e6)
            take(DeviceFrame(sensor=sensor, frame=frame, stamp_ns=stamp_ns, arrived_ns=arrived_ns))

    return taken


def _profile(part: Any, sensor: Sensor, wanted: Wanted) -> Any:
    """Return the requested stream (of an IMU the fastest), None if the camera lacks it."""
    stream, form = _STREAMS[sensor]
    found = [
        one for one in part.get_stream_profiles()
        if one.stream_type() == stream and one.format() == form
    ]  # fmt: skip
    if sensor in _VIDEO:
        sizes = ((one, one.as_video_stream_profile()) for one in found)
        found = [
            one for one, video in sizes
            if (video.width(), video.height()) == wanted.size_wh and one.fps() == wanted.rate_hz
        ]  # fmt: skip
    return max(found, key=lambda one: one.fps(), default=None)


def _missing(device: Any, sensor: Sensor, wanted: Wanted) -> str:
    """Return the error for a missing stream, with the camera's alternatives."""
    stream = _STREAMS[sensor][0]
    found = {
        (one.as_video_stream_profile().width(), one.as_video_stream_profile().height(), one.fps())
        for part in device.query_sensors()
        for one in part.get_stream_profiles()
        if one.stream_type() == stream
    }
    there = ", ".join(f"{w}x{h} at {fps} Hz" for w, h, fps in sorted(found)) or "no such stream"
    size = f"{wanted.size_wh[0]}x{wanted.size_wh[1]}"
    words = f"no {sensor.value} of {size} at {wanted.rate_hz} Hz"
    return f"source.size_wh, source.rate_hz: {words}; the camera has {there}"
