"""Print what the rgbd module tells while its camera shows nothing of the place where it is.

    python experiments/rgbd_blind.py [OVERRIDES]

The overrides choose a recording as for a run. Stretches of it are spoilt, one after the other, in
one of the ways below; in between the recording is as it is. No odometry, no gyro. `after` counts
images from the first that shows nothing; errors are of the motion since the last good image.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray
from rgbd_loop import build, camera_only

from sceneslam.evaluation.association import interpolated
from sceneslam.sources.changes.dim_sensor import DimSensor
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.trajectory import Trajectory

MAPPED_IMAGES, SEEN_IMAGES = 60, 20  # before the first stretch, and between two
PROMISED_IMAGES = 3  # that may show nothing before it says that it is lost
Image = NDArray[np.uint8]
SENSOR = DimSensor(full_well_electrons=8000.0, read_noise_electrons=6.0, gain_max=1.0)
AMBIENT_RATIO = 0.005  # of the light, that is left in the dark


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stretch:
    """Images that are spoilt, and the ones around them."""

    images: Sequence[Observation]  # as recorded
    before: Observation
    elsewhere: Sequence[Observation]  # as long, of another part of the recording
    rng: np.random.Generator


@dataclass(frozen=True, slots=True)
class Way:
    """A way to spoil images; `fades` of them show less and less."""

    spoil: Callable[[Stretch, int], Observation]
    fades: int = 0
    length: int = 10


@dataclass(slots=True)
class Score:
    """What was told in all stretches of one kind."""

    after: list[int] = field(default_factory=list)
    tracking: int = 0  # poses told after the promised images
    degraded: int = 0
    errors_m: list[float] = field(default_factory=list)  # of poses told while it shows nothing
    fading_m: list[float] = field(default_factory=list)  # and while it shows less and less
    back: list[int] = field(default_factory=list)


def noise(mean: float, sigma: float) -> Way:
    """Return grey with noise in place of the image."""

    def spoil(stretch: Stretch, step: int) -> Observation:
        shape = shown(stretch, step).shape
        return put(stretch, step, np.clip(stretch.rng.normal(mean, sigma, shape), 0, 255))

    return Way(spoil)


def shown(stretch: Stretch, step: int) -> Image:
    """Return the image as recorded."""
    return cast(Image, stretch.images[step].image_bgr)


def put(stretch: Stretch, step: int, image_bgr: NDArray[np.generic]) -> Observation:
    """Return the observation with another image."""
    return replace(stretch.images[step], image_bgr=image_bgr.astype(np.uint8))


def out_of_focus(stretch: Stretch, step: int) -> Observation:
    """Blur all ways."""
    return put(stretch, step, cv2.GaussianBlur(shown(stretch, step), (0, 0), 25))


def smeared(stretch: Stretch, step: int) -> Observation:
    """Blur along the rows, as a fast turn does: by a quarter of the image."""
    width = shown(stretch, step).shape[1] // 4
    return put(stretch, step, cv2.blur(shown(stretch, step), (width, 1)))


def covered(stretch: Stretch, step: int) -> Observation:
    """Draw something dark over the lens, from the left, in ten images; depth goes with it."""
    image_bgr = shown(stretch, step).copy()
    width = min(1.0, (step + 1) / 10) * image_bgr.shape[1]
    columns = slice(0, round(width))
    image_bgr[:, columns] = np.clip(stretch.rng.normal(3, 1.5, image_bgr[:, columns].shape), 0, 9)
    depth_m = stretch.images[step].depth_m
    if depth_m is not None:
        depth_m = depth_m.copy()
        depth_m[:, columns] = 0.0
    return replace(put(stretch, step, image_bgr), depth_m=depth_m)


def fading(stretch: Stretch, step: int) -> Observation:
    """Let the light go out in 2 s, with a camera's noise."""
    light = max(AMBIENT_RATIO, 1.0 - (step + 1) / 60)
    return put(stretch, step, SENSOR.dim(shown(stretch, step), light, stretch.rng))


def frozen(stretch: Stretch, step: int) -> Observation:
    """Repeat the last image and depth image, with new stamps."""
    return replace(stretch.before, stamp_ns=stretch.images[step].stamp_ns)


def mirrored(stretch: Stretch, step: int) -> Observation:
    """Show another room: a mirror image of another part of the recording, with its depth."""
    other = stretch.elsewhere[step]
    depth_m = None if other.depth_m is None else np.ascontiguousarray(other.depth_m[:, ::-1])
    mirror = put(stretch, step, np.ascontiguousarray(cast(Image, other.image_bgr)[:, ::-1]))
    return replace(mirror, depth_m=depth_m)


WAYS = {
    "black": noise(0, 0),
    "dark, noise": noise(1.5, 2),
    "white": noise(255, 0),
    "white wall": noise(200, 2),
    "out of focus": Way(out_of_focus),
    "smeared by a turn": Way(smeared),
    "covered slowly": Way(covered, fades=9, length=19),
    "light fades in 2 s": Way(fading, fades=60, length=70),
    "frozen": Way(frozen),
    "another room": Way(mirrored),
}


def spoilt(
    images: Sequence[Observation],
) -> tuple[list[Observation], list[tuple[str, int]]]:
    """Return the recording with its stretches, and where which begins."""
    rng, observations, stretches = np.random.default_rng(0), list(images), []
    start = MAPPED_IMAGES
    while True:
        name = list(WAYS)[len(stretches) % len(WAYS)]
        way = WAYS[name]
        if start + way.length + SEEN_IMAGES > len(images):
            return observations, stretches
        far = (start + len(images) // 2) % (len(images) - way.length)
        stretch = Stretch(
            images=images[start : start + way.length],
            before=images[start - 1],
            elsewhere=images[far : far + way.length],
            rng=rng,
        )
        for step in range(way.length):
            observations[start + step] = way.spoil(stretch, step)
        stretches.append((name, start))
        start += way.length + SEEN_IMAGES


def judge(
    score: Score, way: Way, answers: Sequence[Tracking], start: int, truth: Trajectory
) -> None:
    """Add to a score what was told in a stretch."""
    stamps = [answer.stamp_ns for answer in answers]
    end = start + way.length
    T_gt_base = interpolated(truth, np.array(stamps[start - 1 : end])).T_world_base
    T_before = answers[start - 1].T_local_base
    blind = start + way.fades
    lost = [answer.status is TrackingStatus.LOST for answer in answers]
    for index in range(start, end):
        answer = answers[index]
        if lost[index]:
            continue
        T_told = se3.inverse(T_before) @ answer.T_local_base
        T_true = se3.inverse(T_gt_base[0]) @ T_gt_base[index - start + 1]
        error_m = float(np.linalg.norm(T_told[:3, 3] - T_true[:3, 3]))
        (score.errors_m if index >= blind else score.fading_m).append(error_m)
        if index >= blind + PROMISED_IMAGES:
            score.tracking += answer.status is TrackingStatus.TRACKING
            score.degraded += answer.status is TrackingStatus.DEGRADED
    score.after.append([*lost[blind:end], True].index(True))
    score.back.append([*lost[end : end + SEEN_IMAGES], False].index(False))


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    source, module, truth = build(sys.argv[1:])
    observations, stretches = spoilt([camera_only(image) for image in source])
    answers = [module.track(observation) for observation in observations]
    module.shutdown()
    scores = {name: Score() for name in WAYS}
    for name, start in stretches:
        judge(scores[name], WAYS[name], answers, start, truth)
    print(
        "| images | stretches | LOST after, at most | reported after the third: tracking, degraded "
        "| reported error while fading, blind: worst [m] | back after |\n" + "|---" * 6 + "|"
    )
    for name, score in scores.items():
        if score.after:
            worst = [max(errors, default=0.0) for errors in (score.fading_m, score.errors_m)]
            print(
                f"| {name} | {len(score.after)} | {max(score.after)} | {score.tracking}, "
                f"{score.degraded} | {worst[0]:.3f}, {worst[1]:.3f} | {max(score.back)} |"
            )


if __name__ == "__main__":
    main()
