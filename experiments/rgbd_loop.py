"""Print how well the rgbd module remembers: places, loops, and ways back.

    python experiments/rgbd_loop.py WHAT [OVERRIDES]

WHAT is `places`, `loops` or `kidnap`; the overrides choose a recording as for a run:

    python experiments/rgbd_loop.py loops story=there_and_back lights=on
    python experiments/rgbd_loop.py kidnap source=tum_rgbd source.path=FOLDER

The result is one line of a Markdown table. Times are CPU time of all threads.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import cast

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import interpolated
from sceneslam.experiments.scripts import single
from sceneslam.interfaces import SlamModule, Source
from sceneslam.modules.slam.rgbd.map.keyframes import KeyframeStore
from sceneslam.modules.slam.rgbd.module import RgbdSlam
from sceneslam.types import se3
from sceneslam.types.maps import PoseGraphLayer
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.trajectory import Trajectory
from sceneslam.views.place_index import PlaceIndex

MAX_GAP_S = 0.02
WRONG_M, WRONG_RAD = 0.3, 0.2  # a loop that is off by more joins two different places
JUMPS, JUMP_IMAGES, GAP_NS = 20, 15, 2_000_000_000
MAPPED_IMAGES = 440  # before the kidnapping; the ones in between are kept for afterwards
KNOWN_AFTER_NS = 3_000_000_000  # a place seen longer ago than this counts as seen again
REVISIT_NS = 10_000_000_000
SAME_PLACE_M, SAME_PLACE_RAD = 0.4, 0.35

Row = Mapping[str, object]


def build(
    overrides: Iterable[str], module_name: str = "rgbd"
) -> tuple[Source, RgbdSlam, Trajectory]:
    """Return a source, the module made ready for it, and the true poses."""
    source, builder = single(module_name, *overrides)
    module = cast(RgbdSlam, builder.make("slam.only", SlamModule))
    module.activate(source.rig)
    truth = source.ground_truth()
    return source, module, Trajectory.empty() if truth is None else truth.trajectory


def follow(module: RgbdSlam, observations: Iterable[Observation]) -> tuple[list[Tracking], Row]:
    """Return the module's answers, and what they cost."""
    answers, cost_ms = [], []
    for observation in observations:
        start = time.process_time()
        answers.append(module.track(observation))
        cost_ms.append(1e3 * (time.process_time() - start))
    median, p95 = np.percentile(cost_ms, [50, 95])
    return answers, {"median [ms]": f"{median:.1f}", "p95 [ms]": f"{p95:.1f}"}


def poses_of(held: Sequence[Tracking]) -> Trajectory:
    """Return the poses of answers, at least one, as they were given."""
    return Trajectory(
        stamps_ns=np.array([answer.stamp_ns for answer in held]),
        T_world_base=np.stack([answer.T_local_base for answer in held]),
    )


def loops(overrides: list[str]) -> Row:
    """Return what loops were closed, how many of them wrongly, and what it did."""
    source, module, truth = build(overrides)
    answers, cost = follow(module, source)
    revised, graph = module.get_trajectory(), module.get_map().pose_graph
    module.shutdown()
    held = [answer for answer in answers if answer.status is not TrackingStatus.LOST]
    told = poses_of(held)
    errors = loop_errors(graph, truth) if graph else np.zeros((0, 2))
    wrong = (errors[:, 0] > WRONG_M) | (errors[:, 1] > WRONG_RAD)
    return {
        "lost": len(answers) - len(held),
        "keyframes tracked to places of 10 s before": revisits(module._parts.map.keyframes),
        "loop edges": len(errors),
        "wrong": int(wrong.sum()),
        "worst edge [m]": f"{errors[:, 0].max(initial=0):.3f}",
        "revisions": answers[-1].revision,
        "ATE online [m]": f"{absolute_errors(told, truth, MAX_GAP_S).rmse_m:.4f}",
        "ATE revised [m]": f"{absolute_errors(revised, truth, MAX_GAP_S).rmse_m:.4f}",
        **cost,
    }


def revisits(keyframes: KeyframeStore) -> int:
    """Return how many keyframes share landmarks with one of long before."""
    count = 0
    for keyframe in keyframes.all():
        near = keyframes.covisible(keyframe.landmark_ids, limit=len(keyframes))
        count += any(keyframe.stamp_ns - keyframes[k].stamp_ns > REVISIT_NS for k in near)
    return count


def loop_errors(graph: PoseGraphLayer, truth: Trajectory) -> NDArray[np.float64]:
    """Return how far each loop edge is from the true motion (N, 2) [m, rad]."""
    edges = graph.edges[graph.is_loop]
    T_gt_base = interpolated(truth, graph.stamps_ns).T_world_base
    T_true = se3.inverse(T_gt_base[edges[:, 0]]) @ T_gt_base[edges[:, 1]]
    T_error = se3.inverse(T_true) @ graph.T_from_to[graph.is_loop]
    gaps_m = np.linalg.norm(T_error[:, :3, 3], axis=1)
    return np.column_stack([gaps_m, se3.rotation_angle_rad(T_error)])


def kidnap(overrides: list[str]) -> Row:
    """Return how a camera finds itself that is put back, 2 s later, at a place it has seen.

    Every second image makes the map; the camera is put back to the images in between. Errors are
    against the pose that the map itself gives the image (interpolated from its neighbours, as
    revised when the map was made), and against the truth, on which the map was laid as a whole.
    """
    source, module, truth = build(overrides)
    images = [camera_only(image) for image in islice(source, MAPPED_IMAGES)]
    follow(module, images[::2])
    mapped = module.get_trajectory()
    T_gt_local = align(interpolated(truth, mapped.stamps_ns).T_world_base, mapped.T_world_base)
    T_gt_local = se3.inverse(T_gt_local)
    others, rng = images[1::2], np.random.default_rng(0)
    stamp_ns, delays, guesses = images[-1].stamp_ns, [], 0
    first_m, all_m = [], []
    for start in rng.integers(0, len(others) - JUMP_IMAGES - 1, JUMPS).tolist():
        stamp_ns += GAP_NS
        errors_m: list[list[float]] = []
        for step in range(JUMP_IMAGES):
            stamp_ns += images[2].stamp_ns - images[0].stamp_ns
            image = others[start + step]
            answer = module.track(replace(image, stamp_ns=stamp_ns))
            if answer.status is TrackingStatus.TRACKING:
                delays += [] if errors_m else [step]
                by_map, by_truth = (
                    interpolated(known, np.array([image.stamp_ns])).positions_m[0]
                    for known in (mapped, truth)
                )
                told_m = answer.T_local_base[:3, 3]
                gaps = told_m - by_map, se3.apply(T_gt_local, told_m) - by_truth
                errors_m.append([float(np.linalg.norm(gap)) for gap in gaps])
            guesses += answer.status is TrackingStatus.DEGRADED and answer.inliers > 0
        first_m += errors_m[:1]
        all_m += errors_m
    module.shutdown()
    return {
        "put back": JUMPS,
        "found": len(first_m),
        "images until found, at most": max(delays, default=-1),
        "reported as degraded": guesses,
        **_spread("first error", np.array(first_m)),
        **_spread("within a second", np.array(all_m)),
    }


def _spread(name: str, errors_m: NDArray[np.float64]) -> Row:
    """Return the worst and the median of errors (N, 2) [m] against the map and the truth."""
    worst, median = errors_m.max(axis=0), np.median(errors_m, axis=0)
    return {
        f"{name} by the map: median, worst [m]": f"{median[0]:.3f}, {worst[0]:.3f}",
        f"by the truth: median, worst [m] ({name})": f"{median[1]:.3f}, {worst[1]:.3f}",
    }


def camera_only(observation: Observation) -> Observation:
    """Return the observation without what could tell of a motion in the dark."""
    return replace(observation, T_odom_base=None, gyro_base=None, scan=None)


def places(overrides: list[str]) -> Row:
    """Return how often the keyframe most alike shows the place of an image seen longer ago."""
    source, module, truth = build(overrides)
    index, stamps, hits, asked, cost_ms = PlaceIndex(), {}, 0, 0, []
    for observation in source:
        module.track(observation)
        keyframes = module._parts.map.keyframes
        newest = keyframes.ids[-1] if len(keyframes) else -1
        if newest in stamps or newest < 0:
            continue
        keyframe = keyframes[newest]
        old = [k for k, ns in stamps.items() if ns < keyframe.stamp_ns - KNOWN_AFTER_NS]
        same = same_place(truth, keyframe.stamp_ns, [stamps[k] for k in old])
        if same.any():
            start = time.process_time()
            best = index.alike(keyframe.features.descriptors, old)[0].place_id
            cost_ms.append(1e3 * (time.process_time() - start))
            hits, asked = hits + int(same[old.index(best)]), asked + 1
        index.insert(newest, keyframe.features.descriptors)
        stamps[newest] = keyframe.stamp_ns
    module.shutdown()
    mean_ms = float(np.mean(cost_ms)) if cost_ms else float("nan")
    return {"keyframes": len(stamps), "asked": asked, "right": hits, "mean [ms]": f"{mean_ms:.1f}"}


def same_place(truth: Trajectory, stamp_ns: int, others_ns: list[int]) -> NDArray[np.bool_]:
    """Tell which of the other stamps saw, by the true poses, about the same view."""
    if not others_ns:
        return np.zeros(0, bool)
    T_gt_base = interpolated(truth, np.array([stamp_ns, *others_ns])).T_world_base
    T_one_other = se3.inverse(T_gt_base[0]) @ T_gt_base[1:]
    is_near = np.linalg.norm(T_one_other[:, :3, 3], axis=1) < SAME_PLACE_M
    return np.asarray(is_near & (se3.rotation_angle_rad(T_one_other) < SAME_PLACE_RAD))


WHAT: Mapping[str, Callable[[list[str]], Row]] = {
    "places": places,
    "loops": loops,
    "kidnap": kidnap,
}


def show(row: Row) -> None:
    """Print a table of one line."""
    print("| " + " | ".join(row) + " |")
    print("|---" * len(row) + "|")
    print("| " + " | ".join(str(value) for value in row.values()) + " |")


def main() -> None:
    """Run what the first word says on the recording that the others choose."""
    show(WHAT[sys.argv[1]](sys.argv[2:]))


if __name__ == "__main__":
    main()
