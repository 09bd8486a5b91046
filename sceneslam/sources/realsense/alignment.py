"""Registration of depth images to the colour camera by the SDK."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray


class DepthAligner:
    """Registers depth frames to colour frames."""

    def __init__(self) -> None:
        self._align = rs.align(rs.stream.color)
        self._pair: list[Any] = []
        self._joined: list[Any] = []
        self._joining = rs.processing_block(self._join)
        self._joining.start(self._keep)

    def registered(self, depth: Any, colour: Any) -> NDArray[np.uint16]:
        """Return depth (H, W) at the colour frame's pixels, in the depth frame's units."""
        self._pair, self._joined = [depth, colour], []
        self._joining.invoke(depth)
        aligned = self._align.process(self._joined[0].as_frameset()).as_frameset()
        return np.array(aligned.get_depth_frame().get_data())

    def _join(self, frame: Any, source: Any) -> None:
        source.frame_ready(source.allocate_composite_frame(self._pair))

    def _keep(self, frame: Any) -> None:
        frame.keep()
        self._joined.append(frame)
