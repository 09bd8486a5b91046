"""Interface of a RealSense camera: requested streams and measured frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera, Sensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """The requested streams."""

    size_wh: tuple[int, int]  # [px], of colour and depth
    rate_hz: int
    is_emitting: bool  # projects the infrared pattern: depth on bare walls and in the dark


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeviceFrame:
    """One raw measurement."""

    sensor: Sensor
    frame: Any  # of pyrealsense2, kept alive
    stamp_ns: int  # camera's clock, or this machine's if the SDK converts it
    arrived_ns: int  # CLOCK_MONOTONIC

    @property
    def topic(self) -> str:
        """Return the name of its stream."""
        return str(self.sensor.value)

    @property
    def size(self) -> int:
        """Return its size [bytes]."""
        return int(self.frame.get_data_size())


Take = Callable[[DeviceFrame], None]


class OpenCamera(Protocol):
    """An open camera."""

    @property
    def sensors(self) -> frozenset[Sensor]:
        """Return the available sensors."""
        ...

    def camera(self) -> Camera:
        """Return the colour camera by its factory calibration, at the origin of `base`."""
        ...

    def rotations(self) -> Mapping[Sensor, NDArray[np.float64]]:
        """Return the rotations R_cam_sensor (3, 3) of gyro and accelerometer."""
        ...

    def start(self, take: Take) -> None:
        """Start all streams; `take` is called in the SDK's threads."""
        ...

    def depth_m(self, depth: DeviceFrame, image: DeviceFrame) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] at a colour image's pixels, 0 = missing."""
        ...

    def stop(self) -> None:
        """Stop all streams."""
        ...
