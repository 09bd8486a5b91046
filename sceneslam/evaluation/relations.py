"""Error of relative poses, for recordings without a true trajectory (Kuemmerle et al., 2009)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import nearest
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text
from sceneslam.types.trajectory import Trajectory

_SAME_STAMP_S = 0.0005  # files have stamps with three decimals or more


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Relations:
    """True motions between pairs of instants, unordered."""

    first_ns: NDArray[np.int64]  # (N,)
    second_ns: NDArray[np.int64]  # (N,)
    T_first_second: NDArray[np.float64]  # (N, 4, 4)

    @classmethod
    def read(cls, path: Path) -> Relations:
        """Return the lines `t1 t2 x y z roll pitch yaw` [s, m, rad] of a relations file.

        Raises InputError if the file is missing, empty or not of this form.
        """
        if not path.is_file():
            raise InputError(f"relations file not found: {path}")
        lines = read_text(path).splitlines()
        rows = [_row(line, path) for line in lines if line.strip() and line.lstrip()[0] != "#"]
        if not rows:
            raise InputError(f"relations file holds no relations: {path}")
        values = np.array(rows)
        # Seconds since 1970 as a float keep microseconds, which is what the files print.
        stamps_ns = np.round(values[:, :2] * 1e6).astype(np.int64) * 1000
        return cls(
            first_ns=stamps_ns[:, 0],
            second_ns=stamps_ns[:, 1],
            T_first_second=_from_roll_pitch_yaw(values[:, 2:5], values[:, 5:8]),
        )


def relation_errors(trajectory: Trajectory, relations: Relations) -> dict[str, float | int]:
    """Return mean and standard deviation of the motions' errors, and of their squares.

    Raises InputError when no relation is matched, as by an empty trajectory.
    """
    trans_m, rot_deg = motion_errors(trajectory, relations).T
    total = len(relations.first_ns)
    if not len(trans_m):
        off_s = _ends(trajectory, relations)[2].min() * 1e-9
        raise InputError(
            f"none of the {total} relations has poses within {_SAME_STAMP_S} s of its "
            f"stamps (nearest: {off_s:.3f} s)"
        )
    return {
        "trans_mean_m": float(trans_m.mean()),
        "trans_std_m": float(trans_m.std()),
        "rot_mean_deg": float(rot_deg.mean()),
        "rot_std_deg": float(rot_deg.std()),
        "trans_sq_mean": float((trans_m**2).mean()),
        "trans_sq_std": float((trans_m**2).std()),
        "rot_sq_mean": float((rot_deg**2).mean()),
        "rot_sq_std": float((rot_deg**2).std()),
        "matched": len(trans_m),
        "total": total,
    }


def motion_errors(trajectory: Trajectory, relations: Relations) -> NDArray[np.float64]:
    """Return the errors (N, 2) [m, deg] of the N relations that are matched.

    A relation is matched when the trajectory has a pose within 0.5 ms of both its instants. The
    translation error is the length, the rotation error the angle of inv(true) @ estimated. Raises
    InputError for an empty trajectory.
    """
    if not len(trajectory):
        raise InputError("the trajectory is empty, no relation can be measured on it")
    first, second, off_ns = _ends(trajectory, relations)
    kept = np.flatnonzero(off_ns <= _SAME_STAMP_S * 1e9)
    T_world_base = trajectory.T_world_base
    T_estimated = se3.inverse(T_world_base[first[kept]]) @ T_world_base[second[kept]]
    T_error = se3.inverse(relations.T_first_second[kept]) @ T_estimated
    trans_m = np.linalg.norm(T_error[:, :3, 3], axis=1)
    return np.column_stack([trans_m, np.degrees(se3.rotation_angle_rad(T_error))])


def _ends(trajectory: Trajectory, relations: Relations) -> NDArray[np.int64]:
    """Return (3, N): the indices of the poses nearest to both ends, and the larger gap [ns]."""
    first = nearest(trajectory.stamps_ns, relations.first_ns)
    second = nearest(trajectory.stamps_ns, relations.second_ns)
    off_ns = np.maximum(
        np.abs(trajectory.stamps_ns[first] - relations.first_ns),
        np.abs(trajectory.stamps_ns[second] - relations.second_ns),
    )
    return np.stack([first, second, off_ns])


def _row(line: str, path: Path) -> list[float]:
    try:
        row = [float(word) for word in line.split()]
    except ValueError:
        row = []
    if len(row) != 8 or not np.isfinite(row).all():
        raise InputError(
            f"expected `t1 t2 x y z roll pitch yaw`, got {line.strip()[:60]!r}: {path}"
        )
    return row


def _from_roll_pitch_yaw(
    translation_m: NDArray[np.float64], rpy_rad: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return R_z(yaw) R_y(pitch) R_x(roll) with the translation, by half-angle quaternions."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy_rad / 2).T, np.sin(rpy_rad / 2).T
    quat_xyzw = np.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        axis=-1,
    )
    return se3.from_quat_xyzw(translation_m, quat_xyzw)
