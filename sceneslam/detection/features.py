"""Stored detector features of a recording, with its true scenes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import FeatureDetector
from sceneslam.types.errors import ModuleError, SceneSlamError, text_of
from sceneslam.types.observation import Observation
from sceneslam.types.truth import GroundTruth, SceneChange


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordingFeatures:
    """A detector's features for every observation of a recording."""

    stamps_ns: NDArray[np.int64]  # (N,) of all observations
    values: NDArray[np.float64]  # (N, F); rows without input are not used
    is_there: NDArray[np.bool_]  # (N,) whether the observation had an input for the detector
    scenes: tuple[SceneChange, ...] | None  # true scenes, None: unknown
    faults: tuple[str, ...] = ()  # of the recording

    @property
    def truth(self) -> GroundTruth | None:
        """Return the ground truth, None if unknown."""
        return None if self.scenes is None else GroundTruth(scenes=self.scenes)

    def write(self, path: Path) -> None:
        """Write a file atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.part")
        scenes = self.scenes and [[change.stamp_ns, change.scene] for change in self.scenes]
        with part.open("wb") as file:
            np.savez_compressed(
                file,
                stamps_ns=self.stamps_ns,
                values=self.values,
                is_there=self.is_there,
                scenes=np.array(json.dumps(scenes)),
                faults=np.array(json.dumps(self.faults)),
            )
        part.replace(path)

    @classmethod
    def read(cls, path: Path) -> RecordingFeatures:
        """Return the features of a file, exactly as written."""
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            scenes = json.loads(str(arrays["scenes"]))
            return cls(
                stamps_ns=arrays["stamps_ns"],
                values=arrays["values"],
                is_there=arrays["is_there"],
                scenes=None
                if scenes is None
                else tuple(SceneChange(stamp_ns=at, scene=scene) for at, scene in scenes),
                faults=tuple(json.loads(str(arrays["faults"]))),
            )


@contextmanager
def failures_named() -> Iterator[None]:
    """Raise ModuleError where the detector, which is called within, fails."""
    try:
        yield
    except SceneSlamError:
        raise
    except Exception as error:
        raise ModuleError(f"the detector failed: {text_of(error)}") from error


def measure(
    observations: Iterable[Observation], detector: FeatureDetector
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return stamps (N,) [ns], features (N, F) and whether there was input (N,).

    Raises ModuleError if the detector fails.
    """
    stamps_ns, rows = [], []
    for observation in observations:
        stamps_ns.append(observation.stamp_ns)
        with failures_named():
            rows.append(detector.get_features(observation))
    width = max((len(row) for row in rows if row is not None), default=0)
    values = np.zeros((len(rows), width))
    for number, row in enumerate(rows):
        if row is not None:
            values[number] = row
    return np.array(stamps_ns, np.int64), values, np.array([row is not None for row in rows], bool)
