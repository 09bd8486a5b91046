"""Association of colour images with depth images and IMU samples."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.realsense.frames import DeviceFrame
from sceneslam.types.rig import Sensor

_PATIENCE_NS = 50_000_000  # longest time that an image waits for its depth
_MOST = 3  # images, and depth images, that wait
_MOST_SAMPLES = 1000  # IMU samples that wait for an image


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Paired:
    """A colour image with its depth and IMU samples."""

    stamp_ns: int
    image: DeviceFrame
    depth: DeviceFrame | None
    samples: tuple[tuple[int, DeviceFrame], ...]  # stamp [ns] and frame, since the previous image


class Pairing:
    """Pairs frames by their stamps on the run's time line."""

    def __init__(self, tolerance_ns: int) -> None:
        self._tolerance_ns = tolerance_ns
        self._images: deque[tuple[int, DeviceFrame]] = deque(maxlen=_MOST)
        self._depths: deque[tuple[int, DeviceFrame]] = deque(maxlen=_MOST)
        self._samples: deque[tuple[int, DeviceFrame]] = deque(maxlen=_MOST_SAMPLES)

    def add(self, frame: DeviceFrame, stamp_ns: int) -> None:
        """Add a frame."""
        held = {Sensor.IMAGE: self._images, Sensor.DEPTH: self._depths}
        held.get(frame.sensor, self._samples).append((stamp_ns, frame))

    def next(self, now_ns: int) -> Paired | None:
        """Return the oldest image when its depth has arrived or is overdue, else None."""
        if not self._images:
            return None
        stamp_ns, image = self._images[0]
        near = [one for one in self._depths if abs(one[0] - stamp_ns) <= self._tolerance_ns]
        is_past = any(one[0] > stamp_ns + self._tolerance_ns for one in self._depths)
        is_over = is_past or len(self._images) == _MOST
        if not near and not is_over and now_ns - image.arrived_ns < _PATIENCE_NS:
            return None
        self._images.popleft()
        depth = min(near, key=lambda one: abs(one[0] - stamp_ns))[1] if near else None
        samples = tuple(one for one in self._samples if one[0] <= stamp_ns)
        later = [one for one in self._samples if one[0] > stamp_ns]
        self._samples = deque(later, maxlen=_MOST_SAMPLES)
        return Paired(stamp_ns=stamp_ns, image=image, depth=depth, samples=samples)


def samples_of(paired: Paired, sensor: Sensor) -> NDArray[np.float64]:
    """Return samples (M, 4): time after the image [s], then x, y, z in the sensor's frame."""
    rows = []
    for stamp_ns, frame in paired.samples:
        if frame.sensor is sensor:
            v = frame.frame.as_motion_frame().get_motion_data()
            rows.append([(stamp_ns - paired.stamp_ns) * 1e-9, v.x, v.y, v.z])
    return np.array(rows, dtype=np.float64).reshape(-1, 4)
