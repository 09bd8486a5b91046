"""Serialisation of messages: plain tuples, and large arrays that are not copied.

After a switch of processes, code that is not in the caches runs several times more slowly. The
types of every tracking step are therefore converted directly, with much less code than pickle. All
other values are pickled.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import Any

import numpy as np

from sceneslam.supervision.messages import Reply, Request
from sceneslam.types.observation import LaserScan, Observation, Tracking, TrackingStatus

_SMALL_BYTES = 1 << 12  # copying an array up to a page is cheaper than a reference
_PLAIN = (int, float, str, bool, type(None))
_KINDS: tuple[Any, ...] = (
    Request,
    Reply,
    Observation,
    LaserScan,
    Tracking,
)
_FIELDS = {kind: (place, kind.__slots__) for place, kind in enumerate(_KINDS)}
_PICKLE, _TUPLE, _STATUS, _SMALL, _LARGE = range(-5, 0)


def take_apart(value: Any, large: list[memoryview]) -> Any:
    """Return a value as numbers, text, bytes and tuples; large arrays are appended to `large`."""
    kind = type(value)
    if kind in _PLAIN:
        return value
    if kind is np.ndarray:
        return _take_array(value, large)
    found = _FIELDS.get(kind)
    if found is not None:
        return (found[0], *[take_apart(getattr(value, name), large) for name in found[1]])
    if kind is tuple:
        return (_TUPLE, *[take_apart(item, large) for item in value])
    if kind is TrackingStatus:
        return (_STATUS, value.value)
    return _pickled(value, large)


def put_together(item: Any, large: Sequence[Any]) -> Any:
    """Return the original value; `large` are the arrays' buffers."""
    if type(item) is not tuple:
        return item
    kind = item[0]
    if kind >= 0:
        return _restored(_KINDS[kind], [put_together(part, large) for part in item[1:]])
    if kind == _SMALL:
        return np.ndarray(item[2], item[1], item[3])
    if kind == _LARGE:
        return np.ndarray(item[2], item[1], large[item[3]])
    if kind == _TUPLE:
        return tuple([put_together(part, large) for part in item[1:]])
    if kind == _STATUS:
        return TrackingStatus(item[1])
    return pickle.loads(item[1], buffers=[large[place] for place in item[2]])


def _take_array(array: Any, large: list[memoryview]) -> Any:
    if array.dtype.kind not in "biuf":
        return _pickled(array, large)
    if array.nbytes <= _SMALL_BYTES:
        return (_SMALL, array.dtype.str, array.shape, array.tobytes())
    large.append(np.ascontiguousarray(array).data.cast("B"))
    return (_LARGE, array.dtype.str, array.shape, len(large) - 1)


def _pickled(value: object, large: list[memoryview]) -> Any:
    places: list[int] = []

    def is_inside(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes > _SMALL_BYTES:
            places.append(len(large))
            large.append(raw)
        return raw.nbytes <= _SMALL_BYTES

    head = pickle.dumps(value, protocol=5, buffer_callback=is_inside)
    return (_PICKLE, head, tuple(places))


def _restored(kind: type, values: Sequence[object]) -> object:
    """Return a frozen dataclass with these field values, without calling its constructor."""
    restored: object = object.__new__(kind)
    for name, value in zip(kind.__slots__, values, strict=True):  # type: ignore[attr-defined]
        object.__setattr__(restored, name, value)
    return restored
