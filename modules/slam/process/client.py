"""The client side for Python programs: `serve` calls an object for every request.

It needs only NumPy and `protocol.py`, so that a program can use another Python environment.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .protocol import HEAD_BYTES, Fields, as_text, pack, read_fields, read_head, text

TRACKING, DEGRADED, LOST = range(3)
Reply = Mapping[str, Any]


class Slam(Protocol):
    """The methods of a program; every reply maps names to arrays."""

    requires: str  # a line per set of sensors that suffices: "scan odometry\\nscan"

    def activate(self, rig: Fields) -> None:
        """Start a session; called once."""
        ...

    def set_scene(self, scene: str) -> None:
        """Set the confirmed scene."""
        ...

    def track(self, observation: Fields) -> Reply:
        """Return `pose(...)`, or `poses([...])` for several; an empty list: no pose yet."""
        ...

    def trajectory(self) -> Reply:
        """Return all revised poses: `poses([...])`."""
        ...

    def map(self) -> Reply:
        """Return the layers: `points.points` and the like."""
        ...


def pose(
    stamp_ns: int, T_local_base: NDArray[np.float64], status: int = TRACKING, **more: Any
) -> dict[str, Any]:
    """Return a reply with one pose (4, 4) [m]; `more`: covariance, quality_ratio and the like."""
    reply = {"stamps_ns": [stamp_ns], "T_local_base": [T_local_base], "status": [status]}
    return {**reply, **{name: [value] for name, value in more.items()}}


def poses(
    stamps_ns: list[int], T_local_base: list[NDArray[np.float64]] | NDArray[np.float64]
) -> dict[str, Any]:
    """Return a reply with any number of poses (4, 4) [m], also none."""
    return {
        "stamps_ns": np.array(stamps_ns, np.int64),
        "T_local_base": np.asarray(T_local_base, np.float64).reshape(-1, 4, 4),
    }


def serve(slam: Slam) -> None:
    """Serve requests until the input is closed. Printed text goes to standard error."""
    wire = os.dup(1)
    os.dup2(2, 1)
    while True:
        data = sys.stdin.buffer.read(HEAD_BYTES)
        if len(data) < HEAD_BYTES:
            return
        head = read_head(data)
        fields = read_fields(head, sys.stdin.buffer.read(head.length))
        try:
            _write(wire, pack(head.kind, head.number, _arrays(_reply(slam, head.kind, fields))))
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            _write(wire, pack("error", head.number, {"text": text(reason)}))
            raise


def _write(wire: int, parts: list[memoryview]) -> None:
    for part in parts:
        while part:
            part = part[os.write(wire, part) :]


def _reply(slam: Slam, kind: str, fields: Fields) -> Reply:
    if kind == "hello":
        return {"requires": text(slam.requires)}
    if kind == "activate":
        slam.activate(fields)
        return {}
    if kind == "scene":
        slam.set_scene(as_text(fields["scene"]))
        return {}
    if kind == "track":
        return slam.track(fields)
    return slam.trajectory() if kind == "trajectory" else slam.map()


def _arrays(reply: Reply) -> dict[str, NDArray[Any]]:
    """Return the values as arrays of the protocol's types."""
    arrays = {name: np.asarray(value) for name, value in reply.items()}
    return {n: a.astype(np.uint8) if a.dtype == bool else a for n, a in arrays.items()}
