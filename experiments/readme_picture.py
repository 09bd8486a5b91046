"""Make the picture of the README from a run of `+scenario=bright_to_dark`.

Run it by: python experiments/readme_picture.py RUN_FOLDER docs/bright_to_dark.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.image as mpimg
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from sceneslam.config.build import build

SHOWN_S = (4.0, 11.0, 16.0)  # in the lit room, in the door, in the dark


def frames(folder: Path) -> list[np.ndarray]:
    """Return the camera's images (RGB) at the shown times of the run in `folder`."""
    config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
    images: list[np.ndarray] = []
    start_ns = None
    for observation in build(config).source:
        start_ns = start_ns or observation.stamp_ns
        if observation.stamp_ns - start_ns >= SHOWN_S[len(images)] * 1e9:
            images.append(observation.image_bgr[..., ::-1])
            if len(images) == len(SHOWN_S):
                return images
    return images


def main() -> None:
    """Draw the camera's view, the detector's measure and the map side by side."""
    folder, path = Path(sys.argv[1]), Path(sys.argv[2])
    figure = Figure(figsize=(9.6, 5.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 6, height_ratios=(1, 1.75), width_ratios=[1] * 6)
    for index, image in enumerate(frames(folder)):
        axes = figure.add_subplot(grid[0, 2 * index : 2 * index + 2])
        axes.imshow(image)
        axes.set_title(f"{SHOWN_S[index]:.0f} s", fontsize=9)
        axes.set_axis_off()
    for name, cells in (("grey_mean", grid[1, :3]), ("map", grid[1, 3:])):
        axes = figure.add_subplot(cells)
        axes.imshow(mpimg.imread(folder / "figures" / f"{name}.png"))
        axes.set_axis_off()
    figure.savefig(path, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
