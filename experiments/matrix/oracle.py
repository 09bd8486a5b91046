"""The oracle: the best choice of one module per piece of the drive, made with the truth in hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_STEP_S = 0.2  # the drive is looked at so often
_GAP_NS = 5 * 10**8  # a module without a pose for so long has none there
_BEAM = 256  # choices that are followed at a time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Choice:
    """What was chosen so far."""

    cost_m2: float  # the squared errors of all poses so far, added up
    pieces: tuple[NDArray[np.float64], ...]  # (N, 4, 4) T_map_base, one per piece
    T_map_modules: tuple[Transform | None, ...]  # where each module's own frame was put last

    @property
    def T_map_base(self) -> Transform:
        """Return the pose that the next piece begins at."""
        return self.pieces[-1][-1] if self.pieces else se3.identity()


def best_of(modules: Sequence[Trajectory], truth: Trajectory, piece_s: float) -> Trajectory:
    """Return the trajectory of an oracle that knows which module errs least in each piece.

    All modules ran side by side over the whole drive, and the drive is cut into pieces of
    `piece_s`. A piece is one module's estimate. It begins where the piece before it ended, or lies
    in the module's own frame: as that was put when the module was last chosen, or as its whole path
    fits the truth best. So a module that recognises a place takes the drift since then back. Of all
    choices (a beam search) it is the one with the smallest absolute error, and no worse than the
    best module alone. In a piece that no module covers it knows the true motion.
    """
    stamps_ns = _stamps_ns(truth)
    T_gt_base = interpolated(truth, stamps_ns).T_world_base
    true = se3.inverse(T_gt_base[0]) @ T_gt_base
    told = [_poses(module, stamps_ns) for module in modules]
    fitted = [_fitted(poses, true) for poses in told]
    choices = [_Choice(cost_m2=0.0, pieces=(), T_map_modules=(None,) * len(modules))]
    for piece in _pieces(len(stamps_ns), piece_s):
        longer = [
            one for choice in choices for one in _continued(choice, told, fitted, true, piece)
        ]
        choices = sorted(longer, key=lambda choice: choice.cost_m2)[:_BEAM]
    found = [Trajectory(stamps_ns=stamps_ns, T_world_base=_joined(one)) for one in choices]
    whole = [
        Trajectory(stamps_ns=stamps_ns, T_world_base=poses)
        for poses in told
        if not np.isnan(poses).any()
    ]
    return min([*found, *whole], key=lambda one: absolute_errors(one, truth, _STEP_S).rmse_m)


def _stamps_ns(truth: Trajectory) -> NDArray[np.int64]:
    first_ns, last_ns = truth.stamps_ns[[0, -1]]
    step_ns = round(_STEP_S * 1e9)
    return np.asarray(np.arange(first_ns, last_ns + 1, step_ns, dtype=np.int64))


def _pieces(count: int, piece_s: float) -> Iterator[slice]:
    """Yield the pieces of a drive; one begins with the pose that the one before ended with."""
    length = max(round(piece_s / _STEP_S), 1)
    ends = [*range(0, count - 1, length), count - 1]
    for first, last in pairwise(ends):
        yield slice(first, last + 1)


def _poses(module: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a module's poses (N, 4, 4), NaN where it has none."""
    poses = np.full((len(stamps_ns), 4, 4), np.nan)
    if len(module) < 2:
        return poses
    following = np.clip(np.searchsorted(module.stamps_ns, stamps_ns), 1, len(module) - 1)
    is_inside = (stamps_ns >= module.stamps_ns[0]) & (stamps_ns <= module.stamps_ns[-1])
    is_told = is_inside & (np.diff(module.stamps_ns)[following - 1] < _GAP_NS)
    poses[is_told] = interpolated(module, stamps_ns[is_told]).T_world_base
    return poses


def _continued(
    choice: _Choice,
    told: Sequence[NDArray[np.float64]],
    fitted: Sequence[Transform | None],
    true: NDArray[np.float64],
    piece: slice,
) -> Iterator[_Choice]:
    """Yield a choice with each way to go on: chained, or in a module's own frame."""
    offered = [k for k, poses in enumerate(told) if not np.isnan(poses[piece]).any()]
    if not offered:
        motion = se3.inverse(true[piece][0]) @ true[piece]
        yield _with(choice, choice.T_map_base @ motion, true[piece])
    for k in offered:
        poses = told[k][piece]
        chained = choice.T_map_base @ se3.inverse(poses[0])
        frames = [chained, choice.T_map_modules[k], fitted[k]]
        for T_map_module in (frame for frame in frames if frame is not None):
            placed = [*choice.T_map_modules]
            placed[k] = T_map_module
            yield _with(choice, T_map_module @ poses, true[piece], tuple(placed))


def _fitted(poses: NDArray[np.float64], true: NDArray[np.float64]) -> Transform | None:
    """Return a module's frame (4, 4) as its poses (N, 4, 4) fit the true ones best."""
    is_known = ~np.isnan(poses).any(axis=(1, 2))
    return align(poses[is_known], true[is_known]) if is_known.any() else None


def _with(
    choice: _Choice,
    T_map_base: NDArray[np.float64],
    true: NDArray[np.float64],
    T_map_modules: tuple[Transform | None, ...] | None = None,
) -> _Choice:
    errors_m = (T_map_base - true)[1:, :3, 3]
    return _Choice(
        cost_m2=choice.cost_m2 + float(np.sum(errors_m**2)),
        pieces=(*choice.pieces, T_map_base),
        T_map_modules=choice.T_map_modules if T_map_modules is None else T_map_modules,
    )


def _joined(choice: _Choice) -> NDArray[np.float64]:
    first, *others = choice.pieces
    return np.concatenate([first, *(piece[1:] for piece in others)])
