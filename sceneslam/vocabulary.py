"""Train a bag of words on images: `python -m sceneslam.vocabulary IMAGES OUT`.

IMAGES is a folder with images, also in folders below it; OUT is written in DBoW2's text format,
which ORB-SLAM reads. A tree by hierarchical k-medians on ORB descriptors (Galvez-Lopez and Tardos,
"Bags of Binary Words for Fast Place Recognition in Image Sequences", T-RO 2012).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError, InputError, SceneSlamError

BRANCHES, LEVELS = 10, 6  # as in the published vocabulary
FEATURES = 1000  # per image
IMAGES_MAX = 40  # evenly over the folder; more are slower without better results
_ROUNDS = 10  # of k-medians
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vocabulary:
    """A tree of words; row i is node i + 1, the root is node 0, a parent precedes its children."""

    parents: NDArray[np.int64]  # (N,)
    is_word: NDArray[np.bool_]  # (N,): a leaf
    descriptors: NDArray[np.uint8]  # (N, 32)
    weights: NDArray[np.float64]  # (N,): inverse document frequency of a word, else 0

    def write(self, path: Path) -> None:
        """Write it in DBoW2's text format: k L scoring weighting, then a node per line."""
        lines = [f"{BRANCHES} {LEVELS} 0 0"]
        rows = zip(self.parents, self.is_word, self.descriptors, self.weights, strict=True)
        for parent, is_word, descriptor, weight in rows:
            values = " ".join(map(str, descriptor.tolist()))
            lines.append(f"{parent} {int(is_word)} {values} {weight:.6g}")
        path.write_text("\n".join(lines) + "\n")


def describe(image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the ORB descriptors (N, 32) of a BGR image (H, W, 3)."""
    detector = cv2.ORB_create(FEATURES, fastThreshold=7)  # type: ignore[attr-defined]
    descriptors = detector.detectAndCompute(image_bgr, None)[1]
    if descriptors is None:
        return np.zeros((0, 32), np.uint8)
    return np.asarray(descriptors, np.uint8)


def train(images: Sequence[NDArray[np.uint8]], *, seed: int) -> Vocabulary:
    """Return a vocabulary of descriptors (N_i, 32) per image; raises InputError without any."""
    descriptors = np.concatenate([np.zeros((0, 32), np.uint8), *images])
    if len(descriptors) < BRANCHES:
        raise InputError(f"{len(descriptors)} features in the images, expected {BRANCHES} or more")
    owners = np.repeat(np.arange(len(images)), [len(image) for image in images])
    signs = np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1  # (N, 256), -1 or 1
    tree = _Tree(signs, owners, len(images), np.random.default_rng(seed))
    return tree.grow()


class _Tree:
    """Splits descriptors recursively into branches, level by level."""

    def __init__(
        self,
        signs: NDArray[np.float32],
        owners: NDArray[np.int64],
        images: int,
        rng: np.random.Generator,
    ) -> None:
        self._signs, self._owners, self._images, self._rng = signs, owners, images, rng
        self._parents: list[int] = []
        self._medians: list[NDArray[np.float32]] = []
        self._weights: list[float] = []

    def grow(self) -> Vocabulary:
        """Return the tree."""
        todo = [(0, np.arange(len(self._signs)), LEVELS)]
        for node, members, levels in todo:  # the list grows during iteration: breadth first
            medians, nearest = self._split(self._signs[members])
            for branch, median in enumerate(medians):
                inside = members[nearest == branch]
                is_word = levels == 1 or len(inside) <= 1
                self._parents.append(node)
                self._medians.append(median)
                self._weights.append(self._weight(inside) if is_word else 0.0)
                if not is_word:
                    todo.append((len(self._parents), inside, levels - 1))
        bits = (np.stack(self._medians) > 0).astype(np.uint8)
        weights = np.array(self._weights)
        return Vocabulary(
            parents=np.array(self._parents),
            is_word=weights > 0,
            descriptors=np.packbits(bits, axis=1),
            weights=weights,
        )

    def _split(self, signs: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return up to k medians (k, 256), and the nearest one's index for each descriptor (N,)."""
        medians = signs if len(signs) <= BRANCHES else self._seeds(signs)
        nearest = (signs @ medians.T).argmax(axis=1)
        for _ in range(_ROUNDS if len(signs) > BRANCHES else 0):
            is_in = np.eye(len(medians), dtype=np.float32)[nearest]
            votes = is_in.T @ signs
            medians = np.where(votes != 0, np.sign(votes), medians)  # ties keep their value
            before, nearest = nearest, (signs @ medians.T).argmax(axis=1)
            if (before == nearest).all():
                break
        used, nearest = np.unique(nearest, return_inverse=True)
        return medians[used], nearest

    def _seeds(self, signs: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return k descriptors far from each other (k-means++)."""
        chosen = [int(self._rng.integers(len(signs)))]
        similar = signs @ signs[chosen[0]]
        for _ in range(BRANCHES - 1):
            squared = (signs.shape[1] - similar) ** 2
            if not squared.any():
                break  # all are equal to chosen ones
            chosen.append(int(self._rng.choice(len(signs), p=squared / squared.sum())))
            similar = np.maximum(similar, signs @ signs[chosen[-1]])
        return signs[chosen]

    def _weight(self, members: NDArray[np.int64]) -> float:
        """Return a word's weight by its rarity; above 0, since ORB-SLAM skips words of weight 0."""
        seen = len(np.unique(self._owners[members]))
        return float(np.log1p(self._images / max(seen, 1)))


def read_images(folder: Path) -> list[NDArray[np.uint8]]:
    """Return the descriptors (N, 32) of up to 40 images, evenly; raises ConfigError without any."""
    paths = [path for path in sorted(folder.rglob("*")) if path.suffix.lower() in _SUFFIXES]
    if not paths:
        raise ConfigError("IMAGES", str(folder), f"a folder with images ({', '.join(_SUFFIXES)})")
    found = []
    for index in np.linspace(0, len(paths) - 1, min(IMAGES_MAX, len(paths))).round().astype(int):
        image_bgr = cv2.imread(str(paths[index]))
        if image_bgr is not None:
            found.append(describe(np.asarray(image_bgr, np.uint8)))
    return found


def main(arguments: Sequence[str]) -> int:
    """Train and write; return the exit code."""
    if len(arguments) != 2:
        sys.stderr.write(f"{__doc__}")
        return 2
    folder, out = Path(arguments[0]), Path(arguments[1])
    try:
        if not out.parent.is_dir():
            raise ConfigError("OUT", str(out), "a file in a folder that exists")
        vocabulary = train(read_images(folder), seed=0)
        vocabulary.write(out)
    except (SceneSlamError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    sys.stdout.write(f"{int(vocabulary.is_word.sum())} words in {len(vocabulary.parents)} nodes\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
