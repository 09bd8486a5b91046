"""Covariances of poses: how motions drift, and the file of a trajectory's covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import TRIANGLE, symmetric, triangle
from sceneslam.types.files import replacing
from sceneslam.types.rig import Wheels
from sceneslam.types.trajectory import parse_stamp_ns, stamp_text

Covariance = NDArray[np.float64]  # (6, 6): T_true = T_told @ exp(xi), xi in base as se3.log has it


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Standard deviations of the drift of one kind of motion.

    Errors by a wrong scale or unequal wheels are systematic: standard deviations add up. The
    rotation error of a map is random: variances add up.
    """

    per_m: float  # of the position [m], per metre travelled
    rad_per_m: float  # of the rotation [rad], per metre travelled
    rad_per_rad: float  # of the rotation [rad], per radian turned
    rad_per_root: float  # random, of the rotation [rad], per root of a metre and of a radian


# A module's own covariance is that of its pose relative to its local map, which itself drifts.
MAPPED = Drift(per_m=0.005, rad_per_m=0.0, rad_per_rad=0.0, rad_per_root=0.003)
# Constant velocity: the robot may have braked meanwhile.
VELOCITY = Drift(per_m=0.5, rad_per_m=0.1, rad_per_rad=0.5, rad_per_root=0.0)


def of_wheels(wheels: Wheels, *, has_gyro: bool = False) -> Drift:
    """Return the drift of dead reckoning by wheels, with the turn of a gyro if there is one."""
    drift = Drift(
        per_m=wheels.drift_ratio,
        rad_per_m=wheels.drift_rad_per_m,
        rad_per_rad=wheels.drift_ratio,
        rad_per_root=0.0,
    )
    # The gyro's bias is known to a tenth of a degree per second.
    return replace(drift, rad_per_m=0.002, rad_per_rad=0.005) if has_gyro else drift


def motions(T_map_base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the length and the angle (N - 1, 2) [m, rad] of the motions between N poses."""
    steps = se3.inverse(T_map_base[:-1]) @ T_map_base[1:]
    length_m = np.linalg.norm(steps[:, :3, 3], axis=1)
    return np.column_stack([length_m, se3.rotation_angle_rad(steps)])


def drifted(drift: Drift, moved: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariances (..., 6, 6) of the drift over motions (..., 2) [m, rad].

    Half of the motion is a lever for the rotation's error.
    """
    length_m, turned_rad = moved[..., 0], moved[..., 1]
    turn2 = (drift.rad_per_m * length_m + drift.rad_per_rad * turned_rad) ** 2
    turn2 = turn2 + drift.rad_per_root**2 * (length_m + turned_rad)
    shift2 = (drift.per_m * length_m) ** 2 + turn2 * (0.5 * length_m) ** 2
    variances = np.stack([shift2, turn2], axis=-1).repeat(3, axis=-1)
    return np.asarray(variances[..., None] * np.eye(6))


def write_covariances(
    path: Path, stamps_ns: NDArray[np.int64], covariances: NDArray[np.float64]
) -> None:
    """Write a line per pose: stamp [s], then the upper triangle of its (6, 6) row by row.

    Of x y z [m] and the rotation vector [rad] in `base`: T_true = T_told exp(xi).
    """
    rows = triangle(covariances).tolist()
    with replacing(path) as file:
        file.write("# stamp_s xx xy xz xr xp xw yy yz yr yp yw zz zr zp zw rr rp rw pp pw ww\n")
        for stamp_ns, row in zip(stamps_ns.tolist(), rows, strict=True):
            numbers = " ".join(f"{value:.6e}" for value in row)
            file.write(f"{stamp_text(stamp_ns)} {numbers}\n")


def read_covariances(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return what `write_covariances` wrote: stamps (N,) and covariances (N, 6, 6)."""
    stamps_ns, rows = [], []
    for line in path.read_text().splitlines()[1:]:
        stamp, *numbers = line.split()
        stamps_ns.append(parse_stamp_ns(stamp))
        rows.append([float(number) for number in numbers])
    return np.array(stamps_ns, np.int64), symmetric(np.array(rows).reshape(-1, TRIANGLE))
