"""What is asked of a RealSense camera, and what it gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera, Sensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """Which streams are asked for."""

    size_wh: tuple[int, int]  # [px], of colour and depth
    rate_hz: int
    is_emitting: bool  # the laser pattern that makes bare walls measurable, also in the dark


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeviceFrame:
    """One measurement as it came."""

    sensor: Sensor
    frame: Any  # of pyrealsense2, kept
    stamp_ns: int  # the camera's, or this machine's where the SDK translates it
    arrived_ns: int  # CLOCK_MONOTONIC

    @property
    def topic(self) -> str:
        """Return the name of its stream."""
        return str(self.sensor.value)

    @property
    def size(self) -> int:
        """Return its bytes."""
        return int(self.frame.get_data_size())


Take = Callable[[DeviceFrame], None]


class OpenCamera(Protocol):
    """A camera that is open."""

    @property
    def sensors(self) -> frozenset[Sensor]:
        """Return what it measures."""
        ...

    def camera(self) -> Camera:
        """Return the colour camera as the factory calibrated it; its place is the optical frame."""
        ...

    def rotations(self) -> Mapping[Sensor, NDArray[np.float64]]:
        """Return, for gyro and accelerometer, R_cam_sensor (3, 3)."""
        ...

    def start(self, take: Take) -> None:
        """Begin to measure; `take` is called in threads of the camera's own."""
        ...

    def depth_m(self, depth: DeviceFrame, image: DeviceFrame) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] of an image's pixels, 0 where nothing was measured."""
        ...

    def stop(self) -> None:
        """Stop measuring."""
        ...
