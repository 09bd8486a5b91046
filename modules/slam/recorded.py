"""The `recorded` SLAM module: replays the trajectory of another system, with its gaps."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.input_files import given_path
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.recorded import RecordedTrajectory, read_recorded
from sceneslam.types.rig import Rig, Sensor

from .local import LocalModule

_BASE_FRAMES = ("", "base", "base_link")  # frames that need no extrinsics


class Recorded(LocalModule):
    """Returns recorded poses; the settings are described in `conf/slam/recorded.yaml`.

    Between two recorded poses it interpolates, which looks ahead by less than one gap. LOST before
    the recording begins, after it ends, in its gaps, and during its start-up time.
    """

    def __init__(
        self,
        *,
        path: str,
        sequence: int | None,
        T_base_frame: list[float] | None,
        startup_s: float,
        gap_periods: float,
    ) -> None:
        if not 0 <= startup_s < np.inf:
            raise ConfigError("startup_s", startup_s, "seconds, 0 or more")
        if not 1 <= gap_periods < np.inf:
            raise ConfigError("gap_periods", gap_periods, "1 or more")
        recorded = _chosen(read_recorded(given_path(path)), sequence)
        T_frame_base = se3.inverse(_extrinsics(T_base_frame, recorded.frame))
        self._stamps_ns = recorded.trajectory.stamps_ns
        self._T_world_base = recorded.trajectory.T_world_base @ T_frame_base
        period_ns = float(np.median(np.diff(self._stamps_ns))) if len(self._stamps_ns) > 1 else 0.0
        self._gap_ns = gap_periods * period_ns
        self._startup_ns = round(startup_s * 1e9)
        self._ready_ns: int | None = None  # stamp from which on it returns poses
        self._T_local_world: se3.Transform | None = None
        self._T_local_base = se3.identity()

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return each sensor as an alternative: only stamps are used."""
        return tuple(frozenset({sensor}) for sensor in Sensor)

    def activate(self, rig: Rig) -> None:
        """Start a session: `local` is at the first observation with a recorded pose."""
        self._ready_ns, self._T_local_world = None, None
        self._T_local_base = se3.identity()

    def track(self, observation: Observation) -> Tracking:
        """Return the recorded T_local_base (4, 4) [m]; LOST without one."""
        if self._ready_ns is None:
            self._ready_ns = observation.stamp_ns + self._startup_ns
        T_world_base = self._pose_at(observation.stamp_ns)
        if T_world_base is None or observation.stamp_ns < self._ready_ns:
            return self._answer(observation.stamp_ns, TrackingStatus.LOST)
        if self._T_local_world is None:
            self._T_local_world = se3.inverse(T_world_base)
        self._T_local_base = self._T_local_world @ T_world_base
        return self._answer(observation.stamp_ns, TrackingStatus.TRACKING)

    def _pose_at(self, stamp_ns: int) -> se3.Transform | None:
        """Return T_world_base (4, 4) [m] at a stamp, None in a gap or outside of the recording."""
        after = int(np.searchsorted(self._stamps_ns, stamp_ns))
        if after == len(self._stamps_ns):
            return None
        after_ns = int(self._stamps_ns[after])
        if after_ns == stamp_ns:
            return np.asarray(self._T_world_base[after])
        if after == 0:
            return None
        before_ns = int(self._stamps_ns[after - 1])
        if after_ns - before_ns > self._gap_ns:
            return None
        ratio = (stamp_ns - before_ns) / (after_ns - before_ns)
        return se3.interpolate(self._T_world_base[after - 1], self._T_world_base[after], ratio)

    def _answer(self, stamp_ns: int, status: TrackingStatus) -> Tracking:
        return Tracking(
            stamp_ns=stamp_ns,
            T_local_base=self._T_local_base.copy(),
            status=status,
            quality_ratio=0.0 if status is TrackingStatus.LOST else 1.0,
        )


def _chosen(found: tuple[RecordedTrajectory, ...], sequence: int | None) -> RecordedTrajectory:
    """Return the configured sequence, or the only one."""
    matching = [one for one in found if sequence is None or one.sequence == sequence]
    if len(matching) != 1:
        held = ", ".join(str(one.sequence) for one in found) or "none"
        raise ConfigError("sequence", sequence, f"a sequence of the file; it holds: {held}")
    return matching[0]


def _extrinsics(values: list[float] | None, frame: str) -> se3.Transform:
    """Return T_base_frame (4, 4) [m] of `x y z qx qy qz qw`, required unless it is base."""
    if values is None and frame in _BASE_FRAMES:
        return se3.identity()
    quat_is_zero = values is not None and not any(values[3:])
    if values is None or len(values) != 7 or not np.isfinite(values).all() or quat_is_zero:
        what = f"seven numbers x y z [m] qx qy qz qw: where {frame or 'the frame'} sits on base"
        raise ConfigError("T_base_frame", values, what)
    return se3.from_quat_xyzw(np.array(values[:3]), np.array(values[3:]))
