"""Trajectory files in TUM or KITTI layout, distinguished by the numbers per line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text
from sceneslam.types.trajectory import Trajectory

_ROTATION_TOLERANCE = 1e-3  # files print six digits or more


def read_poses(path: Path) -> Trajectory:
    """Return the poses of a TUM file (eight numbers per line) or a KITTI file (twelve).

    KITTI poses have no stamps: pose k gets k seconds, so that equal files match line by line.
    Raises InputError if the file is missing, empty or in neither layout.
    """
    if not path.is_file():
        raise InputError(f"trajectory file not found: {path}")
    trajectory = Trajectory.read_tum(path) if has_stamps(path) else _read_kitti(path)
    if not len(trajectory):
        raise InputError(f"trajectory file holds no poses: {path}")
    return trajectory


def has_stamps(path: Path) -> bool:
    """Tell whether a trajectory file has stamps, as in TUM layout; in KITTI layout it has none."""
    lines = read_text(path).splitlines()
    first = next((line for line in lines if line.strip() and line.lstrip()[0] != "#"), "")
    return len(first.split()) != 12


def _read_kitti(path: Path) -> Trajectory:
    try:
        values = np.loadtxt(read_text(path).splitlines(), ndmin=2)
    except ValueError as err:
        raise InputError(f"expected twelve numbers per line, {err}: {path}") from err
    if values.shape[1] != 12 or not np.isfinite(values).all():
        raise InputError(f"expected twelve finite numbers per line: {path}")
    T_world_base = np.tile(np.eye(4), (len(values), 1, 1))
    T_world_base[:, :3] = values.reshape(-1, 3, 4)
    wrong = np.flatnonzero(~_are_rotations(T_world_base[:, :3, :3]))
    if len(wrong):
        raise InputError(f"pose {wrong[0] + 1}: its first three columns are no rotation: {path}")
    stamps_ns = np.arange(len(values), dtype=np.int64) * 10**9
    return Trajectory(stamps_ns=stamps_ns, T_world_base=T_world_base)


def _are_rotations(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell of each matrix (N, 3, 3) whether it is orthonormal and right-handed."""
    products = matrices @ matrices.transpose(0, 2, 1)
    is_orthonormal = (np.abs(products - np.eye(3)) <= _ROTATION_TOLERANCE).all(axis=(1, 2))
    return np.asarray(is_orthonormal & (np.linalg.det(matrices) > 0))
