"""Final results of a run for the Rerun viewer: map, revised trajectory, ground truth, errors."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneslam.sinks import rerun_layout as at
from sceneslam.types.maps import GridLayer
from sceneslam.types.run import RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, placed_by_pose

if TYPE_CHECKING:
    import rerun as rr

_TRUTH_GAP_NS = 50_000_000  # between a pose and its true one, for errors
_OCCUPIED_LOG_ODDS = 0.85  # 0.7
_POINTS_MAX = 200_000  # of one module
Colors = Mapping[str, tuple[int, int, int]]


def write_end(
    recording: rr.RecordingStream,
    result: RunResult,
    truth: GroundTruth | None,
    first: tuple[int, Transform] | None,
    start_ns: int,
    colors: Colors,
) -> None:
    """Log all results at the recording's current time; `first` is the first stamp and T_map_base.

    The ground truth is aligned with the estimate at that pose, so errors are relative to it.
    """
    _write_map(recording, result, colors)
    _write_revised(recording, result, colors)
    if truth is None or first is None:
        return
    placed = _placed(truth.trajectory, *first)
    if placed is not None:
        _write_truth(recording, placed)
        for name, estimate in (("online", result.online), ("revised", result.trajectory)):
            _write_errors(recording, f"{at.ERRORS}/{name}", estimate, placed, start_ns)


def _write_map(recording: rr.RecordingStream, result: RunResult, colors: Colors) -> None:
    import rerun as rr

    hybrid = result.map
    for number, key in enumerate(hybrid.modules):
        chosen = np.flatnonzero(hybrid.point_modules == number)
        chosen = chosen[:: 1 + len(chosen) // _POINTS_MAX]
        points, seen_bgr = hybrid.points.points[chosen], hybrid.points.colors_bgr
        seen = [colors[key]] if seen_bgr is None else seen_bgr[chosen, ::-1]
        for name, shades in ((at.BY_MODULE, [colors[key]]), (at.AS_SEEN, seen)):
            cloud = rr.Points3D(points, colors=shades, radii=[0.01])
            recording.log(f"{name}/{key}", cloud)
    if hybrid.grid is not None:
        walls = rr.Points3D(_walls(hybrid.grid), colors=[at.BRIDGED_RGB], radii=[0.02])
        recording.log(f"{at.MAP}/grid", walls)


def _walls(grid: GridLayer) -> NDArray[np.float64]:
    """Return the centres of the occupied cells (N, 3) [m], map."""
    rows, columns = np.nonzero(grid.log_odds > _OCCUPIED_LOG_ODDS)
    centres = (np.stack([columns, rows], axis=1) + 0.5) * grid.resolution_m + grid.origin_xy_m
    return np.column_stack([centres, np.zeros(len(centres))])


def _write_revised(recording: rr.RecordingStream, result: RunResult, colors: Colors) -> None:
    import rerun as rr

    path, strips, shades, begin = result.trajectory.positions_m, [], [], 0
    for key, run in groupby(result.modules):
        end = begin + len(list(run))
        strips.append(path[max(begin - 1, 0) : end])  # a segment belongs to the pose at its end
        shades.append(colors.get(key, at.BRIDGED_RGB))
        begin = end
    recording.log(at.REVISED, rr.LineStrips3D(strips, colors=shades, radii=[0.02]))


def _placed(true: Trajectory, stamp_ns: int, T_map_base: Transform) -> Trajectory | None:
    """Return the true trajectory in `map`, None if it does not cover the stamp."""
    T_map_gt = placed_by_pose(true, stamp_ns, T_map_base)
    if T_map_gt is None:
        return None
    return Trajectory(stamps_ns=true.stamps_ns, T_world_base=T_map_gt @ true.T_world_base)


def _write_truth(recording: rr.RecordingStream, true: Trajectory) -> None:
    import rerun as rr

    strip = rr.LineStrips3D([true.positions_m], colors=[at.TRUTH_RGB], radii=[0.005])
    recording.log(at.TRUTH, strip, static=True)


def _write_errors(
    recording: rr.RecordingStream, path: str, estimate: Trajectory, true: Trajectory, start_ns: int
) -> None:
    """Log the position error [m] of every pose."""
    import rerun as rr

    after = np.clip(np.searchsorted(true.stamps_ns, estimate.stamps_ns), 1, len(true) - 1)
    is_before = 2 * estimate.stamps_ns < true.stamps_ns[after] + true.stamps_ns[after - 1]
    nearest = np.maximum(after - is_before, 0)
    known = np.abs(true.stamps_ns[nearest] - estimate.stamps_ns) <= _TRUTH_GAP_NS
    if not known.any():
        return
    errors_m = np.linalg.norm(estimate.positions_m - true.positions_m[nearest], axis=1)[known]
    times = rr.TimeColumn(at.TIMELINE, duration=(estimate.stamps_ns[known] - start_ns) * 1e-9)
    recording.send_columns(path, indexes=[times], columns=rr.Scalars.columns(scalars=errors_m))
