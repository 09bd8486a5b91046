"""Encoding of results as ROS 2 messages: path, grid, cloud, diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sceneslam.ros.encode import Encoder
from sceneslam.types import se3
from sceneslam.types.maps import GridLayer, PointLayer
from sceneslam.types.se3 import Transform

OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"  # diagnostic_msgs/DiagnosticStatus

_COUNT, _CDR_HEADER = np.dtype("<u4"), 4  # bytes before the first field, from which CDR aligns


class ResultEncoder(Encoder):
    """Builds and serialises messages of results."""

    def path(
        self, stamps_ns: Sequence[int], T_frame_base: Sequence[Transform], frame: str
    ) -> bytes:
        """Return a Path; stamped as its last pose. A thousand poses take less than 1 ms."""
        last_ns = stamps_ns[-1] if len(stamps_ns) else 0
        empty = self._cdr("nav_msgs/msg/Path", header=self._header(last_ns, frame), poses=[])
        head = empty[: -_COUNT.itemsize] + np.array(len(stamps_ns), _COUNT).tobytes()
        return head + _poses(stamps_ns, T_frame_base, frame, begins_at=len(head) - _CDR_HEADER)

    def grid(self, stamp_ns: int, grid: GridLayer, frame: str) -> bytes:
        """Return an OccupancyGrid of 100 (occupied), 0 (free) and -1 (unknown), as map_server's.

        Nav2 takes all from 0 to 99 as free.
        """
        cells = grid.trinary(occupied=100, free=0, unknown=-1).astype(np.int8)
        rows, columns = cells.shape
        stamp = self._header(stamp_ns, frame).stamp
        return self._cdr(
            "nav_msgs/msg/OccupancyGrid",
            header=self._header(stamp_ns, frame),
            info=self._new(
                "nav_msgs/msg/MapMetaData",
                map_load_time=stamp,
                resolution=grid.resolution_m,
                width=columns,
                height=rows,
                origin=self._pose(se3.from_xy_yaw(*grid.origin_xy_m, 0.0)),
            ),
            data=cells.ravel(),
        )

    def cloud(self, stamp_ns: int, layer: PointLayer, T_frame_map: Transform, frame: str) -> bytes:
        """Return a PointCloud2 with x y z [m] and rgb, packed as RViz and Foxglove read it."""
        kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")]
        rows = np.zeros(len(layer.points), dtype=kinds)
        points = layer.points @ T_frame_map[:3, :3].T.astype(np.float32)
        points = points + T_frame_map[:3, 3].astype(np.float32)
        for column, axis in enumerate("xyz"):
            rows[axis] = points[:, column]
        if layer.colors_bgr is not None:
            blue, green, red = layer.colors_bgr.astype(np.uint32).T
            rows["rgb"] = (red << 16) | (green << 8) | blue
        return self._cloud(stamp_ns, rows, frame)

    def diagnostics(
        self, stamp_ns: int, level: bytes, message: str, values: Mapping[str, str]
    ) -> bytes:
        """Return a DiagnosticArray with one status, `sceneslam`."""
        entries = [
            self._new("diagnostic_msgs/msg/KeyValue", key=key, value=value)
            for key, value in values.items()
        ]
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level[0],
            name="sceneslam",
            message=message,
            hardware_id="",
            values=entries,
        )
        return self._cdr(
            "diagnostic_msgs/msg/DiagnosticArray",
            header=self._header(stamp_ns, ""),
            status=[status],
        )


def _poses(
    stamps_ns: Sequence[int], T_frame_base: Sequence[Transform], frame: str, *, begins_at: int
) -> bytes:
    """Return the CDR of PoseStamped, one after the other, from a place in the message on.

    Its doubles are aligned to 8 bytes. Each ends aligned, so that all but the first are alike.
    """
    if not len(stamps_ns):
        return b""
    name = frame.encode() + b"\0"
    start = np.dtype(
        [("sec", "<i4"), ("nanosec", "<u4"), ("length", "<u4"), ("name", f"V{len(name)}")]
    )
    gap = -start.itemsize % 8
    row = np.dtype([("start", start), ("gap", f"V{gap}"), ("pose", "<f8", 7)])
    rows, T = np.zeros(len(stamps_ns), row), np.asarray(T_frame_base).reshape(-1, 4, 4)
    sec, nanosec = np.divmod(np.asarray(stamps_ns, np.int64), 10**9)
    rows["start"]["sec"], rows["start"]["nanosec"] = sec, nanosec
    rows["start"]["length"], rows["start"]["name"] = len(name), np.void(name)
    rows["pose"][:, :3], rows["pose"][:, 3:] = T[:, :3, 3], se3.to_quat_xyzw(T)
    data, first = rows.tobytes(), start.itemsize
    return data[:first] + bytes(-(begins_at + first) % 8) + data[first + gap :]
