"""Print what one scene vote costs, beside merely reading the image from memory.

Run it by: python experiments/detector_cost.py
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter_ns

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.modules.detectors.grey_mean import grey_mean
from sceneslam.modules.detectors.learned import Learned
from sceneslam.types.observation import Observation

Image = NDArray[np.uint8]
POOL_BYTES = 200 << 20  # more than any cache holds, so that every image comes from memory


def read(image_bgr: Image) -> None:
    """Read every byte once, eight at a time, and do as little as possible with it."""
    image_bgr.reshape(-1).view(np.uint64).max()


def convert_then_mean(image_bgr: Image) -> float:
    """Take the obvious way: a grey image (each pixel rounded), then its mean."""
    return cv2.mean(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY))[0]


def formula(image_bgr: Image) -> float:
    """Take the formula to the letter, in NumPy."""
    return float((image_bgr @ np.array([0.114, 0.587, 0.299])).mean())


_LEARNED = Learned(path=None)


def learned(image_bgr: Image) -> object:
    """Vote by the model that comes with the project."""
    return _LEARNED.get_scene(Observation(stamp_ns=0, image_bgr=image_bgr))


def main() -> None:
    """Print the cost of each way, side by side, and its ratio to reading the image."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    ways: dict[str, Callable[[Image], object]] = {
        "read the image": read,
        "grey_mean": grey_mean,
        "learned": learned,
        "convert, then mean": convert_then_mean,
        "formula in NumPy": formula,
    }
    for width, height in ((640, 480), (1920, 1080)):
        count = POOL_BYTES // (width * height * 3)
        images = [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(count)]
        costs_us: dict[str, list[float]] = {name: [] for name in ways}
        for _ in range(3):
            for name, way in ways.items():
                for image_bgr in images if way is not formula else images[:10]:
                    began_ns = perf_counter_ns()
                    way(image_bgr)
                    costs_us[name].append((perf_counter_ns() - began_ns) / 1e3)
        base_us = median(costs_us["read the image"])
        for name, costs in costs_us.items():
            cost_us = median(costs)
            ratio = cost_us / base_us
            print(f"{width}x{height}  {name:20} {cost_us:9.1f} us  {ratio:6.2f} x reading")


if __name__ == "__main__":
    main()
