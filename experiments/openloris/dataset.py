"""What a folder of OpenLORIS-Scene's published trajectories holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from omegaconf import OmegaConf

from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.recorded import read_recorded
from sceneslam.types.trajectory import Trajectory

_ODOMETRY = "odom"
_BASE = "base_link"


@dataclass(frozen=True, slots=True, order=True)
class Sequence:
    """One drive."""

    scene: str
    number: int

    @property
    def name(self) -> str:
        """Return its name in the data set; all that is published is package 1."""
        return f"{self.scene}-1-{self.number}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recorded:
    """What one system put out on one sequence."""

    path: Path
    T_base_frame: list[float] | None  # x y z [m] qx qy qz qw; None: the poses are base's
    trajectory: Trajectory  # of base


class Dataset:
    """The sequences with truth and odometry, and the systems that were recorded on them."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError(f"recordings not found, expected a folder: {folder}")
        self._folder = folder
        self.truth = {key: one.trajectory for key, one in self._read(folder / "gt").items()}
        systems = sorted(path for path in (folder / "recorded").glob("*") if path.is_dir())
        self.systems: Mapping[str, Mapping[Sequence, Recorded]] = {
            path.name: self._read(path) for path in systems
        }
        self.odometry = self.systems.pop(_ODOMETRY, {})
        self.sequences = sorted(key for key in self.truth if key in self.odometry)
        if not self.sequences or not self.systems:
            wanted = f"gt/*.txt, recorded/{_ODOMETRY}/*.txt and recorded/SYSTEM/*.txt"
            raise InputError(f"no recordings, expected {wanted}: {folder}")

    def _read(self, folder: Path) -> dict[Sequence, Recorded]:
        found: dict[Sequence, Recorded] = {}
        for path in sorted(folder.glob("*.txt")):
            for one in read_recorded(path):
                if one.sequence is None:
                    raise InputError(f"expected header lines `scene:`, `frame:`, `seq:`: {path}")
                T_base_frame = self._extrinsics(one.scene, one.frame)
                trajectory = one.trajectory
                if T_base_frame is not None:
                    trajectory = _of_base(trajectory, T_base_frame)
                key = Sequence(one.scene, one.sequence)
                found[key] = Recorded(path=path, T_base_frame=T_base_frame, trajectory=trajectory)
        return found

    def _extrinsics(self, scene: str, frame: str) -> list[float] | None:
        """Return where a frame sits on the robot that drove in a scene, None for base."""
        if frame == _BASE:
            return None
        path = self._folder / "extrinsics.yaml"
        if not path.is_file():
            raise InputError(f"extrinsics of {frame} not found: {path}")
        robots = cast("dict[str, Any]", OmegaConf.to_container(OmegaConf.load(path)))
        for scenes, frames in robots.items():
            if scene in scenes.split("_") and frame in frames:
                return [float(value) for value in frames[frame]]
        raise InputError(f"no extrinsics of {frame} in scene {scene}: {path}")


def _of_base(trajectory: Trajectory, T_base_frame: list[float]) -> Trajectory:
    values = np.array(T_base_frame)
    T_frame_base = se3.inverse(se3.from_quat_xyzw(values[:3], values[3:]))
    return Trajectory(
        stamps_ns=trajectory.stamps_ns, T_world_base=trajectory.T_world_base @ T_frame_base
    )
