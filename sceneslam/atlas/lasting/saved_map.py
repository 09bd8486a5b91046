"""A saved map: submaps, their poses, and the measured motions between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import FloorPlan, check_size, join
from sceneslam.atlas.submaps.graph import connected, fits
from sceneslam.atlas.submaps.submap import Drawing, Submap
from sceneslam.atlas.submaps.uprights import are_on_floor, are_steady, mount, turning_axis, usual_up
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.motion.tilt import upright
from sceneslam.types import planar, se3
from sceneslam.types.maps import PoseGraphLayer
from sceneslam.types.planar import Planar
from sceneslam.types.se3 import Transform
from sceneslam.views.placed_views import are_covered
from sceneslam.views.view import Landmarks

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovingPart:
    """What the graph needs of a map in which some nodes are optimised again."""

    motions: tuple[Edge, ...]  # between these nodes
    loops: tuple[Edge, ...]
    fixed: tuple[int, ...]  # all others, and the first of these nodes
    loose: tuple[int, ...]  # the first node of each part that no edge connects with that one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SavedMap:
    """The graph of all runs; nodes of one piece lie in one frame, pieces are not connected."""

    submaps: tuple[Submap, ...]
    T_map_node: NDArray[np.float64]  # (N, 4, 4)
    pieces: NDArray[np.int64]  # (N,), piece of every node; 0 is the first
    edges: tuple[Edge, ...]

    @property
    def runs(self) -> int:
        """Return how many runs the map was made from."""
        return 1 + max((submap.run for submap in self.submaps), default=-1)

    @property
    def run_count(self) -> int:
        """Return how many of these runs have submaps left."""
        return len({submap.run for submap in self.submaps})

    @property
    def apart(self) -> int:
        """Return how many pieces there are beside the first."""
        return max(len(np.unique(self.pieces)) - 1, 0)

    @property
    def plane(self) -> NDArray[np.float64]:
        """Return the nodes (N, 3) in the plane [m, m, rad]."""
        return planar.from_transforms(self.T_map_node)

    def plan(self, piece: int = 0) -> FloorPlan:
        """Return the floor plan of a piece, in its frame; raises InputError as `check_size`."""
        return join(self._placed(piece), newest_wins=True)

    def check_size(self) -> None:
        """Raise InputError if the plan of the first piece, which runs load, is too large."""
        check_size(self._placed(0))

    def views(self, piece: int = 0) -> list[tuple[Transform, Landmarks]]:
        """Return what a camera saw in a piece, and T_map_cam (4, 4) where it was seen from."""
        return self.views_of(self.nodes(piece))

    def views_of(self, nodes: Sequence[int]) -> list[tuple[Transform, Landmarks]]:
        """Return the same of these submaps."""
        return [
            (self.T_map_node[node] @ view.T_submap_cam, view.landmarks)
            for node in nodes
            for view in self.submaps[node].views
        ]

    def nodes(self, piece: int = 0) -> list[int]:
        """Return the nodes of a piece."""
        return np.flatnonzero(self.pieces == piece).tolist()

    def moving(self, nodes: Sequence[int]) -> MovingPart:
        """Return the edges within nodes, and which nodes hold them."""
        inside = set(nodes)
        edges = [edge for edge in self.edges if edge.first in inside and edge.second in inside]
        still = {*range(len(self.submaps))} - inside
        firsts = [part[0] for part in connected(nodes, edges)]
        return MovingPart(
            motions=tuple(edge for edge in edges if not edge.is_loop),
            loops=tuple(edge for edge in edges if edge.is_loop),
            fixed=(*sorted(still), *firsts[:1]),
            loose=tuple(firsts[1:]),
        )

    def without_misfits(self) -> SavedMap:
        """Return the map without loops that its nodes contradict: their places were similar."""
        kept = (edge for edge in self.edges if not edge.is_loop or fits(edge, self.T_map_node))
        return replace(self, edges=tuple(kept))

    def without_guesses(self) -> SavedMap:
        """Return the map without the edges between two pieces: nothing measured those."""
        pieces = self.pieces
        kept = (edge for edge in self.edges if pieces[edge.first] == pieces[edge.second])
        return replace(self, edges=tuple(kept))

    def nearest(self, T_map_base: Transform, piece: int = 0) -> int:
        """Return the submap of a piece that begins nearest to a pose (4, 4)."""
        away_m = np.linalg.norm((self.T_map_node - T_map_base)[:, :3, 3], axis=1)
        return int(np.argmin(np.where(self.pieces == piece, away_m, np.inf)))

    def loop_to(
        self,
        T_map_node: Transform,
        covariance: NDArray[np.float64],
        node: int,
        *,
        piece: int = 0,
        first: int = 0,
    ) -> Edge:
        """Return the loop to a node at a pose (4, 4) from the nearest submap of a piece.

        Submaps are counted from `first`. The covariance (6, 6) is in the axes of the node.
        """
        nearest = self.nearest(T_map_node, piece)
        return Edge(
            first=first + nearest,
            second=node,
            T_first_second=se3.inverse(self.T_map_node[nearest]) @ T_map_node,
            covariance=covariance,
            kind=EdgeKind.LOOP,
        )

    def standing(self, T_map_base: Transform, piece: int = 0) -> Transform:
        """Return a pose (4, 4) with the height and tilt of a robot on the floor of a piece there.

        That is the floor of the submap that begins nearest to it. A base that is mounted askew has
        the same tilt everywhere, whichever way it looks; on a ramp it has not. Where the map was
        made by hand, the floor is level.
        """
        own = self.nodes(piece)
        nodes = self.T_map_node[own]
        askew = mount(turning_axis(nodes))
        ups_base = (np.tile(T[2, :3], (len(nodes), 1)) for T in (askew, se3.identity()))
        if not are_steady(nodes, *ups_base):
            askew = se3.identity()
        T_map_nearest = self.T_map_node[self.nearest(T_map_base, piece)]
        T_map_floor = T_map_nearest @ se3.inverse(askew)
        floor = planar.from_transform(T_map_nearest)  # as its plan is placed
        up_map = usual_up([self.submaps[node] for node in own], nodes, askew[2, :3])
        edges = [edge for edge in self.edges if self.pieces[edge.first] == piece]
        if not are_on_floor(edges, self.T_map_node, askew[2, :3], up_map):
            level = upright(se3.identity(), up_map)
            T_map_floor = se3.inverse(level) @ upright(level @ T_map_floor, _UP)
            askew, floor = se3.identity(), planar.from_transform(T_map_floor)
        base = planar.from_transform(T_map_base)
        stood = T_map_floor @ planar.to_transform(planar.between(floor, base)) @ askew
        stood[:2, 3] = T_map_base[:2, 3]
        return np.asarray(stood)

    def graph(self) -> PoseGraphLayer:
        """Return nodes and edges as a layer."""
        edges = self.edges
        ends = np.array([(edge.first, edge.second) for edge in edges], np.int64)
        information = [np.linalg.inv(edge.covariance) for edge in edges]
        return PoseGraphLayer(
            stamps_ns=np.array([submap.stamps_ns[0] for submap in self.submaps], np.int64),
            T_world_base=self.T_map_node,
            edges=ends.reshape(-1, 2),
            T_from_to=np.array([edge.T_first_second for edge in edges]).reshape(-1, 4, 4),
            information=np.array(information).reshape(-1, 6, 6),
            is_loop=np.array([edge.is_loop for edge in edges], bool),
        )

    def of(self, keep: Sequence[int]) -> SavedMap:
        """Return the map of the nodes `keep`, with the edges between them."""
        number = {node: index for index, node in enumerate(keep)}
        return SavedMap(
            submaps=tuple(self.submaps[node] for node in keep),
            T_map_node=self.T_map_node[list(keep)].reshape(-1, 4, 4),
            pieces=self.pieces[list(keep)],
            edges=tuple(
                replace(edge, first=number[edge.first], second=number[edge.second])
                for edge in self.edges
                if edge.first in number and edge.second in number
            ),
        )

    def _placed(self, piece: int) -> list[tuple[Planar, FloorPlan]]:
        """Return the plans of a piece with their poses in its frame, oldest first."""
        plane = self.plane
        return [(plane[node], self.submaps[node].plan) for node in self.nodes(piece)]


def empty_map() -> SavedMap:
    """Return an empty map."""
    return SavedMap(
        submaps=(), T_map_node=np.zeros((0, 4, 4)), pieces=np.zeros(0, np.int64), edges=()
    )


def forget_contradicted(saved: SavedMap, run: int) -> SavedMap:
    """Return the map without walls of earlier runs that stand where `run` saw free space.

    That is in the first piece, which runs load.
    Likewise free cells of earlier runs are removed where this run saw a wall. Within one cell, the
    registration's accuracy, nothing is removed. Earlier views go where this run has one nearby.
    """
    newest = [index for index in saved.nodes() if saved.submaps[index].run == run]
    if not newest:
        return saved
    plane = saved.plane
    today = join([(plane[i], saved.submaps[i].plan) for i in newest])
    views_today = saved.views_of(newest)
    submaps = list(saved.submaps)
    for index, submap in enumerate(saved.submaps):
        if submap.run == run or saved.pieces[index] != 0:
            continue
        drawing = submap.drawing
        if len(submap.plan):
            drawing = Drawing(_without(submap.plan, plane[index], today))
        is_old = are_covered(saved.views_of([index]), views_today)
        views = tuple(compress(submap.views, ~is_old))
        submaps[index] = replace(submap, drawing=drawing, views=views)
    return replace(saved, submaps=tuple(submaps))


def _without(plan: FloorPlan, T_today_plan: planar.Planar, today: FloorPlan) -> FloorPlan:
    """Return a plan without what `today`, in which it lies at T_today_plan, contradicts."""
    points = planar.apply(T_today_plan, plan.points.astype(np.float64))
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    inner = cv2.erode(today.free.astype(np.uint8), cross) > 0  # with free cells on all sides
    kept = ~replace(today, free=inner).is_free(points)
    free = plan.free.copy()
    walls = planar.apply(planar.between(T_today_plan, np.zeros(3)), today.points.astype(np.float64))
    cells = plan.cells(walls)
    rows, columns = free.shape
    inside = ((cells >= 0) & (cells < [columns, rows])).all(axis=1)
    free[cells[inside, 1], cells[inside, 0]] = False
    return replace(plan, points=plan.points[kept], normals=plan.normals[kept], free=free)
