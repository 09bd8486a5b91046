"""Loops that modules measured themselves, as motions between two stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.maps import MapLayers
from sceneslam.types.se3 import Transform

Path = Callable[[int], Transform | None]  # T_run_base at a stamp, None without a pose

_ROUNDING = np.diag(np.full(6, 1e-6))  # makes a covariance invertible: 1 mm, 1 mrad
_OPEN = 1e6  # m^2, rad^2: largest variance, of a direction that was not measured


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OwnLoop:
    """A motion between two stamps of a run."""

    from_ns: int
    to_ns: int
    T_from_to: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order, axes of `to`


def closed_loops(maps: Sequence[MapLayers]) -> list[OwnLoop]:
    """Return the loops within each map, by which its module corrected the map."""
    return [
        OwnLoop(
            from_ns=int(graph.stamps_ns[first]),
            to_ns=int(graph.stamps_ns[second]),
            T_from_to=T_from_to,
            covariance=_inverse(information) + _ROUNDING,
        )
        for graph in (layers.pose_graph for layers in maps)
        if graph is not None
        for (first, second), T_from_to, information, is_loop in zip(
            graph.edges, graph.T_from_to, graph.information, graph.is_loop, strict=True
        )
        if is_loop
    ]


def _inverse(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6); the information is 0 in directions that were not measured."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray((vectors / np.maximum(values, 1.0 / _OPEN)) @ vectors.T)
