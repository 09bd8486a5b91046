"""A RealSense camera, live: colour, depth registered to it, gyro and accelerometer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from time import monotonic_ns

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros.pixels import locked
from sceneslam.sources.intrinsics import checked_above_zero, checked_range_m
from sceneslam.sources.live.clock import StampOrder
from sceneslam.sources.live.inbox import Inbox
from sceneslam.sources.live.measuring import Measuring
from sceneslam.sources.live.streams import Streams
from sceneslam.sources.realsense.frames import DeviceFrame, OpenCamera, Wanted
from sceneslam.sources.realsense.pairing import Paired, Pairing, samples_of
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError, text_of
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor, optical_to_rep103

_TICK_S = 0.1  # interval of checks for silent streams


class RealSense(Measuring):
    """Gives one observation per colour image, with the depth of the same instant.

    A camera that gives no images, or is unplugged, is reopened as soon as it is available. `mount`
    is its pose in `base`: `xyz_m`, and `rpy_rad`, zero for a camera that looks along x of `base`.
    """

    def __init__(
        self,
        serial: str | None,
        size_wh: list[int],
        rate_hz: int,
        emitter: bool,
        depth_range_m: list[float],
        mount: Mapping[str, Sequence[float]],
        silent_after_s: float,
    ) -> None:
        super().__init__()
        if len(size_wh) != 2:
            raise ConfigError("size_wh", size_wh, "[width, height] [px]")
        checked_above_zero("rate_hz", rate_hz)
        checked_above_zero("silent_after_s", silent_after_s)
        self._T_base_cam = _mounted(mount) @ optical_to_rep103()
        self._depth_range_m = checked_range_m("depth_range_m", depth_range_m)
        self._opener = _opener()
        self._serial = None if serial is None else str(serial)
        self._wanted = Wanted(
            size_wh=(size_wh[0], size_wh[1]), rate_hz=rate_hz, is_emitting=emitter
        )
        self._silent_after_s = silent_after_s
        self._tolerance_ns = round(0.5e9 / rate_hz)
        self._waiting: Inbox[DeviceFrame] = Inbox()
        self._device: OpenCamera | None = None
        self._faults: list[str] = []

    @property
    def rig(self) -> Rig:
        """Return the camera's sensors; opens the camera at the first call. Raises InputError."""
        if self._device is None:
            self._device = self._opener(self._serial, self._wanted)
            camera = replace(
                self._device.camera(),
                depth_range_m=self._depth_range_m,
                T_base_cam=self._T_base_cam,
            )
            self._rig = Rig(sensors=self._device.sensors, camera=camera)
        return self._rig

    @property
    def faults(self) -> Sequence[str]:
        """Return the reason if the camera could not be reopened."""
        return tuple(self._faults)

    def close(self) -> None:
        """Stop the camera and end the iteration."""
        self._waiting.close()
        if self._device is not None:
            self._device.stop()

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations as they arrive, until `close`."""
        topics = {sensor: sensor.value for sensor in self.rig.sensors}
        streams = self._streams = Streams(topics, self._silent_after_s, monotonic_ns())
        device = self._device
        assert device is not None, "rig opened it"
        pairing = Pairing(self._tolerance_ns)
        device.start(self._waiting.put)
        stamp_ns, seen_ns = 0, monotonic_ns()
        while not self._waiting.is_closed:
            frame = self._waiting.take(_TICK_S)
            if frame is not None:
                if frame.sensor is Sensor.IMAGE:
                    seen_ns = frame.arrived_ns
                lined = self._clock.line_up(frame.topic, frame.stamp_ns, frame.arrived_ns)
                streams.hear(frame.topic, lined, frame.arrived_ns)
                if lined.order is not StampOrder.UNORDERED:
                    stamp_ns = lined.stamp_ns
                    pairing.add(frame, stamp_ns)
            now_ns = monotonic_ns()
            paired = pairing.next(now_ns)
            if paired is not None:
                yield self._observation(paired, device)
            streams.look(now_ns, stamp_ns)
            streams.drop(self._waiting.take_dropped(), now_ns, stamp_ns)
            if now_ns - seen_ns > self._silent_after_s * 1e9 and not self._waiting.is_closed:
                device = self._device = self._reopened(device)
                seen_ns = monotonic_ns()

    def _reopened(self, device: OpenCamera) -> OpenCamera:
        """Return the reopened camera; the old one if it is not available."""
        device.stop()
        try:
            found = self._opener(self._serial, self._wanted)
            found.start(self._waiting.put)
        except (InputError, RuntimeError) as error:
            self._faults[:] = [f"the camera could not be opened again: {text_of(error)}"]
            return device
        self._faults.clear()
        return found

    def _observation(self, paired: Paired, device: OpenCamera) -> Observation:
        """Return the observation of paired frames; vectors are in `base`."""
        camera, depth_m, image = self._rig.camera, None, paired.image
        if paired.depth is not None and camera is not None:
            depth_m = device.depth_m(paired.depth, image)
            depth_m[~camera.measures(depth_m)] = 0.0
            depth_m = locked(depth_m)
        return Observation(
            stamp_ns=paired.stamp_ns,
            image_bgr=locked(np.array(image.frame.get_data())),
            depth_m=depth_m,
            gyro_base=self._in_base(paired, Sensor.GYRO, device),
            accelerometer_base=self._in_base(paired, Sensor.ACCELEROMETER, device),
        )

    def _in_base(
        self, paired: Paired, sensor: Sensor, device: OpenCamera
    ) -> NDArray[np.float64] | None:
        """Return IMU samples (N, 4): time [s], then x, y, z in `base`; None without samples."""
        rows = samples_of(paired, sensor)
        if not len(rows):
            return None
        R_base_sensor = self._T_base_cam[:3, :3] @ device.rotations()[sensor]
        rows[:, 1:] = rows[:, 1:] @ R_base_sensor.T
        return locked(rows)


def _opener() -> Callable[[str | None, Wanted], OpenCamera]:
    """Return the function that opens a camera; raises ConfigError without pyrealsense2."""
    try:
        from sceneslam.sources.realsense.device import Device, find_device
    except ImportError as error:
        allowed = f"pyrealsense2, installed: pip install 'sceneslam[realsense]' ({text_of(error)})"
        raise ConfigError("_target_", "RealSense", allowed) from error
    return lambda serial, wanted: Device(find_device(serial), wanted)


def _mounted(mount: Mapping[str, Sequence[float]]) -> NDArray[np.float64]:
    """Return T_base_camera (4, 4) [m] of a mount."""
    for key, value in mount.items():
        is_triple = isinstance(value, list | tuple) and len(value) == 3
        if key not in ("xyz_m", "rpy_rad") or not is_triple or not np.isfinite(value).all():
            raise ConfigError(f"mount.{key}", value, "xyz_m and rpy_rad, three numbers each")
    roll, pitch, yaw = mount.get("rpy_rad", (0.0, 0.0, 0.0))
    turns = [np.array([0.0, 0.0, yaw]), np.array([0.0, pitch, 0.0]), np.array([roll, 0.0, 0.0])]
    rotation = se3.so3_exp(turns[0]) @ se3.so3_exp(turns[1]) @ se3.so3_exp(turns[2])
    return se3.from_parts(rotation, np.array(mount.get("xyz_m", (0.0, 0.0, 0.0)), float))
