"""The band of heights from which a planar scan is made."""

from __future__ import annotations

from sceneslam.types.errors import ConfigError

_HALF_M = 0.15  # above and below the sensor


def checked_band(
    sensor_m: float, *, height_min_m: float | None, height_max_m: float | None, beams: int
) -> tuple[float, float]:
    """Return the limits [m] above `base`; a limit of None is 0.15 m from the sensor's height.

    Raises ConfigError if the band is empty or there are fewer than 2 beams.
    """
    low_m = sensor_m - _HALF_M if height_min_m is None else height_min_m
    high_m = sensor_m + _HALF_M if height_max_m is None else height_max_m
    if low_m >= high_m:
        raise ConfigError("height_max_m", high_m, f"above {low_m:g} m")
    if beams < 2:
        raise ConfigError("beams", beams, "2 or more")
    return low_m, high_m
