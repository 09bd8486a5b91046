"""Description of a saved map, and of its errors, in sentences."""

from __future__ import annotations

import numpy as np

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import CELL_M
from sceneslam.atlas.submaps.graph import connected, misfit, off_nodes

_CHI2_6 = 22.46  # six degrees of freedom, p = 0.001


def described(saved: SavedMap) -> list[str]:
    """Return the map's contents, a line per piece."""
    loops = sum(edge.is_loop for edge in saved.edges)
    lines = [
        f"submaps: {len(saved.submaps)}, runs: {saved.run_count}, "
        f"edges: {len(saved.edges)}, of them loops: {loops}"
    ]
    for piece in np.unique(saved.pieces).tolist():
        own = saved.nodes(piece)
        plan = saved.plan(piece)
        modules = sorted({saved.submaps[node].module or "(bridged)" for node in own})
        known = np.concatenate([plan.points, plan.free_points()])
        x_m, y_m = np.ptp(known, axis=0) + CELL_M if len(known) else (0.0, 0.0)
        lines.append(
            f"piece {piece}: submaps: {len(own)}, by {', '.join(modules)}; "
            f"{x_m:.1f} m x {y_m:.1f} m, "
            f"free: {plan.free.sum() * CELL_M**2:.1f} m2, wall cells: {len(plan)}, "
            f"views: {sum(len(saved.submaps[node].views) for node in own)}"
        )
    return lines


def flaws(saved: SavedMap) -> list[str]:
    """Return a sentence for each inconsistency."""
    found = []
    for piece in np.unique(saved.pieces).tolist():
        own = saved.nodes(piece)
        lost = set(own) - set(connected(own, saved.edges)[0])
        if lost:
            found.append(f"piece {piece}: no edge connects submaps {_some(lost)} with the rest")
    for number, edge in enumerate(saved.edges):
        name = f"edge {number} ({edge.kind.name.lower()}) from {edge.first} to {edge.second}"
        if saved.pieces[edge.first] != saved.pieces[edge.second]:
            found.append(f"{name}: its submaps are in two pieces")
        elif misfit(edge, saved.T_map_node) > _CHI2_6:
            off = off_nodes(edge, saved.T_map_node)
            found.append(
                f"{name}: the submaps lie {np.linalg.norm(off[:3]):.2f} m and "
                f"{np.degrees(np.linalg.norm(off[3:])):.1f} degrees from where it was measured"
            )
    return found


def _some(nodes: set[int]) -> str:
    names = [str(node) for node in sorted(nodes)]
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
