"""Exposures of a source's images, read from a file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import Source
from sceneslam.sources.changes.wrapped import Wrapped, check_sensor
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.input_files import given_path, read_text
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

_COLUMNS = "`stamp_s exposure_s` or `stamp_s exposure_s gain`, the stamps rising, the rest above 0"


class ExposureTimes(Wrapped):
    """Assigns to every image the exposure that the file lists for the nearest stamp.

    A line of the file is `stamp_s exposure_s` or `stamp_s exposure_s gain`; `#` begins a comment.
    `reference_s` is the product of time and gain that counts as 1 (null: the median of the file).
    """

    def __init__(self, source: Source, path: str, reference_s: float | None) -> None:
        if reference_s is not None and not 0 < reference_s < np.inf:
            raise ConfigError("reference_s", reference_s, "seconds above 0, or null")
        check_sensor(source, Sensor.IMAGE, path=path)
        super().__init__(source)
        rows = _read(given_path(path))
        self._stamps_s = rows[:, 0]
        exposures_s = rows[:, 1:].prod(axis=1)
        self._ratios = exposures_s / (reference_s or float(np.median(exposures_s)))

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations, images with their exposure."""
        for observation in self._source:
            if observation.image_bgr is None:
                yield observation
            else:
                yield replace(observation, exposure_ratio=self._ratio(observation.stamp_ns * 1e-9))

    def _ratio(self, stamp_s: float) -> float:
        return float(self._ratios[int(np.argmin(np.abs(self._stamps_s - stamp_s)))])


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
