"""Show what the simulator renders, and what it costs.

    python experiments/simulator.py sheet sheet.png +scenario=office_tour
    python experiments/simulator.py zones +scenario=office_tour
    python experiments/simulator.py cost +scenario=bright_to_dark
    python experiments/simulator.py cost +scenario=office_tour

`sheet` writes colour over depth of frames all along the story, with zone, exposure, grey mean and
share of depth. `zones` prints medians of what the sensors measure in each zone. `cost` prints CPU
time, which does not depend on what else the machine does.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from hydra import compose, initialize_config_module
from numpy.typing import NDArray
from omegaconf import OmegaConf

from sceneslam.sources.simulator import settings, stories
from sceneslam.sources.simulator.optics.exposure import follow
from sceneslam.sources.simulator.places.floor import BuildingLayout
from sceneslam.sources.simulator.robot import motion
from sceneslam.sources.simulator.shot import (
    Photographer,
    Shot,
    SimulatedFrame,
    build_place,
    floor_plan,
    light_place,
    meter,
)

_TILES = (6, 8)  # rows, columns
_TILE_WH = (320, 240)
_EVERY_S = 2.0  # of the zones' frames
_MEASURED = 40  # frames of the cost


def main() -> None:
    """Do what the command line says."""
    what, *rest = sys.argv[1:]
    cv2.setNumThreads(1)
    if what == "sheet":
        path, *overrides = rest
        cv2.imwrite(path, _sheet(_make_ready(overrides)))
        print(Path(path).resolve())
    elif what == "zones":
        _print_zones(_make_ready(rest))
    elif what == "cost":
        _print_cost(rest)
    else:
        raise SystemExit(f"got {what!r}, allowed: sheet, zones, cost")


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenery:
    """A story made ready to be rendered."""

    shot: Shot
    plan: BuildingLayout
    length: int  # frames

    def zone(self, time_s: float) -> str:
        """Return the name of the zone in which the robot is, or nothing."""
        x_m, y_m = self.shot.path.pose(time_s)[:2, 3].tolist()
        return next((zone.name for zone in self.plan.zones if zone.holds(x_m, y_m)), "")


def _make_ready(overrides: Sequence[str]) -> Scenery:
    """Return the story of a configuration, its place built and lit."""
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        config = OmegaConf.to_container(
            compose("config", overrides=list(overrides)).source, resolve=True
        )
    assert isinstance(config, dict)
    seed, order = config["seed"], config["order"]
    story = stories.find(config["story"], order)
    plan, place = floor_plan(story.place, order), build_place(story.place, seed, order)
    camera = settings.read(settings.CameraSettings, "camera", config["camera"])
    exposure = settings.read(settings.ExposureSettings, "exposure", config["exposure"])
    path = motion.plan(story.start_x_y_deg, story.moves, plan.floor)
    length = int(path.duration_s * camera.rate_hz + 1e-6)
    shot = Shot(
        story=story,
        lights=config["lights"],
        seed=seed,
        path=path,
        rate_hz=camera.rate_hz,
        camera=camera.camera(),
        scanner=None,
        place=place,
        light=light_place(place, seed),
        exposure=exposure,
        exposures=np.ones(length),
    )
    if exposure.is_automatic:
        shot = replace(shot, exposures=follow(meter(shot, length), exposure, shot.rate_hz))
    return Scenery(shot=shot, plan=plan, length=length)


def _sheet(ready: Scenery) -> NDArray[np.uint8]:
    shot, (rows, columns) = ready.shot, _TILES
    photographer = Photographer(shot)
    indices = np.linspace(0, ready.length - 1, rows * columns).astype(int).tolist()
    tiles = [
        _tile(shot, index, photographer.take(index), ready.zone(shot.time_s(index)))
        for index in indices
    ]
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])


def _tile(shot: Shot, index: int, frame: SimulatedFrame, zone: str) -> NDArray[np.uint8]:
    image = cv2.resize(frame.image_bgr, _TILE_WH, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(frame.depth_mm, _TILE_WH, interpolation=cv2.INTER_NEAREST)
    scale = 255.0 / (1000.0 * shot.camera.depth_range_m[1])
    colours = cv2.applyColorMap((depth * scale).astype(np.uint8), cv2.COLORMAP_TURBO)
    colours[depth == 0] = 0
    text = (
        f"{shot.time_s(index):.0f} s {zone} x{shot.exposures[index]:.1f} "
        f"grey {frame.image_bgr.mean():.0f} depth {(depth > 0).mean():.2f}"
    )
    cv2.putText(image, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 255, 0), 1, cv2.LINE_AA)
    return np.asarray(np.vstack([image, colours]), np.uint8)


def _print_zones(ready: Scenery) -> None:
    photographer, orb = Photographer(ready.shot), cv2.ORB_create(1000, fastThreshold=20)
    found: dict[str, list[tuple[float, ...]]] = {}
    step = round(_EVERY_S * ready.shot.rate_hz)
    for index in range(0, ready.length, step):
        frame, time_s = photographer.take(index), ready.shot.time_s(index)
        middle = frame.depth_mm[frame.depth_mm.shape[0] // 2]  # a laser made of depth sees it
        corners = len(orb.detect(cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY)))
        pitch_deg = np.rad2deg(np.arcsin(-ready.shot.path.pose(time_s)[2, 0]))
        row = (frame.image_bgr.mean(), corners, (frame.depth_mm > 0).mean(), (middle > 0).mean())
        found.setdefault(ready.zone(time_s), []).append((*row, abs(pitch_deg)))
    print("| zone | frames | grey mean | corners | depth | depth at mid-height | steepest [deg] |")
    print("|---|---|---|---|---|---|---|")
    for zone, rows in found.items():
        grey, count, depth, middle, _ = np.median(rows, axis=0)
        steepest = np.max(rows, axis=0)[-1]
        print(
            f"| {zone} | {len(rows)} | {grey:.0f} | {count:.0f} | {depth:.2f} | {middle:.2f} "
            f"| {steepest:.1f} |"
        )


def _print_cost(overrides: Sequence[str]) -> None:
    begin_s = time.process_time()
    ready = _make_ready(overrides)
    photographer = Photographer(ready.shot)
    photographer.take(0)
    start_s = time.process_time() - begin_s
    indices = np.linspace(0, ready.length - 1, _MEASURED).astype(int).tolist()
    begin_s = time.process_time()
    frames = [photographer.take(index) for index in indices]
    frame_s = (time.process_time() - begin_s) / _MEASURED
    begin_s = time.process_time()
    size_bytes = sum(_encoded_bytes(frame) for frame in frames) / _MEASURED
    encode_s = (time.process_time() - begin_s) / _MEASURED
    rate_hz = 2.0 / (frame_s + encode_s)
    print(f"frames                     {ready.length}")
    print(f"start (path, walls, light) {start_s:.1f} s of CPU")
    print(f"a frame                    {1e3 * frame_s:.1f} ms of CPU")
    print(f"its encoding               {1e3 * encode_s:.1f} ms, {size_bytes / 1e3:.0f} kB")
    print(f"two idle cores             {rate_hz:.1f} images/s (of {os.cpu_count()} cores here)")
    print(f"the whole story            {start_s + ready.length / rate_hz:.0f} s")
    print(f"its file                   {ready.length * size_bytes / 1e9:.2f} GB")


def _encoded_bytes(frame: SimulatedFrame) -> int:
    jpeg = cv2.imencode(".jpg", frame.image_bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    return len(jpeg) + len(cv2.imencode(".png", frame.depth_mm)[1])


if __name__ == "__main__":
    main()
