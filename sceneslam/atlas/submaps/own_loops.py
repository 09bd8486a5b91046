"""Loops that modules measured themselves, as motions between two stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types.covariance import covariance_of
from sceneslam.types.maps import MapLayers
from sceneslam.types.se3 import Transform

Path = Callable[[int], Transform | None]  # T_run_base at a stamp, None without a pose

_UNMEASURED = 1e-6  # 1/m^2, 1/rad^2: information in a direction that was not measured
_ROUNDING = np.diag(np.full(6, 1e-6))  # makes a covariance invertible: 1 mm, 1 mrad


def closed_loops(maps: Sequence[MapLayers]) -> list[Edge]:
    """Return the loops within each map, by which its module corrected it, from stamp to stamp."""
    return [
        Edge(
            first=int(graph.stamps_ns[first]),
            second=int(graph.stamps_ns[second]),
            T_first_second=T_from_to,
            covariance=covariance_of(information, unmeasured=_UNMEASURED) + _ROUNDING,
            kind=EdgeKind.LOOP,
        )
        for graph in (layers.pose_graph for layers in maps)
        if graph is not None
        for (first, second), T_from_to, information, is_loop in zip(
            graph.edges, graph.T_from_to, graph.information, graph.is_loop, strict=True
        )
        if is_loop
    ]
