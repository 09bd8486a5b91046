"""Evaluation of votes on examples: confusion matrix, calibration, and wrongly classified images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.scenes.train import Judged
from sceneslam.types.errors import InputError

_BINS = (0.0, 0.5, 0.7, 0.9, 0.99)  # lower limits of the probability bins
_SHOWN = 48  # images on a sheet, by decreasing probability
_COLUMNS = 6
_CELL_WH = (160, 150)  # an image with its two lines of text [px]


def table(judged: Sequence[Judged]) -> Iterator[str]:
    """Yield lines of text: each example's share of correct votes, confusion matrix, calibration."""
    if not judged:
        return
    width = max(len(one.seen.example.name) for one in judged)
    for one in judged:
        right = 100.0 * one.is_right.mean()
        example = one.seen.example
        yield f"{example.scene:12} {example.name:{width}} {len(one.scores):5} {right:6.1f} % right"
    votes = np.concatenate([one.is_right for one in judged])
    yield f"all {len(votes)} images: {100.0 * votes.mean():.1f} % right"
    yield from _confusion(judged)
    yield from _calibration(judged)


def write_sheet(judged: Sequence[Judged], path: Path) -> int:
    """Write one sheet of wrongly classified images; return their number.

    Raises InputError if it cannot be written.
    """
    wrong = [
        (float(probability), one, place, image)
        for one in judged
        for place, (probability, image) in enumerate(
            zip(one.probabilities.max(axis=1), one.seen.thumbnails, strict=True)
        )
        if not one.is_right[place] and image is not None
    ]
    wrong.sort(key=lambda entry: -entry[0])
    if not wrong:
        path.unlink(missing_ok=True)  # sheet of an earlier test
        return 0
    cells = [_cell(*entry) for entry in wrong[:_SHOWN]]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % _COLUMNS)
    rows = [np.hstack(cells[at : at + _COLUMNS]) for at in range(0, len(cells), _COLUMNS)]
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), np.vstack(rows)):
        raise InputError(f"--sheet: got {path}, which could not be written")
    return len(wrong)


def _confusion(judged: Sequence[Judged]) -> Iterator[str]:
    true = [one.seen.example.scene for one in judged]
    scenes = judged[0].scenes
    yield f"{'true, voted':12}" + "".join(f"{scene:>12}" for scene in scenes)
    for scene in dict.fromkeys(true):
        votes = np.concatenate([one.votes for one in judged if one.seen.example.scene == scene])
        yield f"{scene:12}" + "".join(f"{np.count_nonzero(votes == to):12}" for to in scenes)


def _calibration(judged: Sequence[Judged]) -> Iterator[str]:
    """Yield the share of correct votes per probability bin; all examples have the same weight."""
    top = np.concatenate([one.probabilities.max(axis=1) for one in judged])
    right = np.concatenate([one.is_right for one in judged])
    weights = np.concatenate([np.full(len(one.scores), 1 / len(one.scores)) for one in judged])
    yield "probability       images   mean   right"
    for low, high in zip(_BINS, (*_BINS[1:], 1.0 + 1e-9), strict=True):
        inside = (top >= low) & (top < high)
        if inside.any():
            mean, share = (np.average(x[inside], weights=weights[inside]) for x in (top, right))
            span = f"{low:.2f} to {min(high, 1.0):.2f}"
            yield f"{span:16} {inside.sum():7} {100 * mean:5.1f} % {100 * share:5.1f} %"


def _cell(
    probability: float, one: Judged, place: int, thumbnail: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Return a thumbnail with its true and its estimated scene below."""
    width, height = _CELL_WH
    cell = np.full((height, width, 3), 255, np.uint8)
    image = thumbnail[: height - 30]
    cell[: image.shape[0], : image.shape[1]] = image
    texts = (
        f"{one.seen.example.scene}: {one.votes[place]} {100 * probability:.0f} %",
        Path(one.seen.example.group).name[:24],
    )
    for line, text in enumerate(texts):
        at = (2, height - 18 + 13 * line)
        cv2.putText(cell, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 1, cv2.LINE_AA)
    return cell
