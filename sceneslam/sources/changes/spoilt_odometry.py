"""Errors added to the wheel odometry of any source, for experiments on robustness."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.ros.pixels import locked
from sceneslam.sources.changes.wrapped import Wrapped, check_sensor
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_above, check_among, check_least
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform

LASTING = ("reversed", "frozen", "slipping")  # for some seconds, repeatedly
ALWAYS = ("scaled", "turning", "late", "absent")
LIES = ("none", *LASTING, *ALWAYS, "spikes")
_DRIVING_M_S = 0.05  # below this speed, no temporary error begins


class SpoiltOdometry(Wrapped):
    """Passes on a source's observations with wrong odometry.

    For `lasting_s`, about every `every_s` of driving: `reversed` (translation
    with the wrong sign), `frozen` (no motion), `slipping` (translation times `ratio`). Always:
    `scaled` (translation times `ratio`), `turning` (`turn_rad_per_m` more yaw per metre),
    `late` (the pose of `late_s` before), `absent` (no odometry). `spikes`: single poses off by up
    to `spike_m` and `spike_rad`, about every `every_s`.
    """

    def __init__(
        self,
        source: Source,
        lie: str,
        every_s: float,
        lasting_s: list[float],
        ratio: float,
        turn_rad_per_m: float,
        late_s: float,
        spike_m: float,
        spike_rad: float,
        seed: int,
    ) -> None:
        check_among(LIES, lie=lie)
        check_above(0, every_s=every_s, lasting_s=lasting_s)
        check_least(0, ratio=ratio, late_s=late_s, spike_m=spike_m, spike_rad=spike_rad, seed=seed)
        if len(lasting_s) != 2 or lasting_s[0] > lasting_s[1]:
            raise ConfigError("lasting_s", lasting_s, "[least, most], seconds")
        check_sensor(source, Sensor.ODOMETRY, lie=lie)
        super().__init__(source)
        self._lie, self._seed = lie, seed
        self._every_s, self._lasting_s = every_s, lasting_s
        self._ratio, self._turn_rad_per_m, self._late_s = ratio, turn_rad_per_m, late_s
        self._spike = np.array([spike_m, spike_m, spike_rad])

    @property
    def rig(self) -> Rig:
        """Return the source's rig; without wheel odometry for `absent`."""
        rig = self._source.rig
        if self._lie != "absent":
            return rig
        return replace(rig, sensors=rig.sensors - {Sensor.ODOMETRY})

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations with wrong odometry."""
        rng = np.random.default_rng([self._seed, 2])
        spans = _Spans(self._every_s, self._lasting_s, rng)
        late = _Late(round(self._late_s * 1e9))
        T_true: Transform | None = None  # last odometry of the source ...
        T_spoilt = se3.identity()  # ... and as passed on
        stamp_ns = 0
        for observation in self._source:
            T_odom_base = observation.T_odom_base
            if T_odom_base is None or self._lie == "none" or not np.isfinite(T_odom_base).all():
                yield observation
                continue
            if T_true is None:
                T_spoilt = T_odom_base
            else:
                T_prev_curr = se3.inverse(T_true) @ T_odom_base
                duration_s = max((observation.stamp_ns - stamp_ns) * 1e-9, 1e-3)
                is_driving = np.linalg.norm(T_prev_curr[:3, 3]) > _DRIVING_M_S * duration_s
                is_lying = spans.covers(observation.stamp_ns, is_driving=bool(is_driving))
                T_spoilt = se3.chained(T_spoilt, self._motion(T_prev_curr, is_lying=is_lying))
            T_true, stamp_ns = T_odom_base, observation.stamp_ns
            if self._lie == "absent":
                yield replace(observation, T_odom_base=None)
            elif self._lie == "late":
                yield replace(observation, T_odom_base=locked(late.shift(stamp_ns, T_odom_base)))
            elif self._lie == "spikes" and spans.begins(stamp_ns):
                off = se3.from_xy_yaw(*rng.uniform(-self._spike, self._spike).tolist())
                yield replace(observation, T_odom_base=locked(T_odom_base @ off))
            else:
                yield replace(observation, T_odom_base=locked(T_spoilt))

    def _motion(self, T_prev_curr: Transform, *, is_lying: bool) -> Transform:
        """Return the reported motion for a true one T_prev_curr (4, 4) [m]."""
        ratio, turn_rad = 1.0, 0.0
        if self._lie == "scaled":
            ratio = self._ratio
        elif self._lie == "turning":
            turn_rad = self._turn_rad_per_m * float(np.linalg.norm(T_prev_curr[:3, 3]))
        elif is_lying and self._lie == "frozen":
            return se3.identity()
        elif is_lying and self._lie in LASTING:
            ratio = -1.0 if self._lie == "reversed" else self._ratio
        spoilt = T_prev_curr.copy()
        spoilt[:3, 3] *= ratio
        return np.asarray(spoilt @ se3.from_xy_yaw(0.0, 0.0, turn_rad))


@dataclass(slots=True)
class _Spans:
    """Draws the time spans of errors; a span begins only while the robot drives."""

    every_s: float
    lasting_s: list[float]
    rng: np.random.Generator
    _next_ns: int | None = field(default=None, init=False)
    _until_ns: int = field(default=0, init=False)

    def covers(self, stamp_ns: int, *, is_driving: bool) -> bool:
        """Tell whether a stamp is within a span; stamps must rise."""
        if self._next_ns is None:
            self._plan(stamp_ns)
        elif is_driving and stamp_ns >= self._next_ns:
            self._until_ns = stamp_ns + round(
                float(self.rng.uniform(self.lasting_s[0], self.lasting_s[1])) * 1e9
            )
            self._plan(self._until_ns)
        return stamp_ns < self._until_ns

    def begins(self, stamp_ns: int) -> bool:
        """Tell whether a single wrong pose is due."""
        if self._until_ns <= stamp_ns:
            return False
        self._until_ns = stamp_ns
        return True

    def _plan(self, stamp_ns: int) -> None:
        self._next_ns = stamp_ns + round(self.rng.uniform(0.5, 1.5) * self.every_s * 1e9)


@dataclass(slots=True)
class _Late:
    """Odometry with a delay."""

    late_ns: int
    _known: deque[tuple[int, Transform]] = field(default_factory=deque)

    def shift(self, stamp_ns: int, T_odom_base: Transform) -> Transform:
        """Return T_odom_base of `late_ns` before; the first one at the start."""
        self._known.append((stamp_ns, T_odom_base))
        wanted_ns = stamp_ns - self.late_ns
        while len(self._known) > 1 and self._known[1][0] <= wanted_ns:
            self._known.popleft()
        before_ns, T_before = self._known[0]
        if len(self._known) == 1 or before_ns >= wanted_ns:
            return T_before
        after_ns, T_after = self._known[1]
        ratio = (wanted_ns - before_ns) / (after_ns - before_ns)
        return se3.interpolate(T_before, T_after, ratio)
