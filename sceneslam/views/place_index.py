"""Recognise places by their binary descriptors, without a pre-trained vocabulary.

Locality-sensitive hashing (Indyk and Motwani 1998): a word is the value of a selection of bits of a
descriptor. Descriptors of one corner differ in few bits, so that some of several selections agree
exactly. Words are weighted by their rarity among the places (Sivic and Zisserman 2003).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_DESCRIPTOR_BITS = 256
_TABLES = 8  # selections of bits
_WORD_BITS = 16  # with 12, words are shared by chance; with 20, four times the time for no gain
_WORDS = _TABLES << _WORD_BITS
_SEED = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Likeness:
    """A similar place."""

    place_id: int
    ratio: float  # share of the query's total word weight that the place has in common


class PlaceIndex:
    """Places by the words of their descriptors."""

    def __init__(self) -> None:
        rng = np.random.default_rng(_SEED)
        chosen = [rng.permutation(_DESCRIPTOR_BITS)[:_WORD_BITS] for _ in range(_TABLES)]
        self._bits = np.concatenate(chosen)
        self._places: dict[int, NDArray[np.int32]] = {}  # words, ascending
        self._holders = np.zeros(_WORDS, np.uint16)  # how many places have the word

    def __len__(self) -> int:
        return len(self._places)

    def insert(self, place_id: int, descriptors: NDArray[np.uint8]) -> None:
        """Add a place by its descriptors (N, 32)."""
        words = self._words(descriptors)
        self._places[place_id] = words
        self._holders[words] += 1

    def remove(self, place_id: int) -> None:
        """Remove a place."""
        self._holders[self._places.pop(place_id)] -= 1

    def alike(
        self, descriptors: NDArray[np.uint8], place_ids: Collection[int] | None = None
    ) -> list[Likeness]:
        """Return the places most similar to descriptors (N, 32), of `place_ids` or all."""
        words = self._words(descriptors)
        rarity = np.log((1.0 + len(self._places)) / np.maximum(self._holders[words], 1))
        weights = np.zeros(_WORDS, np.float32)
        weights[words] = rarity
        asked = self._places if place_ids is None else place_ids
        total = max(float(rarity.sum()), 1e-9)
        found = [
            Likeness(place_id=k, ratio=float(weights[self._places[k]].sum()) / total) for k in asked
        ]
        return sorted(found, key=lambda likeness: (-likeness.ratio, likeness.place_id))

    def _words(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the distinct words of descriptors (N, 32), ascending; each table has its own."""
        bits = np.unpackbits(descriptors, axis=1).take(self._bits, axis=1)
        values = np.packbits(bits, axis=1, bitorder="little").view("<u2")  # of _WORD_BITS bits
        words = values.astype(np.int32) + (np.arange(_TABLES) << _WORD_BITS)
        is_present = np.zeros(_WORDS, bool)
        is_present[words] = True
        return np.flatnonzero(is_present).astype(np.int32)
