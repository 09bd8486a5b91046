"""Measurements of all sensors at one instant, and the answers to them: votes and poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform, hat

SWEEP_MAX_S = 0.5  # no planar laser turns slower
_GYRO_GAP_S = 0.1  # a turn rate is not extrapolated over a longer gap
UNSURE = "Unsure"  # the scene of a vote that could not be cast


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserScan:
    """One sweep of a planar laser, counter-clockwise."""

    stamp_ns: int  # of the middle of the sweep
    ranges_m: NDArray[np.float32]  # (N,); inf: no return within range; NaN: no measurement
    angle_min_rad: float
    angle_step_rad: float
    range_min_m: float
    range_max_m: float

    @property
    def angles_rad(self) -> NDArray[np.float32]:
        """Return the beams' angles (N,) [rad] in the laser frame."""
        count = np.arange(len(self.ranges_m), dtype=np.float32)
        return np.asarray(self.angle_min_rad + self.angle_step_rad * count, dtype=np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observation:
    """All measurements of a source at one stamp; None for a sensor without data.

    One observation gets one pose in the trajectory. Arrays are read-only.
    """

    stamp_ns: int
    image_bgr: NDArray[np.uint8] | None = None  # (H, W, 3)
    depth_m: NDArray[np.float32] | None = None  # (H, W), registered to the image, 0 = missing
    scan: LaserScan | None = None
    points_lidar: NDArray[np.float32] | None = None  # (N, 3) [m], lidar frame
    point_times_s: NDArray[np.float64] | None = None  # (N,) after stamp_ns, for deskewing
    T_odom_base: Transform | None = None  # wheel odometry: smooth, drifting frame `odom`
    gyro_base: NDArray[np.float64] | None = None  # (M, 4): t - stamp [s], rate [rad/s]
    accelerometer_base: NDArray[np.float64] | None = None  # (M, 4): t - stamp [s], specific force
    # [m/s^2]: (0, 0, 9.8) at rest on level ground
    exposure_ratio: float | None = None  # of the image: time x gain, over the source's reference

    def has(self, sensor: Sensor) -> bool:
        """Tell whether this observation holds a measurement of `sensor`."""
        return getattr(self, sensor.field) is not None

    def samples(self) -> Observation:
        """Return its gyro and accelerometer samples alone."""
        kept = {sensor.field: getattr(self, sensor.field) for sensor in Sensor if sensor.is_sampled}
        return Observation(stamp_ns=self.stamp_ns, **kept)

    def with_samples_of(self, *older: Observation) -> Observation:
        """Return this observation with the gyro and accelerometer samples of older ones, too."""
        joined: dict[str, NDArray[np.float64]] = {}
        for name in (sensor.field for sensor in Sensor if sensor.is_sampled):
            parts = [
                samples + np.array([(one.stamp_ns - self.stamp_ns) / 1e9, 0.0, 0.0, 0.0])
                for one in older
                if (samples := getattr(one, name)) is not None
            ]
            if parts:
                now = getattr(self, name)
                joined[name] = np.concatenate(parts if now is None else [*parts, now])
                joined[name].setflags(write=False)
        return replace(self, **joined) if joined else self  # type: ignore[arg-type]

    def turn_by_gyro(self, duration_s: float) -> NDArray[np.float64] | None:
        """Return the base's rotation vector (3,) [rad] over the last `duration_s`.

        None if the gyro has a gap of more than 0.1 s in it.
        """
        gyro = self.gyro_base
        if gyro is None or duration_s <= 0:
            return None
        gyro = gyro[(gyro[:, 0] > -duration_s) & (gyro[:, 0] <= 0)]
        if len(gyro) == 0 or not np.isfinite(gyro).all():
            return None
        times = np.concatenate([[-duration_s], gyro[:, 0], [0.0]])
        if np.diff(times).max() > _GYRO_GAP_S:
            return None
        rates = np.concatenate([gyro[:1, 1:], gyro[:, 1:], gyro[-1:, 1:]])
        turns_rad = 0.5 * (rates[:-1] + rates[1:]) * np.diff(times)[:, None]
        # Rotations about changing axes do not commute: the second term of Magnus' expansion (1954).
        swept = hat(np.cumsum(turns_rad, axis=0)[:-1]) @ turns_rad[1:, :, None]
        return np.asarray(turns_rad.sum(axis=0) + 0.5 * swept.sum(axis=0)[:, 0])


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneVote:
    """A detector's estimate of the scene of one observation."""

    stamp_ns: int
    scene: str  # one of the detector's scenes, or UNSURE
    value: float = float("nan")  # what the detector measured (grey mean, probability, ...)
    likelihoods: Mapping[str, float] | None = None  # scene -> P(measured | scene), up to a factor
    features: Mapping[str, float] | None = None  # all measured features, for figures; NaN: missing


class TrackingStatus(Enum):
    """The state of a module's tracking."""

    TRACKING = "tracking"
    DEGRADED = "degraded"  # a pose, but the measurements do not constrain every direction
    LOST = "lost"  # no pose for this observation; T_local_base is the last one that was tracked


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracking:
    """A module's answer to one observation."""

    stamp_ns: int
    T_local_base: Transform  # the paper's T_local
    status: TrackingStatus
    # (6, 6) of se3.log order [m, rad], base frame: relative to the module's map around the pose.
    covariance: NDArray[np.float64] | None = None
    # (6, 6), the same way: what the module knows of how far that map drifted since it began.
    map_covariance: NDArray[np.float64] | None = None
    quality_ratio: float = 1.0  # 0 (nothing matched) to 1
    inliers: int = 0  # measurements that agree with the pose
    revision: int = 0  # increases when the module corrects its past; the pose may then jump
    can_begin: bool = False  # of a LOST answer: the sensors show enough to begin a map here
