"""CARMEN logs: a planar laser with odometry, as text."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros.pixels import locked
from sceneslam.sources.carmen_laser import mounting, reach_m
from sceneslam.sources.carmen_lines import (
    FLASER,
    LOGGER_STAMP,
    ROBOTLASER,
    ScanLine,
    parse_scan,
    position_of,
    stamp_of,
)
from sceneslam.sources.intrinsics import checked_above_zero
from sceneslam.sources.rising import continued_stamps, measured_stamps, rising_stamps
from sceneslam.sources.stamped_scans import StampedScans
from sceneslam.sources.survey.survey import Stream, Survey, spread
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.input_files import given_file
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Laser, Rig, Sensor, Wheels
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

_LOG = logging.getLogger(__name__)
_LATE_MAX_NS = 2_000_000_000  # stamps are out of order by less; a clock that is set jumps farther
_AXLE_M = 0.05  # a log does not say where the laser is above the axle: some centimetres off
_SAMPLES = 20  # scans that are read for a survey
_LASER_SAMPLES = 2000  # scans that are read for where the laser is, and how far it sees
_OFFSET = b"robot_frontlaser_offset"


class Carmen(StampedScans):
    """Gives one observation per FLASER or ROBOTLASER1 line, stamped by its `ipc_timestamp`.

    Odometry is that of the line; ODOM and RLASER lines are not used. Ranges of `range_max_m` [m]
    and beyond count as no return, as does a smaller number that the log writes for it. The laser is
    where most lines place it, else where the log's parameter does.

    Logs are stamped when a computer receives a scan, some late, in bursts and out of order.
    Observations come in the order in which the wheels' path is the shorter one, the lines' or the
    stamps', at the estimated times of measurement; `logged_ns` returns the log's stamps, by which
    relations refer to scans. Where the clock was set back or a stamp is missing, these are made to
    rise first. A log whose stamps never rise is stamped by its logger.
    """

    def __init__(self, path: str, range_max_m: float, wheels: Mapping[str, float] | None) -> None:
        self._range_max_m = checked_above_zero("range_max_m", range_max_m)
        self._path = given_file(path, "a CARMEN log")
        self._lines = self._scan_lines()
        scans = self._some_scans()
        logged_ns = _logged_stamps(self._lines)
        distinct_ns = _distinct_stamps(logged_ns)
        self._warn_of_changed(np.flatnonzero(distinct_ns != logged_ns), distinct_ns)
        order = _driven_order(self._lines, distinct_ns)
        self._lines = [self._lines[place] for place in order]
        self._logged_ns = distinct_ns[order]
        self._limit_m = self._no_return_m(scans)
        rig = Rig(
            sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}),
            laser=Laser(T_base_laser=self._T_base_laser(scans)),
            wheels=Wheels.given({"axle_m": _AXLE_M, **(wheels or {})}),
        )
        super().__init__(rig, measured_stamps(self._logged_ns))

    def __iter__(self) -> Iterator[Observation]:
        """Yield the scans by rising stamp."""
        self._faults.clear()
        stamps_ns = zip(self._stamps_ns.tolist(), self._logged_ns.tolist(), strict=True)
        for line, (stamp_ns, logged_ns) in zip(self._lines, stamps_ns, strict=True):
            scan = parse_scan(line)
            if scan is None:
                self._faults.add("scan line is invalid", f"{logged_ns * 1e-9:.3f} s: {self._path}")
            else:
                yield self._observation(scan, stamp_ns)

    def survey(self) -> Survey:
        """Return the stamps of the scans and some parsed scans with their odometry."""
        places = spread(len(self._lines), _SAMPLES)
        pairs = sorted({place for at in places for place in (at, min(at + 1, places[-1]))})
        parsed = [(int(self._stamps_ns[at]), parse_scan(self._lines[at])) for at in pairs]
        whole = [(stamp_ns, scan) for stamp_ns, scan in parsed if scan is not None]
        laser = Stream(
            sensor=Sensor.SCAN,
            place=self._path.name,
            count=len(self._lines),
            stamps_ns=self._stamps_ns,
        )
        wheels = replace(laser, sensor=Sensor.ODOMETRY)
        observations = [self._observation(scan, stamp_ns) for stamp_ns, scan in whole]
        return Survey(
            streams=[laser, wheels],
            scans=[one.scan for one in observations if one.scan is not None],
            odometry_ns=np.array([stamp_ns for stamp_ns, _ in whole], np.int64),
            T_odom_base=[scan.T_odom_base for _, scan in whole],
        )

    def logged_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the log's stamps (N,) of the scans at `stamps_ns` (N,)."""
        at = np.searchsorted(self._stamps_ns, stamps_ns).clip(max=len(self._stamps_ns) - 1)
        return np.where(self._stamps_ns[at] == stamps_ns, self._logged_ns[at], stamps_ns)

    def ground_truth(self) -> GroundTruth | None:
        """Return None: a log holds no ground truth (relations are files of the evaluation)."""
        return None

    def _observation(self, scan: ScanLine, stamp_ns: int) -> Observation:
        ranges_m = scan.ranges_m
        limit_m = min(self._limit_m, scan.range_max_m or np.inf)
        ranges_m[ranges_m <= 0] = np.nan
        ranges_m[ranges_m >= limit_m] = np.inf
        return Observation(
            stamp_ns=stamp_ns,
            scan=LaserScan(
                stamp_ns=stamp_ns,
                ranges_m=locked(ranges_m),
                angle_min_rad=scan.angle_min_rad,
                angle_step_rad=scan.angle_step_rad,
                range_min_m=0.0,
                range_max_m=limit_m,
            ),
            T_odom_base=locked(scan.T_odom_base),
        )

    def _warn_of_changed(self, changed: NDArray[np.int64], stamps_ns: NDArray[np.int64]) -> None:
        """Log stamps that were corrected; no data are lost, so this is not a fault."""
        if len(changed):
            _LOG.warning(
                "%d of %d scans, first at %.3f s, have stamps that do not rise; they were given "
                "rising ones: %s",
                len(changed),
                len(self._lines),
                stamps_ns[changed[0]] * 1e-9,
                self._path,
            )

    def _scan_lines(self) -> Sequence[bytes]:
        """Return the scan lines of the more frequent type: some logs use both for each scan."""
        lines = self._path.read_bytes().splitlines()
        new, old = ([one for one in lines if one.startswith(kind)] for kind in (ROBOTLASER, FLASER))
        return new if len(new) >= len(old) else old

    def _some_scans(self) -> Sequence[ScanLine]:
        """Return valid scans, spread over the log; raises InputError if it has none."""
        lines = [self._lines[at] for at in spread(len(self._lines), _LASER_SAMPLES)]
        scans = [scan for scan in map(parse_scan, lines) if scan]
        found = scans or [scan for scan in map(parse_scan, self._lines) if scan]
        if not found:
            raise InputError(f"no scans, expected FLASER or ROBOTLASER1 lines: {self._path}")
        return found

    def _no_return_m(self, scans: Sequence[ScanLine]) -> float:
        """Return the range [m] from which on there is no return."""
        limit_m = reach_m(scans, self._range_max_m)
        if limit_m < self._range_max_m:
            _LOG.info("ranges from %.3f m on are read as no return: %s", limit_m, self._path)
        return limit_m

    def _T_base_laser(self, scans: Sequence[ScanLine]) -> Transform:
        """Return where the lines or, without, the log's parameter place the laser (4, 4) [m]."""
        T_base_laser = mounting(scans)
        if T_base_laser is not None:
            return T_base_laser
        offset_m = self._offset_m()
        if any(scan.T_base_laser is not None for scan in scans):
            _LOG.warning(
                "the lines do not place the laser at one point of the robot; it is taken to be "
                "%.3f m in front of its centre: %s",
                offset_m,
                self._path,
            )
        return se3.from_xy_yaw(offset_m, 0.0, 0.0)

    def _offset_m(self) -> float:
        """Return the laser's distance [m] in front of the robot's centre, 0 if not logged.

        Raises InputError if it is not a finite number.
        """
        with self._path.open("rb") as file:
            for line in file:
                words = line.split()
                if words[:1] == [b"PARAM"] and words[1:2] == [_OFFSET] and len(words) > 2:
                    with suppress(ValueError):
                        if np.isfinite(offset_m := float(words[2])):
                            return offset_m
                    name, got = (word.decode(errors="replace")[:40] for word in words[1:3])
                    raise InputError(f"{name}: expected metres, got {got!r}: {self._path}")
        return 0.0


def _logged_stamps(lines: Sequence[bytes]) -> NDArray[np.int64]:
    """Return the stamps (N,) of receipt of all lines; those of the logger if none rises."""
    received_ns = np.array([stamp_of(line) for line in lines], dtype=np.int64)
    if len(lines) == 1 or (np.diff(received_ns) > 0).any():
        return received_ns
    _LOG.warning("no ipc_timestamp is after the one before: those of the logger are taken")
    return np.array([stamp_of(line, LOGGER_STAMP) for line in lines], dtype=np.int64)


def _distinct_stamps(logged_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a stamp of its own for each line (N,); rising by line where the clock was set."""
    late_ns = (np.maximum.accumulate(logged_ns) - logged_ns).max()
    if late_ns > _LATE_MAX_NS:
        return continued_stamps(logged_ns, _LATE_MAX_NS)
    order = np.argsort(logged_ns, kind="stable")
    distinct_ns = np.empty_like(logged_ns)
    distinct_ns[order] = rising_stamps(logged_ns[order])
    return distinct_ns


def _driven_order(lines: Sequence[bytes], stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the order (N,) of the lines or of the stamps, where the wheels' path is shorter."""
    positions_m = np.array([position_of(line) for line in lines])
    orders = np.arange(len(lines)), np.argsort(stamps_ns)

    def path_m(order: NDArray[np.int64]) -> float:
        return float(np.nansum(np.linalg.norm(np.diff(positions_m[order], axis=0), axis=1)))

    return min(orders, key=path_m)
