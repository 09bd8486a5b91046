"""Ray casting against the panels of a place (Open3D's Embree scene)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.places.place import Panel
from sceneslam.types.errors import InputError

Rays = NDArray[np.float32]  # (N, 6): origin [m], direction


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hits:
    """The first intersections of rays with panels; without one, the reach is infinite."""

    reach: NDArray[np.float32]  # (N,), distance in lengths of the ray's direction
    triangle: NDArray[np.int64]  # (N,), two per panel; 0 without an intersection
    uv: NDArray[np.float32]  # (N, 2), barycentric


class RayCaster:
    """Casts rays against panels, each two triangles: (corner, +u, +v) and its opposite."""

    def __init__(self, panels: Sequence[Panel]) -> None:
        open3d = _load_open3d()
        self._tensor: Any = open3d.core.Tensor
        self._scene: Any = open3d.t.geometry.RaycastingScene(nthreads=1)
        vertices, triangles = _mesh(panels)
        self._count = len(panels)
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles))

    def first_hits(self, rays: Rays) -> Hits:
        """Return the first intersections of rays (N, 6), gt: origin [m], direction."""
        answer = self._scene.cast_rays(self._tensor.from_numpy(rays), nthreads=1)
        triangle = answer["primitive_ids"].numpy().astype(np.int64)
        reach = answer["t_hit"].numpy()
        triangle[~np.isfinite(reach)] = 0
        return Hits(reach=reach, triangle=triangle, uv=answer["primitive_uvs"].numpy())

    def first_panels(self, rays: Rays) -> NDArray[np.int32]:
        """Return the index (N,) of the first panel of rays (N, 6), gt; else the panel count."""
        answer = self._scene.cast_rays(self._tensor.from_numpy(rays), nthreads=1)
        panel = answer["primitive_ids"].numpy() >> 1
        return np.asarray(np.minimum(panel, np.uint32(self._count)), np.int32)

    def is_blocked(self, rays: Rays, reach: float) -> NDArray[np.bool_]:
        """Return (N,) whether a panel lies within `reach` direction lengths on rays (N, 6), gt."""
        blocked = self._scene.test_occlusions(
            self._tensor.from_numpy(rays), tnear=0.0, tfar=reach, nthreads=1
        )
        return np.asarray(blocked.numpy(), dtype=np.bool_)


def _mesh(panels: Sequence[Panel]) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    corner = np.stack([panel.corner_m for panel in panels])
    u = np.stack([panel.edge_u_m for panel in panels])
    v = np.stack([panel.edge_v_m for panel in panels])
    vertices = np.stack([corner, corner + u, corner + v, corner + u + v], axis=1)
    first = 4 * np.arange(len(panels))[:, None, None]
    triangles = first + np.array([[0, 1, 2], [3, 2, 1]])
    return (
        vertices.reshape(-1, 3).astype(np.float32),
        triangles.reshape(-1, 3).astype(np.uint32),
    )


def _load_open3d() -> Any:
    try:
        import open3d
    except ImportError as err:
        raise InputError(
            f"the simulator needs Open3D, which cannot be loaded ({err}); "
            "on Debian or Ubuntu type: sudo apt-get install -y libegl1 libgl1 libusb-1.0-0"
        ) from err
    return open3d
