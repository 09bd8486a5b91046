"""Pickles in which large arrays stay where they are, and the values of every step are short."""

from __future__ import annotations

import copyreg
import io
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def _reduced_array(array: NDArray[Any]) -> Any:
    """Return how to make an array anew; a small one of numbers at a sixth of what NumPy takes."""
    if array.nbytes > _SMALL_BYTES or array.dtype.kind not in "biuf":
        return array.__reduce_ex__(5)
    return _restored_array, (array.dtype.str, array.shape, array.tobytes())


def _restored_array(dtype: str, shape: tuple[int, ...], content: bytes) -> NDArray[Any]:
    return np.frombuffer(content, dtype).reshape(shape)


_OF_EVERY_STEP = (Request, Reply, Observation, LaserScan, Tracking)
_REDUCERS = {
    **copyreg.dispatch_table,
    **dict.fromkeys(_OF_EVERY_STEP, _reduced),
    np.ndarray: _reduced_array,
}
