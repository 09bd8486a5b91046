"""Exposures of a source's images, read from a file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import Source
from sceneslam.sources.changes.wrapped import Wrapped, check_sensor
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path, read_text
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

_COLUMNS = "`stamp_s exposure_s` or `stamp_s exposure_s gain`, the stamps rising, the rest above 0"
_APART_MAX_S = 1.0  # from an image to its line; longer, and the clocks differ or a line is missing


class ExposureTimes(Wrapped):
    """Assigns to every image the exposure that the file lists for the nearest stamp.

    A line of the file is `stamp_s exposure_s` or `stamp_s exposure_s gain`; `#` begins a comment.
    `reference_s` is the product of time and gain that counts as 1 (null: the median of the file).
    An image without a line within a second keeps the exposure that it has, which is a fault. Raises
    InputError if the file and the source's time span are apart.
    """

    def __init__(self, source: Source, path: str, reference_s: float | None) -> None:
        if reference_s is not None and not 0 < reference_s < np.inf:
            raise ConfigError("reference_s", reference_s, "seconds above 0, or null")
        check_sensor(source, Sensor.IMAGE, path=path)
        super().__init__(source)
        rows = _read(given_path(path))
        self._log = FaultLog()
        self._stamps_s = rows[:, 0]
        self._check_span(path)
        exposures_s = rows[:, 1:].prod(axis=1)
        self._ratios = exposures_s / (reference_s or float(np.median(exposures_s)))

    @property
    def faults(self) -> Sequence[str]:
        """Return the source's faults, and the number of images without an exposure."""
        return [*self._source.faults, *self._log.sentences()]

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations, images with their exposure."""
        self._log.clear()
        for observation in self._source:
            yield observation if observation.image_bgr is None else self._exposed(observation)

    def _exposed(self, observation: Observation) -> Observation:
        apart_s = np.abs(self._stamps_s - observation.stamp_ns * 1e-9)
        nearest = int(np.argmin(apart_s))
        if apart_s[nearest] > _APART_MAX_S:
            kind = f"image without an exposure within {_APART_MAX_S:g} s in effects.path"
            self._log.add(kind, at_stamp(observation.stamp_ns))
            return observation
        return replace(observation, exposure_ratio=float(self._ratios[nearest]))

    def _check_span(self, path: str) -> None:
        """Raise InputError if no line can belong to an image of the source's time span."""
        span = self.span
        if span is None:
            return
        start_s, end_s = span.start_ns * 1e-9, span.end_ns * 1e-9
        first_s, last_s = float(self._stamps_s[0]), float(self._stamps_s[-1])
        if first_s > end_s + _APART_MAX_S or last_s < start_s - _APART_MAX_S:
            raise InputError(
                f"exposures of {first_s:.3f} to {last_s:.3f} s and the recording, {start_s:.3f} to "
                f"{end_s:.3f} s, have no time in common: {path}"
            )


def _read(path: Path) -> NDArray[np.float64]:
    """Return (N, 2 or 3): stamp, exposure time and gain; raises InputError."""
    if not path.is_file():
        raise InputError(f"file of exposures not found: {path}")
    lines = [line.partition("#")[0].split() for line in read_text(path).splitlines()]
    try:
        rows = np.array([[float(word) for word in line] for line in lines if line])
    except ValueError as error:
        raise InputError(f"expected lines {_COLUMNS}: {path}") from error
    is_valid = rows.ndim == 2 and rows.shape[1] in (2, 3) and bool(np.isfinite(rows).all())
    if not is_valid or (rows[:, 1:] <= 0).any() or (np.diff(rows[:, 0]) < 0).any():
        raise InputError(f"expected lines {_COLUMNS}: {path}")
    return rows
