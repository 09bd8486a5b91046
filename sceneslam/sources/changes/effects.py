"""Changes of lighting, applied to the images of any source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.ros.pixels import locked
from sceneslam.sources.changes.dim_sensor import DimSensor
from sceneslam.sources.changes.light_schedule import LightSchedule, check_steps
from sceneslam.sources.changes.wrapped import Wrapped, check_sensor
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange

BRIGHT, DARK = "Bright", "Dark"
_DARK_BELOW = 0.5  # of the recorded light: a mean grey value of 130 becomes 95


class LightsOut(Wrapped):
    """Dims a source's colour images by a schedule; depth, actively lit, is not changed.

    `schedule` is a list of [time, level], the time in seconds from the first observation or, with
    `schedule_unit: ratio`, as share of the recording. Level 1 is the image as recorded, bit for
    bit; at level 0 the share `ambient_ratio` of the light is left. The true scene is Dark while the
    level is below a half. `lights` on or off holds the level at 1 or 0 throughout. Dimmed images
    carry their exposure, with the recording's as the reference.
    """

    def __init__(
        self,
        source: Source,
        schedule: list[Any],
        schedule_unit: str,
        lights: str,
        fade_s: float,
        ambient_ratio: float,
        full_well_electrons: float,
        read_noise_electrons: float,
        exposure_gain_max: float,
        seed: int,
    ) -> None:
        if schedule_unit not in ("ratio", "seconds"):
            raise ConfigError("schedule_unit", schedule_unit, "ratio or seconds")
        if lights not in ("story", "on", "off"):
            raise ConfigError("lights", lights, "story (the schedule), on or off")
        if not 0 <= fade_s < np.inf:
            raise ConfigError("fade_s", fade_s, "0 or more [s]")
        if not 0 <= ambient_ratio <= 1:
            raise ConfigError("ambient_ratio", ambient_ratio, "0 to 1")
        if seed < 0:
            raise ConfigError("seed", seed, "0 or more")
        steps = check_steps(schedule, is_ratio=schedule_unit == "ratio")
        if lights != "story":
            steps = [[0.0, 1.0 if lights == "on" else 0.0]]
        check_sensor(source, Sensor.IMAGE, lights=lights)
        super().__init__(source)
        self._ambient_ratio = ambient_ratio
        self._seed = seed
        self._sensor = DimSensor(
            full_well_electrons=full_well_electrons,
            read_noise_electrons=read_noise_electrons,
            gain_max=exposure_gain_max,
        )
        is_ratio = schedule_unit == "ratio" and len(steps) > 1
        unit_s = self._duration_s() if is_ratio else 1.0
        self._schedule = LightSchedule.of_steps(steps, unit_s=unit_s, fade_s=fade_s)

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations, dimmed."""
        start_ns: int | None = None
        for observation in self._source:
            start_ns = observation.stamp_ns if start_ns is None else start_ns
            yield self._dimmed(observation, (observation.stamp_ns - start_ns) * 1e-9)

    def ground_truth(self) -> GroundTruth | None:
        """Return the source's ground truth with the scenes that follow from the schedule."""
        truth = self._source.ground_truth()
        start_ns = self.start_ns()
        if start_ns is None:
            return truth
        before = truth.scenes if truth is not None else ()
        dark = [
            (start_ns + round(time_s * 1e9), is_dark)
            for time_s, is_dark in self._schedule.crossings(_DARK_BELOW)
        ]
        return GroundTruth(
            trajectory=truth.trajectory if truth is not None else Trajectory.empty(),
            scenes=_merge(before, dark),
        )

    def _dimmed(self, observation: Observation, time_s: float) -> Observation:
        level = self._schedule.level(time_s)
        light = self._ambient_ratio + (1.0 - self._ambient_ratio) * level
        if observation.image_bgr is None or light >= 1.0:
            return observation
        exposure_ratio = (observation.exposure_ratio or 1.0) * self._sensor.gain(light)
        rng = np.random.Generator(np.random.SFC64([self._seed, observation.stamp_ns % 2**64]))
        image_bgr = self._sensor.dim(observation.image_bgr, light, rng)
        return replace(observation, image_bgr=locked(image_bgr), exposure_ratio=exposure_ratio)

    def _duration_s(self) -> float:
        span = self.span
        if span is None:
            raise ConfigError(
                "schedule_unit", "ratio", "seconds, as this source does not know its duration"
            )
        return (span.end_ns - span.start_ns) * 1e-9


def _merge(
    scenes: Sequence[SceneChange], dark: Sequence[tuple[int, bool]]
) -> tuple[SceneChange, ...]:
    """Return the scenes: Dark while the light is off, else the source's, else Bright."""
    stamps_ns = sorted({change.stamp_ns for change in scenes} | {stamp for stamp, _ in dark})
    merged: list[SceneChange] = []
    for stamp_ns in stamps_ns:
        is_dark = [off for at_ns, off in dark if at_ns <= stamp_ns][-1:] == [True]
        known = [change.scene for change in scenes if change.stamp_ns <= stamp_ns]
        scene = DARK if is_dark else known[-1] if known else BRIGHT
        if not merged or merged[-1].scene != scene:
            merged.append(SceneChange(stamp_ns=stamp_ns, scene=scene))
    return tuple(merged)
