"""Pickles in which large arrays stay where they are, and the values of every step are short."""

from __future__ import annotations

import copyreg
import io
import pickle
from collections.abc import Callable
from typing import Any

from sceneslam.supervision.messages import Reply, Request
from sceneslam.types.observation import LaserScan, Observation, Tracking

_SMALL_BYTES = 1 << 12  # an array up to a page is copied more cheaply than it is referred to


def packed(value: object) -> tuple[bytes, list[memoryview]]:
    """Return the pickle of a value and the bytes of its large arrays, to be passed with it."""
    arrays: list[memoryview] = []

    def is_inside(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes > _SMALL_BYTES:
            arrays.append(raw)
        return raw.nbytes <= _SMALL_BYTES

    head = io.BytesIO()
    pickler = pickle.Pickler(head, protocol=5, buffer_callback=is_inside)
    pickler.dispatch_table = _REDUCERS
    pickler.dump(value)
    return head.getvalue(), arrays


def _reduced(value: Any) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Return how to make a frozen dataclass anew, at a third of what dataclasses take for it."""
    return _restored, (type(value), *(getattr(value, name) for name in value.__slots__))


def _restored(kind: type, *values: object) -> object:
    restored: object = object.__new__(kind)
    for name, value in zip(kind.__slots__, values, strict=True):  # type: ignore[attr-defined]
        object.__setattr__(restored, name, value)
    return restored


_OF_EVERY_STEP = (Request, Reply, Observation, LaserScan, Tracking)
_REDUCERS = copyreg.dispatch_table | dict.fromkeys(_OF_EVERY_STEP, _reduced)
