"""Simulation of less light on a recorded 8-bit image, with the sensor noise of that light.

The sRGB curve gives the light of a recorded value; white is `full_well_electrons` electrons. In
less light, the sensor counts fewer electrons, with Poisson distributed shot noise, and adds read
noise. Automatic exposure amplifies the signal up to its largest gain; the result has eight bits.
Only noise that the recording does not contain already is added: none at full light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError

_LEVELS = 256
_QUANTILES = 4096  # of the noise, per recorded value; 12 random bits select one
_GAUSS_FROM = 25.0  # electrons; above, the Poisson distribution is approximated by a Gaussian
_SMALLEST_SIGMA = 1e-3  # electrons
_RARE = 1e-6  # probability that is neglected: far less than one quantile


class DimSensor:
    """A camera's sensor as a look-up table: for each recorded value, the possible new values."""

    def __init__(
        self, *, full_well_electrons: float, read_noise_electrons: float, gain_max: float
    ) -> None:
        if not 100 <= full_well_electrons <= 1e6:
            raise ConfigError("full_well_electrons", full_well_electrons, "100 to 1e6")
        if not 0 <= read_noise_electrons <= 1000:
            raise ConfigError("read_noise_electrons", read_noise_electrons, "0 to 1000")
        if not 1 <= gain_max <= 1000:
            raise ConfigError("exposure_gain_max", gain_max, "1 (fixed exposure) to 1000")
        self._full_well = full_well_electrons
        self._read_noise = read_noise_electrons
        self._gain_max = gain_max
        self._light = 1.0
        self._table = np.zeros(0, np.uint8)

    def dim(
        self, image_bgr: NDArray[np.uint8], light: float, rng: np.random.Generator
    ) -> NDArray[np.uint8]:
        """Return the BGR image (H, W, 3) with the fraction `light` (0 to 1) of its light."""
        if light != self._light:
            self._light, self._table = light, self._make_table(light)
        noise = np.frombuffer(rng.bytes(2 * image_bgr.size), dtype="<u2")
        index = image_bgr.astype(np.int32).ravel()
        index <<= 12
        index |= noise >> 4
        return np.take(self._table, index).reshape(image_bgr.shape)

    def gain(self, light: float) -> float:
        """Return the gain of automatic exposure at the fraction `light` (0 to 1) of the light."""
        return min(self._gain_max, 1.0 / light) if light > 0 else self._gain_max

    def _make_table(self, light: float) -> NDArray[np.uint8]:
        """Return (256 * 4096,): the new values of each recorded value, by rising quantile."""
        gain = self.gain(light)
        values = np.arange(_LEVELS)
        electrons = srgb_to_linear(values / 255.0) * self._full_well * light
        # limits[k]: number of electrons below which the new value is at most k.
        limits = srgb_to_linear((values[:-1] + 0.5) / 255.0) * self._full_well / gain
        added = electrons * (1.0 - light)  # missing variance of shot noise
        sigma = max(self._read_noise * np.sqrt(1.0 - light**2), _SMALLEST_SIGMA)
        # below[v, k]: probability that recorded value v becomes at most k.
        below = np.empty((_LEVELS, _LEVELS))
        below[:, -1] = 1.0
        is_small = added < _GAUSS_FROM
        large = ~is_small
        spread = np.sqrt(added[large] + sigma**2)[:, None]
        below[large, :-1] = _gauss_cdf((limits - electrons[large, None]) / spread)
        below[is_small, :-1] = _poisson_cdf(
            limits - (electrons - added)[is_small, None], added[is_small], sigma
        )
        # Each new value gets a number of quantiles proportional to its probability.
        edges = np.rint(np.maximum.accumulate(below, axis=1) * _QUANTILES).astype(np.int64)
        counts = np.diff(edges, axis=1, prepend=0)
        return np.repeat(np.tile(values.astype(np.uint8), _LEVELS), counts.ravel())


def srgb_to_linear(srgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return linear light (...) of sRGB values (...), both 0 to 1 (IEC 61966-2-1)."""
    return np.asarray(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4))


def _poisson_cdf(
    limits: NDArray[np.float64], mean: NDArray[np.float64], sigma: float
) -> NDArray[np.float64]:
    """Return P(N + G < limit), (V, L), for Poisson counts N with V means and Gaussian noise G.

    `limits` (V, L) rise along L; those with negligible probability are not computed.
    """
    below = np.ones_like(limits)
    if not len(mean):
        return below
    # Six standard deviations above the largest mean, all probabilities are 1.
    most = float(mean.max() + 6.0 * np.sqrt(mean.max()) + 6.0 * sigma + 6.0)
    columns = int(np.count_nonzero(limits.min(axis=0) < most))
    near = limits[:, :columns]
    total = np.zeros_like(near)
    share, rest = np.exp(-mean), np.ones_like(mean)  # P(N = count), P(N >= count)
    # P(N + G < limit) = sum over counts of P(N = count) P(G < limit - count).
    count = 0
    while rest.max() > _RARE:
        total += share[:, None] * _gauss_cdf((near - count) / sigma)
        rest = rest - share
        count += 1
        share = share * mean / count
    below[:, :columns] = total
    return below


def _gauss_cdf(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normal distribution's integral within 1e-7 (Abramowitz and Stegun 26.2.17)."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(x))
    tail = np.exp(-0.5 * np.minimum(np.abs(x), 38.0) ** 2) / np.sqrt(2.0 * np.pi)
    tail *= t * (
        0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429)))
    )
    return np.asarray(np.where(x >= 0, 1.0 - tail, tail))
