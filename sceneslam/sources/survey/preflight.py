"""Checks before a run: one line per sensor, and warnings of implausible values.

The limits follow from the sensors' physics. They need not be exact, as a wrong unit causes an error
of a factor of five or more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import atan, degrees

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.bag.observation import PRIMARY
from sceneslam.sources.contract.odometer import SPEED_MAX_MPS
from sceneslam.sources.survey.survey import Stream, Survey
from sceneslam.types.rig import GRAVITY, Camera, Rig, Sensor

_IN_RANGE_MIN = 0.9  # share of depths in range; with wrong units, at most 0.74 in our recordings
_SCALES = (1000.0, 5000.0)  # units per metre in use: millimetres, and those of TUM
_FITS = 0.98  # share of depths in range that confirms a scale
_FIELD_OF_VIEW_DEG = (15.0, 150.0)  # of a pinhole camera, horizontal
_OFF_CENTRE = 0.25  # of the image's size; a principal point is within some per cent of the centre
_TURN_MAX_RADPS = 35.0  # gyros measure up to 2000 degrees per second
_FORCE_FACTOR = 2.0  # of the median force, which is gravity's: a robot rests or drives evenly
_RETURNS_MIN = 0.02  # share of beams with a return; less in open fields only
_UNUSED_MAX = 0.5  # share of scans: with fewer unused ones, every second is used
CLOCKS_APART_S = 1.0  # drivers deliver earlier; TAI, which PTP has, is 37 s ahead of UTC
_IMAGE_RATE_HZ = (0.5, 2000.0)  # below, images do not overlap; above, the stamps' unit is wrong


@dataclass(frozen=True, slots=True, kw_only=True)
class Preflight:
    """The report on a recording before its run."""

    lines: tuple[str, ...]  # one per sensor
    warnings: tuple[str, ...]  # sentences that name the key to check


def preflight(survey: Survey, rig: Rig) -> Preflight:
    """Return the report: a survey compared with the rig that the source declares."""
    camera = rig.camera
    warnings = [*_of_time(survey), *_of_pace(survey), *_of_pairs(survey)]
    if camera is not None:
        warnings += [*_of_lens(camera), *_of_depth(survey, camera)]
    warnings += [*_of_ranges(survey, rig), *_of_motion(survey), *_of_places(survey)]
    lines = [_line(stream, survey, camera) for stream in survey.streams]
    return Preflight(lines=tuple(lines), warnings=tuple(warnings))


def _line(stream: Stream, survey: Survey, camera: Camera | None) -> str:
    known = [f"{stream.sensor.value:8} {stream.place}: {stream.count} messages"]
    sampled: list[str] = []  # what a part of the messages tells
    rates = sampled if stream.is_sampled else known
    if stream.rate_hz is not None:
        rates.append(f"{stream.rate_hz:.3g} Hz")
    if len(stream.stamps_ns) > 1:
        first_s, last_s = stream.stamps_ns[[0, -1]] * 1e-9
        known.append(f"stamps {first_s:.3f} to {last_s:.3f} s")
    paired = survey.paired_ratio()
    if stream.sensor is Sensor.IMAGE and paired is not None:
        rates.append(f"{paired:.0%} with depth")
    if stream.sensor is Sensor.IMAGE and survey.assumed_camera:
        known.append(f"camera of {survey.assumed_camera}")
    if stream.sensor is Sensor.DEPTH and camera is not None and survey.depths_m:
        depths_m = _measured(survey.depths_m)
        median = f"{np.median(depths_m):.2f} m" if len(depths_m) else "none measured"
        sampled.append(f"median depth {median}")
    if stream.sensor is Sensor.SCAN and survey.scans:
        ranges_m = _returns(survey)
        share = len(ranges_m) / max(sum(len(scan.ranges_m) for scan in survey.scans), 1)
        sampled.append(f"{share:.0%} of beams return")
        sampled += [f"median range {np.median(ranges_m):.2f} m"] if len(ranges_m) else []
    if stream.sensor is Sensor.POINTS and survey.clouds:
        distances_m = _distances(survey.clouds)
        sampled += [f"median distance {np.median(distances_m):.1f} m"] if len(distances_m) else []
    return "; sampled: ".join(", ".join(parts) for parts in (known, sampled) if parts)


def _of_time(survey: Survey) -> Iterator[str]:
    """Yield warnings of stamps: wrong units, or clocks without a common time."""
    low_hz, high_hz = _IMAGE_RATE_HZ
    for stream in survey.streams:
        rate_hz = stream.rate_hz
        is_picture = stream.sensor in (Sensor.IMAGE, Sensor.DEPTH)
        if is_picture and rate_hz is not None and not low_hz <= rate_hz <= high_hz:
            yield (
                f"{stream.place}: {rate_hz:.3g} images per second are implausible; "
                "are the stamps in seconds?"
            )
    primary = survey.streams[0] if survey.streams else None
    for stream in survey.streams[1:]:
        if primary is None or not len(stream.stamps_ns) or not len(primary.stamps_ns):
            continue
        is_apart = (
            stream.stamps_ns[0] > primary.stamps_ns[-1]
            or stream.stamps_ns[-1] < primary.stamps_ns[0]
        )
        if is_apart:
            yield f"{stream.place} and {primary.place} have no time in common: {_spans(survey)}"
        elif stream.delay_s is not None and primary.delay_s is not None:
            ahead_s = primary.delay_s - stream.delay_s
            if abs(ahead_s) > CLOCKS_APART_S:
                yield (
                    f"the stamps of {stream.place} are {abs(ahead_s):.1f} s "
                    f"{'ahead of' if ahead_s > 0 else 'behind'} those of {primary.place}, judged "
                    "by when both were recorded: do their clocks agree?"
                )


def _spans(survey: Survey) -> str:
    spans = ((one, one.stamps_ns[[0, -1]] * 1e-9) for one in survey.streams if len(one.stamps_ns))
    return ", ".join(f"{one.place} {first:.3f} to {last:.3f} s" for one, (first, last) in spans)


def _of_pace(survey: Survey) -> Iterator[str]:
    """Yield warnings of scans and clouds most of which come between two observations.

    An observation has the last one before its image; while images are silent, each has its own.
    """
    ranked = [one for sensor in PRIMARY if (one := survey.stream(sensor)) is not None]
    pace_hz = ranked[0].rate_hz if ranked else None
    if pace_hz is None or survey.silent_after_s is None:
        return
    paced_ratio = min(1.0, survey.silent_after_s * pace_hz)
    for place, stream in enumerate(ranked[1:], start=1):
        if stream.sensor not in (Sensor.SCAN, Sensor.POINTS) or stream.rate_hz is None:
            continue
        unused = paced_ratio - pace_hz / stream.rate_hz
        if unused > _UNUSED_MAX:
            keys = " ".join(f"source.topics.{one.sensor.value}=none" for one in ranked[:place])
            yield (
                f"{stream.place}: about {unused:.0%} of its messages lie between those of "
                f"{ranked[0].place} and are not used: {keys} uses them"
            )


def _of_pairs(survey: Survey) -> Iterator[str]:
    """Yield a warning if images have no depth though there are enough depth images."""
    image, depth = survey.stream(Sensor.IMAGE), survey.stream(Sensor.DEPTH)
    paired = survey.paired_ratio()
    if image is None or depth is None or paired is None:
        return
    possible = min(1.0, depth.count / max(image.count, 1))
    if paired < 0.5 * possible:
        yield (
            f"only {paired:.0%} of the images have depth within source.sync_tolerance_s "
            f"{survey.sync_tolerance_s:g}: {apart(survey)}"
        )


def apart(survey: Survey) -> str:
    """Return the time between images and their depth as text, "" if one of them is missing."""
    apart_s = survey.apart_s()
    if not len(apart_s):
        return ""
    return f"the nearest depth image is {float(np.median(apart_s)):.3g} s away in the median"


def _of_lens(camera: Camera) -> Iterator[str]:
    """Yield warnings of intrinsics that do not fit the image size."""
    width, height = camera.size_wh
    fov_deg = degrees(2 * atan(0.5 * width / camera.fx)) if camera.fx > 0 else 0.0
    low_deg, high_deg = _FIELD_OF_VIEW_DEG
    if camera.fx != 1.0 and not low_deg <= fov_deg <= high_deg:  # 1.0: unknown
        yield (
            f"source.camera.fx {camera.fx:g} makes a field of view of {fov_deg:.0f} degrees in "
            f"images of {width}x{height}: is it of another resolution?"
        )
    off = max(abs(camera.cx / width - 0.5), abs(camera.cy / height - 0.5))
    if camera.fx != 1.0 and off > _OFF_CENTRE:
        yield (
            f"source.camera.cx, cy ({camera.cx:g}, {camera.cy:g}) are far from the centre of "
            f"images of {width}x{height}: are they of another resolution?"
        )


def _of_depth(survey: Survey, camera: Camera) -> Iterator[str]:
    """Yield a warning if depth is outside the camera's range: its unit is probably wrong."""
    if not survey.depths_m:
        return
    depths_m = _measured(survey.depths_m)
    if not len(depths_m):
        yield "no depth image that was looked at holds a depth"
        return
    share = float(camera.measures(depths_m).mean())
    if share >= _IN_RANGE_MIN:
        return
    low_m, high_m = camera.depth_range_m
    yield (
        f"only {share:.0%} of the measured depths lie within source.depth_range_m "
        f"[{low_m:g}, {high_m:g}], the median is {np.median(depths_m):.3g} m"
        f"{_better_scale(survey, camera, depths_m)}"
    )


def _better_scale(survey: Survey, camera: Camera, depths_m: NDArray[np.float32]) -> str:
    if survey.depth_scale is None:
        return ""
    said = f": is source.depth_scale {survey.depth_scale:g} right?"
    for scale in _SCALES:
        share = float(camera.measures(depths_m * np.float32(survey.depth_scale / scale)).mean())
        if scale != survey.depth_scale and share >= _FITS:
            return f"{said} With {scale:g} it would be {share:.0%}"
    return said


def _of_ranges(survey: Survey, rig: Rig) -> Iterator[str]:
    """Yield a warning if a laser or lidar has almost no returns within its range."""
    beams = sum(len(scan.ranges_m) for scan in survey.scans)
    returns = len(_returns(survey))
    if survey.scans and returns < _RETURNS_MIN * max(beams, 1):
        place = getattr(survey.stream(Sensor.SCAN), "place", "")
        longest_m = max(scan.range_max_m for scan in survey.scans)
        yield (
            f"{place}: {returns} of {beams} beams return within {longest_m:g} m; "
            "is the laser blocked, or its unit not the metre?"
        )
    if survey.clouds and rig.lidar is not None:
        low_m, high_m = rig.lidar.range_m
        distances_m = _distances(survey.clouds)
        share = (
            float(((distances_m >= low_m) & (distances_m <= high_m)).mean())
            if len(distances_m)
            else 0.0
        )
        if share < 0.5:
            place = getattr(survey.stream(Sensor.POINTS), "place", "")
            yield (
                f"{place}: only {share:.0%} of the points lie within the lidar's range "
                f"[{low_m:g}, {high_m:g}] m; is their unit the metre?"
            )


def _of_motion(survey: Survey) -> Iterator[str]:
    """Yield warnings of odometry and gyros faster than any robot, and of forces unlike gravity."""
    if survey.odometry_ns is not None and len(survey.T_odom_base) > 1:
        positions_m = np.stack([T[:3, 3] for T in survey.T_odom_base])
        steps_s = np.diff(survey.odometry_ns) * 1e-9
        steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
        speeds = steps_m[steps_s > 0] / steps_s[steps_s > 0]
        speed = float(np.percentile(speeds, 90)) if len(speeds) else 0.0
        if speed > SPEED_MAX_MPS:
            place = getattr(survey.stream(Sensor.ODOMETRY), "place", "")
            yield f"{place}: {speed:.3g} m/s are implausible; is its unit the metre?"
    if len(survey.gyro_radps):
        turn = float(np.abs(np.stack(survey.gyro_radps)).max())
        if turn > _TURN_MAX_RADPS:
            place = getattr(survey.stream(Sensor.GYRO), "place", "")
            yield f"{place}: {turn:.3g} rad/s are implausible; is its unit degrees?"
    if len(survey.forces_mps2):
        force = float(np.median(np.linalg.norm(np.stack(survey.forces_mps2), axis=1)))
        if not GRAVITY / _FORCE_FACTOR < force < GRAVITY * _FORCE_FACTOR:  # also for NaN
            place = getattr(survey.stream(Sensor.ACCELEROMETER), "place", "")
            yield (
                f"{place}: an acceleration of {force:.3g} m/s^2 in the median is implausible, as "
                f"gravity is {GRAVITY:g}; is its unit g, or gravity removed?"
            )


def _of_places(survey: Survey) -> Iterator[str]:
    """Yield warnings of sensors without a pose on the robot, and of topics without messages."""
    for frame in survey.unplaced:
        yield (
            f"no transform connects frame {frame!r} with the robot's base (source.base_frame): its "
            "sensor is taken to sit in base, a camera or optical frame to look along x"
        )
    yield from survey.odd
    for topic in survey.silent:
        yield f"{topic} is announced, but has no messages"


def _measured(depths_m: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return the valid depths (N,) [m] of every fourth row and column."""
    values = [depth_m[::4, ::4].ravel() for depth_m in depths_m]
    every = np.concatenate(values) if values else np.zeros(0, np.float32)
    return every[np.isfinite(every) & (every > 0)]


def _returns(survey: Survey) -> NDArray[np.float32]:
    values = [scan.ranges_m for scan in survey.scans]
    every = np.concatenate(values) if values else np.zeros(0, np.float32)
    return every[np.isfinite(every)]


def _distances(clouds: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    every = np.concatenate([points[::16] for points in clouds])
    distances_m = np.linalg.norm(every, axis=1)
    return np.asarray(distances_m[np.isfinite(distances_m) & (distances_m > 0)], np.float32)
