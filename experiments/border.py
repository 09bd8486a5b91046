"""Print how often scenes change along the border of two, and how late a true change is found.

For ten minutes the light wavers about the level at which a detector's votes change, lamps flicker
and drop out. Then the light really changes, every 15 s. Recordings are of several cameras; each is
played forth and back, and dimmed as its sensor would see it. The first table is a sweep on seeds 0
and 1, the second one scores the defaults on seed 100.

Run it by: python experiments/border.py ../shared/data
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from hydra import compose, initialize_config_module
from numpy.typing import NDArray

from sceneslam.bus.policy import Policy
from sceneslam.config.build import make_source
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.resolve import resolved
from sceneslam.detection.decide import confirm
from sceneslam.interfaces import FeatureDetector
from sceneslam.sources.changes.dim_sensor import DimSensor
from sceneslam.types.observation import Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor

Image = NDArray[np.uint8]  # (H, W, 3) BGR
Curve = NDArray[np.float64]  # (N,) per image
Features = NDArray[np.float64]  # (F,)

RATE_HZ, WIDTH_PX, IMAGES_MAX = 10.0, 160, 150
BORDER_S, CROSSING_S, CROSSINGS = 600.0, 15.0, 20
FADE_S = 1.0  # through a door
WAVER, WAVER_S = 0.25, 3.0  # powers of two of light, and for how long it stays alike
FLICKER_RATIO, FLICKER_HZ = 0.05, 2.3  # what a camera sees of a lamp on 50 Hz
DROP_OUTS_HZ, DROP_OUT_S = 0.1, (0.2, 0.8)  # as in the story `flicker`
LEVEL_STEP = 1.02  # tables of the sensor are kept for levels so far apart
LIT, UNLIT = 4.0, 0.1  # times the border's level
CHOSEN_ON, SCORED_ON = (0, 1), (100,)
RECORDINGS: Mapping[str, Sequence[str]] = {
    "tum_fr1_rpy": ("source=tum_rgbd", "source.path={data}/tum_fr1_rpy"),
    "7scenes_redkitchen": ("source=video", "source.path={data}/7scenes_redkitchen/rgb"),
    "day_night": ("source=video", "source.path={data}/day_night/guoqi_normal.mp4"),
    "there_and_back": ("story=there_and_back", "lights=on", "source.camera.size_wh=[160,120]"),
}
EXPOSURES: Mapping[str, float] = {"fixed": 1.0, "automatic, 4 times": 4.0}
KINDS: Mapping[str, Sequence[str]] = {  # detectors whose features differ
    "grey_mean": ("detector=grey_mean",),
    "learned": ("detector=learned",),
}
SCORED: Sequence[tuple[str, str, Sequence[str]]] = (  # name, kind, overrides
    ("grey_mean, window", "grey_mean", ()),
    ("grey_mean, Bayes", "grey_mean", ("policy=bayes",)),
    ("grey_mean, hysteresis 40, window", "grey_mean", ("detector.hysteresis=40",)),
    ("learned, window", "learned", ()),
    ("learned, Bayes", "learned", ("policy=bayes",)),
)
DWELLS_S = (10.0, 30.0)
ERROR_RATIOS = (0.1, 0.2, 0.3)
CORRELATIONS_S = (0.2, 0.3, 0.5)
CONFIRM = (0.98, 0.995)


class Camera:
    """Images of a recording, as its camera would show them in other light."""

    def __init__(self, images: Sequence[Image], gain_max: float) -> None:
        self._images = images
        self._gain_max = gain_max
        self._sensor = cache(self._make_sensor)

    def show(self, number: int, level: float, rng: np.random.Generator) -> Image:
        """Return an image, the recording played forth and back, with so much of its light."""
        count = len(self._images)
        place = number % (2 * count)
        image = self._images[place if place < count else 2 * count - 1 - place]
        rounded = LEVEL_STEP ** round(np.log(max(level, 1e-3)) / np.log(LEVEL_STEP))
        return image if rounded >= 1.0 else self._sensor(rounded).dim(image, rounded, rng)

    def _make_sensor(self, level: float) -> DimSensor:
        return DimSensor(
            full_well_electrons=8000.0, read_noise_electrons=6.0, gain_max=self._gain_max
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """What a kind of detector measures: along the border, and through it again and again."""

    border: Sequence[Features | None]
    crossing: Sequence[Features | None]
    turns: Sequence[tuple[float, str]]  # when the scene changes [s], and to which


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """What a detector and a scene filter make of drives."""

    false: int  # changes along the border
    missed: int
    delays_s: Sequence[float]


def build(words: Sequence[str]) -> dict[str, Any]:
    """Return a resolved configuration."""
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        config: dict[str, Any] = resolved(
            compose("config", overrides=["run.progress=false", *words])
        )
    return config


def load(words: Sequence[str]) -> list[Image]:
    """Return a recording's images, small, at about 10 Hz."""
    config = build(words)
    source = make_source(config, ComponentBuilder(config))
    images: list[Image] = []
    next_ns = 0
    for one in source:
        if one.image_bgr is None or one.stamp_ns < next_ns:
            continue
        next_ns = one.stamp_ns + round(0.9e9 / RATE_HZ)
        size = (WIDTH_PX, round(one.image_bgr.shape[0] * WIDTH_PX / one.image_bgr.shape[1]))
        small = cv2.resize(one.image_bgr, size, interpolation=cv2.INTER_AREA)
        images.append(np.asarray(small, np.uint8))
        if len(images) == IMAGES_MAX:
            break
    return images


def measure(
    detector: FeatureDetector, camera: Camera, levels: Curve, seed: int
) -> list[Features | None]:
    """Return the features of images in the light of a curve."""
    rng = np.random.Generator(np.random.SFC64(seed))
    return [
        detector.get_features(
            Observation(stamp_ns=_stamp_ns(number), image_bgr=camera.show(number, level, rng))
        )
        for number, level in enumerate(levels.tolist())
    ]


def votes(detector: FeatureDetector, features: Sequence[Features | None]) -> list[SceneVote]:
    """Return a detector's votes."""
    detector.activate(Rig(sensors=frozenset({Sensor.IMAGE})))
    return [detector.decide(_stamp_ns(number), row) for number, row in enumerate(features)]


def border_level(detector: FeatureDetector, camera: Camera) -> float:
    """Return the share of light at which half of the images are Dark."""
    low, high = 0.002, 1.0
    for _ in range(10):
        level = float(np.sqrt(low * high))
        seen = measure(detector, camera, np.full(IMAGES_MAX, level), 0)
        scenes = [one.scene for one in votes(detector, seen)]
        low, high = (level, high) if scenes.count("Dark") > len(scenes) / 2 else (low, level)
    return float(np.sqrt(low * high))


def border_curve(level: float, seed: int) -> Curve:
    """Return ten minutes of light along the border."""
    rng = np.random.default_rng([seed, 0])
    times_s = np.arange(0.0, BORDER_S, 1 / RATE_HZ)
    stay = np.exp(-1 / RATE_HZ / WAVER_S)
    steps = rng.normal(0.0, WAVER * np.sqrt(1 - stay**2), len(times_s))
    waver = np.zeros(len(times_s))
    for at in range(1, len(times_s)):
        waver[at] = stay * waver[at - 1] + steps[at]
    lamps = 1.0 + FLICKER_RATIO * np.sin(2 * np.pi * FLICKER_HZ * times_s)
    for start_s in rng.uniform(0, BORDER_S, round(DROP_OUTS_HZ * BORDER_S)):
        is_out = (times_s >= start_s) & (times_s < start_s + rng.uniform(*DROP_OUT_S))
        lamps[is_out] *= UNLIT
    return np.asarray(level * 2.0**waver * lamps)


def crossing_curve(level: float, seed: int) -> tuple[Curve, list[tuple[float, str]]]:
    """Return light that changes every 15 s, and when it passes the border's level."""
    rng = np.random.default_rng([seed, 1])
    ends = [np.log(min(1.0, LIT * level)), np.log(UNLIT * level)]
    knots_s, values, turns = [0.0], [ends[0]], []
    for number in range(CROSSINGS):
        start_s = CROSSING_S * (number + 1) + rng.uniform(-3.0, 3.0)
        before, after = ends[number % 2], ends[(number + 1) % 2]
        knots_s += [start_s, start_s + FADE_S]
        values += [before, after]
        share = (np.log(level) - before) / (after - before)
        turns.append((start_s + float(share) * FADE_S, ("Dark", "Bright")[number % 2]))
    times_s = np.arange(0.0, CROSSING_S * (CROSSINGS + 1), 1 / RATE_HZ)
    lamps = 1.0 + FLICKER_RATIO * np.sin(2 * np.pi * FLICKER_HZ * times_s)
    return np.exp(np.interp(times_s, knots_s, values)) * lamps, turns


def drives(detector: FeatureDetector, camera: Camera, seeds: Sequence[int]) -> Iterator[Drive]:
    """Yield a drive per seed."""
    level = border_level(detector, camera)
    for seed in seeds:
        curve, turns = crossing_curve(level, seed)
        yield Drive(
            border=measure(detector, camera, border_curve(level, seed), seed),
            crossing=measure(detector, camera, curve, seed),
            turns=turns,
        )


def score(config: Mapping[str, Any], all_drives: Sequence[Drive]) -> Score:
    """Return what a configuration is worth over drives."""
    builder = ComponentBuilder(config)
    detector, policy = builder.make("detector", FeatureDetector), builder.make("policy", Policy)
    false, missed, delays_s = 0, 0, []
    for drive in all_drives:
        along = confirm(votes(detector, drive.border), policy, detector.scenes)
        false += max(len(along) - 1, 0)
        seen = confirm(votes(detector, drive.crossing), policy, detector.scenes)
        ends_s = [*(at_s for at_s, _ in drive.turns[1:]), np.inf]
        for (at_s, scene), end_s in zip(drive.turns, ends_s, strict=True):
            # A view darker or brighter than others is found a little before the light turns.
            found_s = [
                one.stamp_ns * 1e-9 - at_s
                for one in seen
                if one.scene == scene and at_s - FADE_S <= one.stamp_ns * 1e-9 < end_s - FADE_S
            ]
            missed += not found_s
            delays_s += found_s[:1]
    return Score(false=false, missed=missed, delays_s=delays_s)


def settings() -> Iterator[tuple[str, Sequence[str]]]:
    """Yield the scene filters of the sweep: name and overrides."""
    for window_s in (0.5, 1.0, 2.0, 3.0):
        yield f"window {window_s:g} s", (f"policy.confirm_window_s={window_s}",)
    for dwell_s, error, correlation_s, sure in product(
        DWELLS_S, ERROR_RATIOS, CORRELATIONS_S, CONFIRM
    ):
        values = {
            "mean_dwell_s": dwell_s,
            "error_ratio": error,
            "correlation_s": correlation_s,
            "confirm_probability": sure,
        }
        words = [f"policy.scene_filter.{key}={value}" for key, value in values.items()]
        name = f"{dwell_s:g} s, {error:g}, {correlation_s:g} s, {sure:g}"
        yield name, ("policy=bayes", *words)


def flip_s(config: Mapping[str, Any]) -> float:
    """Return for how long clear votes for another scene change nothing: longer than a drop-out."""
    policy = ComponentBuilder(config).make("policy", Policy)
    scenes = ["Bright"] * 600 + ["Dark"] * 100
    cast = [SceneVote(stamp_ns=_stamp_ns(n), scene=scene) for n, scene in enumerate(scenes)]
    seen = confirm(cast, policy, ("Bright", "Dark"))
    return seen[-1].stamp_ns * 1e-9 - 600 / RATE_HZ if len(seen) > 1 else np.inf


def sweep(known: Mapping[str, Sequence[Drive]]) -> None:
    """Print the settings for `learned`, the best first."""
    print("| scene filter | clear votes [s] | false | missed | delay at most [s] |")
    print("|---|---|---|---|---|")
    rows = []
    for name, words in settings():
        config = build([*KINDS["learned"], *words])
        scores = [score(config, some) for some in known.values()]
        false, missed = sum(one.false for one in scores), sum(one.missed for one in scores)
        latest_s = max(max(one.delays_s, default=np.inf) for one in scores)
        rows.append((false + missed, latest_s, name, flip_s(config), false, missed))
    for _, latest_s, name, clear_s, false, missed in sorted(rows):
        print(f"| {name} | {clear_s:.1f} | {false} | {missed} | {latest_s:.2f} |")


def report(known: Mapping[str, Mapping[str, Sequence[Drive]]]) -> None:
    """Print what detectors and scene filters are worth by their defaults, over all recordings."""
    print("\n| detector, scene filter | exposure | false | missed | delay [s], median | at most |")
    print("|---|---|---|---|---|---|", flush=True)
    for (name, kind, words), exposure in product(SCORED, EXPOSURES):
        some = [one for place, found in known[kind].items() if exposure in place for one in found]
        one = score(build([*KINDS[kind], *words]), some)
        shown = "- | -"
        if one.delays_s:
            shown = f"{np.median(one.delays_s):.2f} | {max(one.delays_s):.2f}"
        count = sum(len(drive.turns) for drive in some)
        print(
            f"| {name} | {exposure} | {one.false} | {one.missed} of {count} | {shown} |", flush=True
        )


def main() -> None:
    """Print two tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder of the recordings")
    folder = parser.parse_args().data
    chosen_on: dict[str, list[Drive]] = {}
    scored_on: dict[str, dict[str, list[Drive]]] = {kind: {} for kind in KINDS}
    for recording, words in RECORDINGS.items():
        images = load([word.format(data=folder) for word in words])
        for (exposure, gain_max), kind in product(EXPOSURES.items(), KINDS):
            detector = ComponentBuilder(build(KINDS[kind])).make("detector", FeatureDetector)
            camera = Camera(images, gain_max)
            name = f"{recording}, exposure {exposure}"
            if kind == "learned":
                chosen_on[name] = list(drives(detector, camera, CHOSEN_ON))
            scored_on[kind][name] = list(drives(detector, camera, SCORED_ON))
    sweep(chosen_on)
    report(scored_on)


def _stamp_ns(number: int) -> int:
    return round(number / RATE_HZ * 1e9)


if __name__ == "__main__":
    main()
