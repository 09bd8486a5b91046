"""Pictures made of a run's own recording: what the camera saw and where, and the rooms around."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf

from sceneslam.config.component import ComponentBuilder
from sceneslam.evaluation.association import interpolated
from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.paper.views import Cloud, draw_third_person
from sceneslam.interfaces import Source
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera
from sceneslam.types.trajectory import Trajectory

_THUMB_PX = 320
_EVERY_S = 0.5  # so often an image is taken for the rooms
_STRIDE_PX = 6


def source_of(folder: Path) -> Source:
    """Return the recording of a finished run."""
    config = OmegaConf.load(folder / "config.yaml")
    plain = cast(Mapping[str, Any], OmegaConf.to_container(config, resolve=True))
    source: Source = ComponentBuilder(plain).make("source", Source)
    return source


def draw_images(path: Path, folder: Path, stamps_ns: Sequence[int]) -> None:
    """Write a PNG: what the camera saw at some instants, and where the robot was (Fig. 4)."""
    seen = [one for one in _at(source_of(folder), stamps_ns) if one.image_bgr is not None]
    truth = Trajectory.read_tum(folder / "groundtruth.tum")
    start_ns = int(truth.stamps_ns[0])
    figure = look.new_figure(look.WIDTH_IN, 5.0)
    grid = figure.add_gridspec(2, len(seen), height_ratios=(1, 2))
    for number, one in enumerate(seen):
        axes = figure.add_subplot(grid[0, number])
        axes.imshow(_small(one)[..., ::-1])
        axes.set_title(f"{number + 1}: {(one.stamp_ns - start_ns) * 1e-9:.1f} s", fontsize=10)
        axes.set_axis_off()
    axes = figure.add_subplot(grid[1, :])
    axes.plot(*truth.positions_m[:, :2].T, color=look.MUTED, linewidth=1.2)
    where = interpolated(truth, np.array([one.stamp_ns for one in seen])).T_world_base
    for number, T_gt_base in enumerate(where):
        (x, y), (dx, dy) = T_gt_base[:2, 3], T_gt_base[:2, 0]
        axes.annotate("", (x + 0.5 * dx, y + 0.5 * dy), (x, y), arrowprops={"arrowstyle": "->"})
        axes.plot(x, y, "o", color=look.PALETTE[1], markersize=11)
        axes.text(x, y, str(number + 1), color=look.PAPER, fontsize=8, ha="center", va="center")
    look.style(axes, x_label="x [m]", y_label="y [m]")
    axes.set_aspect("equal")
    look.save(figure, path)


def draw_rooms(path: Path, folder: Path) -> None:
    """Write a PNG: the robot at its start, and what its camera saw of the rooms (Fig. 3)."""
    source = source_of(folder)
    truth = Trajectory.read_tum(folder / "groundtruth.tum")
    camera = source.rig.camera
    if camera is None:
        return
    parts = [_seen(one, camera, truth) for one in _every(source, _EVERY_S)]
    cloud = Cloud(
        points=np.concatenate([part.points for part in parts]),
        colors=np.concatenate([np.asarray(part.colors) for part in parts]),
    )
    draw_third_person(path, [cloud], {"path": truth}, [truth.T_world_base[0]])


def _seen(one: Observation, camera: Camera, truth: Trajectory) -> Cloud:
    """Return one image's points in `gt`, in its colours."""
    assert one.depth_m is not None and one.image_bgr is not None
    rows, columns = np.mgrid[: camera.size_wh[1] : _STRIDE_PX, : camera.size_wh[0] : _STRIDE_PX]
    z = one.depth_m[rows, columns].astype(float)
    x, y = (columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z
    T_gt_base = interpolated(truth, np.array([one.stamp_ns])).T_world_base[0]
    kept = z > 0
    points = se3.apply(T_gt_base @ camera.T_base_cam, np.stack([x, y, z], axis=-1)[kept])
    return Cloud(points=points, colors=one.image_bgr[rows, columns][kept][:, ::-1] / 255.0)


def _at(source: Source, stamps_ns: Sequence[int]) -> Iterator[Observation]:
    """Yield the observations at some instants, or right after."""
    wanted = sorted(stamps_ns)
    for one in source:
        if wanted and one.stamp_ns >= wanted[0]:
            yield one
            wanted.pop(0)


def _every(source: Source, period_s: float) -> Iterator[Observation]:
    """Yield images with depth, so much time apart at least."""
    last_ns: int | None = None
    for one in source:
        has_both = one.depth_m is not None and one.image_bgr is not None
        if has_both and (last_ns is None or one.stamp_ns - last_ns >= period_s * 1e9):
            last_ns = one.stamp_ns
            yield one


def _small(one: Observation) -> NDArray[np.uint8]:
    assert one.image_bgr is not None
    height, width = one.image_bgr.shape[:2]
    size_wh = (_THUMB_PX, round(_THUMB_PX * height / width))
    return np.asarray(cv2.resize(one.image_bgr, size_wh, interpolation=cv2.INTER_AREA))
