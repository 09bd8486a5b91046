"""Print what the rgbd module's map grows by, and how soon it is ready.

    python experiments/rgbd_growth.py WHAT [OVERRIDES]

WHAT is `twice` or `ready`; the overrides choose a recording as for a run:

    python experiments/rgbd_growth.py twice story=there_and_back lights=on

The result is one line of a Markdown table.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np
from rgbd_loop import Row, build, camera_only, follow, show

from sceneslam.interfaces import Source
from sceneslam.modules.slam.rgbd.module import RgbdSlam
from sceneslam.types.observation import Observation

ACTIVATIONS = 20
FRAME_MB = 156e-6  # of a frame's pose, which is kept whatever the map does


def twice(overrides: list[str]) -> Row:
    """Return what the map grows by, on the way and when the same round trip is driven again."""
    source, module, truth = build(overrides)
    sizes = []
    for lap in (shifted(source, 0), shifted(source, 1)):
        follow(module, lap)
        layers = module.get_map()
        assert layers.pose_graph is not None and layers.landmarks is not None
        sizes.append((len(layers.pose_graph.stamps_ns), len(layers.landmarks.points)))
    stored_mb = megabytes(module)
    module.shutdown()
    first, second = np.array(sizes)
    growth = second / first - 1.0
    way_m = float(np.linalg.norm(np.diff(truth.positions_m, axis=0), axis=1).sum())
    per_keyframe_mb = stored_mb / second[0]
    hours = float(truth.stamps_ns[-1] - truth.stamps_ns[0]) / 3.6e12
    return {
        "keyframes": f"{first[0]} -> {second[0]} ({growth[0]:+.0%})",
        "landmarks": f"{first[1]} -> {second[1]} ({growth[1]:+.0%})",
        "stored [MB]": f"{stored_mb:.1f}",
        "keyframes per m": f"{first[0] / way_m:.1f}",
        "MB per m": f"{first[0] * per_keyframe_mb / way_m:.2f}",
        "MB per hour of new places": f"{first[0] * per_keyframe_mb / hours:.0f}",
        "and of known places": f"{(second[0] - first[0]) * per_keyframe_mb / hours:.0f}",
        "frames: MB per hour": f"{FRAME_MB * 30 * 3600:.0f}",
    }


def megabytes(module: RgbdSlam) -> float:
    """Return what keyframes, with their words, and living landmarks hold."""
    visual_map, index = module._parts.map, module._parts.memory.recognizer.places
    held = 0
    for keyframe in visual_map.keyframes.all():
        features, view = keyframe.features, keyframe.view
        arrays = [getattr(features, name) for name in features.__slots__]
        held += sum(array.nbytes for array in arrays)
        held += keyframe.landmark_ids.nbytes + view.points_base.nbytes + view.colors_bgr.nbytes
        held += view.scan.ranges_m.nbytes if view.scan is not None else 0
    held += sum(words.nbytes for words in index._places.values())
    tables = [rows for rows in vars(visual_map.landmarks).values() if isinstance(rows, np.ndarray)]
    return (held + sum(rows[0].nbytes for rows in tables) * len(visual_map.landmarks)) / 1e6


def ready(overrides: list[str]) -> Row:
    """Return how long after `activate` the module can track."""
    source, module, _ = build(overrides)
    first = next(iter(source))
    activate_ms, track_ms = [], []
    for _ in range(ACTIVATIONS):
        start = time.perf_counter()
        module.activate(source.rig)
        activate_ms.append(1e3 * (time.perf_counter() - start))
        module.track(first)
        track_ms.append(1e3 * (time.perf_counter() - start))
        module.shutdown()
    return {
        "activate: median (max) [ms]": f"{np.median(activate_ms):.1f} ({max(activate_ms):.1f})",
        "and first pose [ms]": f"{np.median(track_ms):.1f} ({max(track_ms):.1f})",
    }


def shifted(source: Source, lap: int) -> Iterator[Observation]:
    """Yield a lap's observations, each lap beginning 33 ms after the one before it ended."""
    observations = iter(source)
    first = next(observations)
    end_ns = first.stamp_ns
    if lap:
        for last in source:
            end_ns = last.stamp_ns
    offset_ns = lap * (end_ns - first.stamp_ns + 33_000_000)
    for observation in chain([first], observations):
        yield replace(camera_only(observation), stamp_ns=observation.stamp_ns + offset_ns)


def main() -> None:
    """Run what the first word says on the recording that the others choose."""
    what = {"twice": twice, "ready": ready}[sys.argv[1]]
    show(what(sys.argv[2:]))


if __name__ == "__main__":
    main()
