"""Loops that modules measured themselves, as motions between two stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.maps import LoopLayer, MapLayers
from sceneslam.types.se3 import Transform

Path = Callable[[int], Transform | None]  # T_run_base at a stamp, None without a pose

_ROUNDING = np.diag(np.full(6, 1e-6))  # makes a covariance invertible: 1 mm, 1 mrad


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OwnLoop:
    """A motion between two stamps of a run."""

    from_ns: int
    to_ns: int
    T_from_to: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order, axes of `to`


def closed_loops(maps: Sequence[MapLayers]) -> list[OwnLoop]:
    """Return the loops within each map, by which its module corrected the map."""
    found = []
    for graph in (layers.pose_graph for layers in maps):
        if graph is None:
            continue
        rows = np.flatnonzero(graph.is_loop)
        stamps_ns = graph.stamps_ns[graph.edges[rows]]
        found += _loops(stamps_ns, graph.T_from_to[rows], graph.information[rows])
    return found


def recognized_loops(maps: Sequence[MapLayers]) -> list[OwnLoop]:
    """Return the loops from each map to earlier maps of the same module."""
    layers = [layer.loops for layer in maps if layer.loops is not None]
    return [loop for layer in layers for loop in _of(layer)]


def _of(layer: LoopLayer) -> list[OwnLoop]:
    return _loops(layer.stamps_ns, layer.T_from_to, layer.information)


def _loops(
    stamps_ns: NDArray[np.int64],
    T_from_to: NDArray[np.float64],
    information: NDArray[np.float64],
) -> list[OwnLoop]:
    return [
        OwnLoop(
            from_ns=from_ns,
            to_ns=to_ns,
            T_from_to=T,
            covariance=np.linalg.pinv(matrix, hermitian=True) + _ROUNDING,
        )
        for (from_ns, to_ns), T, matrix in zip(
            stamps_ns.tolist(), T_from_to, information, strict=True
        )
    ]
