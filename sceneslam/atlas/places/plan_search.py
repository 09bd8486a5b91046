"""Search the possible poses of a small floor plan in another, at any heading.

Correlative search (Olson, "Real-time correlative scan matching", ICRA 2009) over all shifts at
once: for every heading, one multiplication in the frequency domain. The score of a pose is the mean
over the walls of the other plan's value there: 1 on a wall, 0 unknown, -1 free.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import CELL_M
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.types import planar
from sceneslam.types.planar import Planar

_FACTOR = 3  # search cells are 0.15 m: the refinement converges from twice that
_PER_HEADING = 6  # peaks
_APART_M, _APART_RAD = 0.4, 0.2  # nearer peaks are merged
_RADIUS_MIN_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Peak:
    """A candidate pose with its score."""

    T_target_query: Planar
    score: float  # -1 to 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SearchWindow:
    """The poses to search."""

    around: Planar  # T_target_query
    half_m: float
    half_rad: float


class PlanSearch:
    """Searches one target; reuse it, as it caches the target's Fourier transform."""

    def __init__(self, field: PlanField) -> None:
        self._cell_m = _FACTOR * CELL_M
        self._origin = field.origin_xy_m
        rows, columns = (-(-size // _FACTOR) for size in field.likelihood.shape)
        padded = np.full((rows * _FACTOR, columns * _FACTOR), 0.0, np.float32)
        padded[: field.likelihood.shape[0], : field.likelihood.shape[1]] = field.likelihood
        blocks = padded.reshape(rows, _FACTOR, columns, _FACTOR)
        self._image = blocks.max(axis=(1, 3))
        self._spectra: dict[tuple[int, int], NDArray[np.complex128]] = {}

    def find(
        self,
        points: NDArray[np.float64],
        window: SearchWindow | None,
        *,
        score_min: float,
        most: int,
    ) -> list[Peak]:
        """Return up to `most` peaks, best first, of wall points (N, 2) of the query's frame."""
        centre = points.mean(axis=0)
        near = points - centre
        radius_m = max(float(np.sqrt((near**2).sum(axis=1).mean())), _RADIUS_MIN_M)
        yaws = _headings(window, self._cell_m / radius_m)
        reach = int(np.ceil(np.linalg.norm(near, axis=1).max() / self._cell_m)) + 1
        shape = tuple(cv2.getOptimalDFTSize(size + 2 * reach + 1) for size in self._image.shape)
        spectrum = self._spectrum(shape)
        found: list[Peak] = []
        for yaw in yaws.tolist():
            turned = near @ planar.rotation(yaw).T
            scores = self._correlate(spectrum, turned, shape, reach)
            found += self._peaks(scores, yaw, centre, window, score_min)
        return _apart(sorted(found, key=lambda peak: -peak.score), most)

    def _spectrum(self, shape: tuple[int, ...]) -> NDArray[np.complex128]:
        if shape not in self._spectra:
            self._spectra = {shape: np.fft.rfft2(self._image, shape)}  # type: ignore[dict-item]
        return self._spectra[shape]  # type: ignore[index]

    def _correlate(
        self,
        spectrum: NDArray[np.complex128],
        turned: NDArray[np.float64],
        shape: tuple[int, ...],
        reach: int,
    ) -> NDArray[np.float64]:
        """Return the mean value under the points, per cell of their centre."""
        cells = np.floor(turned / self._cell_m + 0.5).astype(np.int64) + reach
        flat = cells[:, 1] * shape[1] + cells[:, 0]
        count = np.bincount(flat, minlength=shape[0] * shape[1])
        image = count.reshape(shape) / len(turned)
        scores = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(image)), shape)
        rows, columns = self._image.shape
        rolled = np.roll(scores, (reach, reach), axis=(0, 1))
        return np.asarray(rolled[:rows, :columns])

    def _peaks(
        self,
        scores: NDArray[np.float64],
        yaw_rad: float,
        centre: NDArray[np.float64],
        window: SearchWindow | None,
        score_min: float,
    ) -> list[Peak]:
        highest = cv2.dilate(scores, np.ones((5, 5), np.uint8))
        rows, columns = np.nonzero((scores >= highest - 1e-9) & (scores >= score_min))
        centres = self._origin + (np.column_stack([columns, rows]) + 0.5) * self._cell_m
        shifts = centres - planar.rotation(yaw_rad) @ centre
        values = scores[rows, columns]
        if window is not None:
            inside = np.abs(shifts - window.around[:2]).max(axis=1, initial=0.0) <= window.half_m
            shifts, values = shifts[inside], values[inside]
        order = np.argsort(-values, kind="stable")[:_PER_HEADING]
        return [
            Peak(
                T_target_query=np.array([*shifts[row], planar.wrap(yaw_rad)]),
                score=float(values[row]),
            )
            for row in order.tolist()
        ]


def _headings(window: SearchWindow | None, step_rad: float) -> NDArray[np.float64]:
    if window is None or window.half_rad >= np.pi:
        count = int(np.ceil(2 * np.pi / step_rad))
        return np.asarray(np.arange(count) * (2 * np.pi / count))
    count = int(np.ceil(window.half_rad / step_rad))
    return np.asarray(window.around[2] + np.arange(-count, count + 1) * step_rad)


def _apart(peaks: list[Peak], most: int) -> list[Peak]:
    """Return the best peaks, at most one per neighbourhood."""
    kept: list[Peak] = []
    for peak in peaks:
        if len(kept) == most:
            break
        if all(is_apart(peak.T_target_query, other.T_target_query) for other in kept):
            kept.append(peak)
    return kept


def is_apart(first: Planar, second: Planar) -> bool:
    """Tell whether two poses (3,) differ by more than the accuracy of the search."""
    away_m = float(np.hypot(*(first - second)[:2]))
    return away_m > _APART_M or abs(planar.wrap(float(first[2] - second[2]))) > _APART_RAD
