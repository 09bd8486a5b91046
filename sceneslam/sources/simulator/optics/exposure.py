"""Automatic exposure: exposure time and gain of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.settings import ExposureSettings

_SETTLED = 200  # frames for convergence on the first view before the story begins


@dataclass(frozen=True, slots=True, kw_only=True)
class Shutter:
    """The exposure of one frame."""

    time_ratio: float = 1.0  # of the nominal time, at which white in unit light is white
    gain: float = 1.0
    motion_px: tuple[float, float] = (0.0, 0.0)  # of the image during the exposure


NOMINAL = Shutter()


def follow(
    greys: Sequence[NDArray[np.float32]], settings: ExposureSettings, rate_hz: float
) -> NDArray[np.float64]:
    """Return the exposure (N,), time ratio x gain, of each frame.

    `greys` are the frames' grey values at nominal exposure, without saturation. Each frame corrects
    the next one's exposure towards the target mean with the time constant `lag_s`.
    """
    if not settings.is_automatic:
        return np.ones(len(greys))
    least = settings.range_s[0] / settings.nominal_s
    most = settings.range_s[1] / settings.nominal_s * settings.gain_max
    share = 1.0 - np.exp(-1.0 / (settings.lag_s * rate_hz))
    exposure, exposures = 1.0, []
    for grey in (*[greys[0]] * _SETTLED, *greys):
        exposures.append(exposure)
        mean = float(np.minimum(grey * np.float32(np.sqrt(exposure)), 255.0).mean())
        wanted = exposure * (settings.target_grey / max(mean, 1.0)) ** 2
        exposure = float(np.clip(exposure * (wanted / exposure) ** share, least, most))
    return np.array(exposures[_SETTLED:])


def split(exposure: float, settings: ExposureSettings) -> tuple[float, float]:
    """Return (time ratio, gain): gain is used only beyond the longest exposure time."""
    longest = settings.range_s[1] / settings.nominal_s if settings.is_automatic else 1.0
    time_ratio = min(exposure, longest)
    return time_ratio, exposure / time_ratio
