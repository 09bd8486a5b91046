"""A sink that notes when, by the clock, which pose was told."""

from __future__ import annotations

from pathlib import Path
from time import monotonic_ns

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import Event
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

TOLD, TRUTH = "witness.npz", "truth.tum"


class Witness:
    """Writes what it saw when the run ends."""

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._stamps_ns: list[int] = []
        self._clocks_ns: list[int] = []
        self._positions_m: list[Transform] = []

    def open(self, rig: Rig, folder: Path) -> None:
        """Take the run's folder."""
        self._folder = folder

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Note a pose, or that there was none."""
        self._stamps_ns.append(observation.stamp_ns)
        self._clocks_ns.append(monotonic_ns())
        self._positions_m.append(np.full(3, np.nan) if T_map_base is None else T_map_base[:3, 3])

    def write_event(self, event: Event) -> None:
        """Do nothing."""

    def write_truth(self, truth: GroundTruth) -> None:
        """Write the true poses."""
        if self._folder is not None:
            truth.trajectory.write_tum(self._folder / TRUTH)

    def close(self) -> None:
        """Write what was noted."""
        if self._folder is not None:
            np.savez(
                self._folder / TOLD,
                stamps_ns=np.array(self._stamps_ns, np.int64),
                clocks_ns=np.array(self._clocks_ns, np.int64),
                positions_m=np.array(self._positions_m).reshape(-1, 3),
            )


class Outliving(Witness):
    """Notes the stamps of poses in a file that outlives the process, outside the run's folder."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._told = Path(path)

    def open(self, rig: Rig, folder: Path) -> None:
        """Begin the file."""
        self._told.write_bytes(b"")

    def write(self, observation: Observation, T_map_base: Transform | None, module: str) -> None:
        """Note a pose at once."""
        if T_map_base is not None:
            with self._told.open("ab") as file:
                file.write(observation.stamp_ns.to_bytes(8, "little"))

    def write_truth(self, truth: GroundTruth) -> None:
        """Do nothing."""


def reported_ns(path: Path) -> NDArray[np.int64]:
    """Return the stamps that `Outliving` noted."""
    data = path.read_bytes() if path.exists() else b""
    return np.frombuffer(data[: len(data) // 8 * 8], np.int64)
