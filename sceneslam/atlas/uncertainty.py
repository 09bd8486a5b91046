"""The covariance of every pose in `map`, propagated through hand-overs and by distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.files import replacing
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import parse_stamp_ns

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
# Defaults of `Wheels` in a rig.
WHEELS = Drift(per_m=0.02, rad_per_m=0.01, rad_per_rad=0.02, rad_per_root=0.0)
# With a gyro, whose bias is known to a tenth of a degree per second.
GYRO = Drift(per_m=0.02, rad_per_m=0.002, rad_per_rad=0.005, rad_per_root=0.0)
# Constant velocity: the robot may have braked meanwhile.
VELOCITY = Drift(per_m=0.5, rad_per_m=0.1, rad_per_rad=0.5, rad_per_root=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SessionPose:
    """A pose of the trajectory with its session and covariance."""

    T_map_base: Transform
    session: int
    is_bridged: bool
    covariance: Covariance | None  # of T_local_base, as its module reported it; None: unknown


@dataclass(slots=True)
class _Known:
    """A pose with its covariance; `reported` is the part reported by its module."""

    T_map_base: Transform
    carried: Covariance
    reported: Covariance = field(default_factory=lambda: np.zeros((6, 6)))


def propagate(steps: Sequence[SessionPose], bridge: Drift) -> NDArray[np.float64]:
    """Return the covariance (N, 6, 6) of every pose; `map` begins at the first pose.

    The covariance of a module's pose is the sum of three parts, assumed independent: that of the
    pose at which it was placed, propagated along its motion (adjoint); the drift of its map since;
    and its own covariance, if it reports one. A bridged pose has the covariance of the pose before
    it, plus the drift of the bridge.
    """
    if not steps:
        return np.zeros((0, 6, 6))
    latest = _Known(steps[0].T_map_base, np.zeros((6, 6)))
    sessions: dict[int, _Known] = {}  # the last pose that the session's module gave
    found = []
    for step in steps:
        before = latest
        if not step.is_bridged:
            before = sessions.get(step.session, _Known(latest.T_map_base, _total(latest)))
        reported = np.zeros((6, 6)) if step.is_bridged else step.covariance
        drift = bridge if step.is_bridged else MAPPED
        start = _total(before) if step.is_bridged else before.carried
        T_before_now = se3.inverse(before.T_map_base) @ step.T_map_base
        latest = _Known(step.T_map_base, _grown(start, T_before_now, drift))
        if reported is not None:
            latest.reported = reported
        if not step.is_bridged:
            sessions[step.session] = latest
        found.append(_total(latest))
    return np.array(found)


def _total(known: _Known) -> Covariance:
    return np.asarray(known.carried + known.reported)


def _grown(covariance: Covariance, T_prev_curr: Transform, drift: Drift) -> Covariance:
    """Return the covariance (6, 6) after a motion, including the motion's drift."""
    way_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
    turned_rad = float(se3.rotation_angle_rad(T_prev_curr))
    adjoint = se3.adjoint(se3.inverse(T_prev_curr))
    carried = adjoint @ covariance @ adjoint.T
    along_m = drift.per_m * way_m
    turn_rad = drift.rad_per_m * way_m + drift.rad_per_rad * turned_rad
    more = np.repeat([along_m, turn_rad], 3)
    deviations = np.sqrt(np.maximum(np.diag(carried), 0.0))
    random = np.repeat([0.0, drift.rad_per_root**2 * (way_m + turned_rad)], 3)
    return np.asarray(carried + np.diag(more * (more + 2.0 * deviations) + random))


def write_covariances(
    path: Path, stamps_ns: NDArray[np.int64], covariances: NDArray[np.float64]
) -> None:
    """Write a line per pose: stamp [s], then the upper triangle of its (6, 6) row by row.

    Of x y z [m] and the rotation vector [rad] in `base`: T_true = T_told exp(xi).
    """
    rows = covariances[:, *np.triu_indices(6)].tolist()
    with replacing(path) as file:
        file.write("# stamp_s xx xy xz xr xp xw yy yz yr yp yw zz zr zp zw rr rp rw pp pw ww\n")
        for stamp_ns, row in zip(stamps_ns.tolist(), rows, strict=True):
            numbers = " ".join(f"{value:.6e}" for value in row)
            file.write(f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} {numbers}\n")


def read_covariances(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return what `write_covariances` wrote: stamps (N,) and covariances (N, 6, 6)."""
    stamps_ns, rows = [], []
    for line in path.read_text().splitlines()[1:]:
        stamp, *numbers = line.split()
        stamps_ns.append(parse_stamp_ns(stamp))
        rows.append([float(number) for number in numbers])
    covariances = np.zeros((len(rows), 6, 6))
    upper = np.triu_indices(6)
    covariances[:, *upper] = np.array(rows).reshape(-1, 21)
    covariances[:, *upper[::-1]] = covariances[:, *upper]
    return np.array(stamps_ns, np.int64), covariances
