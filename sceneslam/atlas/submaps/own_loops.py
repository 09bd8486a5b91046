"""Loops that modules measured themselves, as motions between two stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.covariance import covariance_of
from sceneslam.types.maps import MapLayers
from sceneslam.types.se3 import Transform

Path = Callable[[int], Transform | None]  # T_run_base at a stamp, None without a pose

_UNMEASURED = 1e-6  # 1/m^2, 1/rad^2: information in a direction that was not measured
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
    return [
        OwnLoop(
            from_ns=int(graph.stamps_ns[first]),
            to_ns=int(graph.stamps_ns[second]),
            T_from_to=T_from_to,
            covariance=covariance_of(information, unmeasured=_UNMEASURED) + _ROUNDING,
        )
        for graph in (layers.pose_graph for layers in maps)
        if graph is not None
        for (first, second), T_from_to, information, is_loop in zip(
            graph.edges, graph.T_from_to, graph.information, graph.is_loop, strict=True
        )
        if is_loop
    ]
