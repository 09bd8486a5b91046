"""Contents of a recording by a few samples, taken before a run in about a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform

Stamps = NDArray[np.int64]

_FEWEST_PAIRED = 4  # sampled images: one or two without depth are no rule


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stream:
    """The measurements of one sensor."""

    sensor: Sensor
    place: str  # topic or file
    count: int  # in the whole recording
    stamps_ns: Stamps  # (N,) rising; all, or the first, the last and the sampled ones
    sampled_ns: Sequence[Stamps] = ()  # (M,) rising, of each sampled time span
    delay_s: float | None = None  # median from stamps to recording, between two clocks; if known

    @property
    def is_sampled(self) -> bool:
        """Tell whether stamps between the first and the last are missing."""
        return bool(self.sampled_ns) and len(self.stamps_ns) < self.count

    @property
    def rate_hz(self) -> float | None:
        """Return the rate by the median period, None for fewer than two measurements."""
        spans_ns = self.sampled_ns if self.is_sampled else [self.stamps_ns]
        periods_ns = np.concatenate([np.diff(span_ns) for span_ns in spans_ns])
        periods_ns = periods_ns[periods_ns > 0]
        return 1e9 / float(np.median(periods_ns)) if len(periods_ns) else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """Streams and samples of their contents; fields a source does not have are empty."""

    streams: Sequence[Stream]
    sync_tolerance_s: float | None = None  # between an image and its depth
    silent_after_s: float | None = None  # then another sensor sets the pace; None: each has its own
    depth_scale: float | None = None  # units per metre; None where depth is stored in metres
    assumed_camera: str = ""  # whose intrinsics were assumed, "" where they are the recording's own
    depths_m: Sequence[NDArray[np.float32]] = ()  # (H, W), also out of range; 0 = missing
    scans: Sequence[LaserScan] = ()
    clouds: Sequence[NDArray[np.float32]] = ()  # (N, 3) [m]
    odometry_ns: Stamps | None = None  # (N,) stamps of ...
    T_odom_base: Sequence[Transform] = ()  # ... these N poses
    gyro_radps: Sequence[NDArray[np.float64]] = ()  # (3,) each
    forces_mps2: Sequence[NDArray[np.float64]] = ()  # (3,) each, of the accelerometer
    unplaced: Sequence[str] = ()  # frames of sensors that no transform connects with the base
    odd: Sequence[str] = ()  # sentences about who publishes, and what is assumed
    silent: Sequence[str] = ()  # announced topics without a message

    def stream(self, sensor: Sensor) -> Stream | None:
        """Return a sensor's stream, None where the recording has none."""
        return next((one for one in self.streams if one.sensor is sensor), None)

    def apart_s(self) -> NDArray[np.float64]:
        """Return the time (N,) [s] between each image and the depth image nearest in time.

        In a sample, only images between two depth images count: others may have their depth
        outside of the sample.
        """
        image, depth = self.stream(Sensor.IMAGE), self.stream(Sensor.DEPTH)
        if image is None or depth is None or not len(depth.stamps_ns):
            return np.zeros(0)
        if not depth.is_sampled:
            return _apart_s(image.stamps_ns, depth.stamps_ns)
        spans_ns = zip(image.sampled_ns, depth.sampled_ns, strict=True)
        return np.concatenate([_apart_s(_between(*span), span[1]) for span in spans_ns])

    def paired_ratio(self) -> float | None:
        """Return the share of images with depth within the tolerance.

        None where unknown, or where fewer than four sampled images count.
        """
        apart_s, depth = self.apart_s(), self.stream(Sensor.DEPTH)
        fewest = _FEWEST_PAIRED if depth is not None and depth.is_sampled else 1
        if len(apart_s) < fewest or self.sync_tolerance_s is None:
            return None
        return float((apart_s <= self.sync_tolerance_s).mean())


def _between(image_ns: Stamps, depth_ns: Stamps) -> Stamps:
    """Return the images' stamps (N,) from the first depth image's on, before the last one's."""
    if not len(depth_ns):
        return image_ns[:0]
    return np.asarray(image_ns[(image_ns >= depth_ns[0]) & (image_ns < depth_ns[-1])])


def _apart_s(image_ns: Stamps, depth_ns: Stamps) -> NDArray[np.float64]:
    after = np.searchsorted(depth_ns, image_ns)
    near = np.clip(np.stack([after - 1, after]), 0, len(depth_ns) - 1)
    return np.asarray(np.abs(depth_ns[near] - image_ns).min(axis=0) * 1e-9)


@runtime_checkable
class Surveyed(Protocol):
    """A source that can be surveyed before a run."""

    def survey(self) -> Survey | None:
        """Return the survey, None if unknown; reads a few time spans only."""
        ...


def spread(count: int, samples: int) -> list[int]:
    """Return at most `samples` indices below `count`, evenly from the first to the last."""
    return sorted({round(at) for at in np.linspace(0, count - 1, min(count, samples))})
