"""Messages as bytes: a header of 40 bytes, then named arrays (see `docs/own_program.md`).

This file needs only NumPy, since both ends use it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERSION = 1
MAGIC = b"SceneSL%d" % VERSION
_HEAD = struct.Struct("<8s16sIIQ")  # magic, kind, number, count of fields, bytes that follow
_FIELD = struct.Struct("<32s4sI3Q")  # name, type, dimensions, shape; then the data
_TYPES = ("u1", "i4", "i8", "f4", "f8")
_ALIGN = 8
HEAD_BYTES = _HEAD.size

Fields = Mapping[str, NDArray[Any]]


class ProtocolError(Exception):
    """The received bytes are not a valid message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MessageHeader:
    """The header of a message."""

    kind: str
    number: int  # of the request; its reply has the same
    count: int  # of fields
    length: int  # of the fields together [bytes]


def pack(kind: str, number: int, fields: Fields) -> list[memoryview]:
    """Return a message as a list of buffers; large arrays are not copied."""
    parts: list[memoryview] = []
    for name, value in fields.items():
        array = np.asarray(value)
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        shape = [*array.shape, *[1] * (3 - array.ndim)]
        head = _FIELD.pack(name.encode(), little.dtype.str[1:].encode(), array.ndim, *shape)
        parts += [memoryview(head), little.reshape(-1).view(np.uint8).data]
        parts.append(memoryview(bytes(-little.nbytes % _ALIGN)))
    length = sum(part.nbytes for part in parts)
    head = _HEAD.pack(MAGIC, kind.encode(), number, len(fields), length)
    return [memoryview(head), *[part for part in parts if part.nbytes]]


def read_head(data: bytes) -> MessageHeader:
    """Return the header in the first 40 bytes; raises ProtocolError if it is invalid."""
    magic, kind, number, count, length = _HEAD.unpack(data)
    if magic[:-1] != MAGIC[:-1]:
        raise ProtocolError(f"wrote bytes that are not a message: {data[:24]!r}")
    if magic != MAGIC:
        raise ProtocolError(f"speaks version {magic[-1:].decode('latin1')}, expected {VERSION}")
    return MessageHeader(kind=_text(kind), number=number, count=count, length=length)


def read_fields(head: MessageHeader, data: bytes | bytearray) -> dict[str, NDArray[Any]]:
    """Return the arrays of a message, read-only; raises ProtocolError if they are invalid."""
    fields: dict[str, NDArray[Any]] = {}
    start = 0
    for _ in range(head.count):
        if start + _FIELD.size > len(data):
            raise ProtocolError(f"wrote a message {head.kind!r} that ends within a field")
        raw_name, raw_kind, dimensions, *shape = _FIELD.unpack_from(data, start)
        name, kind = _text(raw_name), _text(raw_kind)
        if kind not in _TYPES or dimensions > 3:
            allowed = f"one of {', '.join(_TYPES)} and up to 3"
            raise ProtocolError(
                f"wrote {name!r} as {kind!r} of {dimensions} dimensions, allowed: {allowed}"
            )
        start += _FIELD.size
        size, dtype = math.prod(shape[:dimensions]), np.dtype(f"<{kind}")
        if start + size * dtype.itemsize > len(data):
            raise ProtocolError(f"wrote {name!r} with {size} values, more than the message holds")
        array = np.frombuffer(data, dtype, size, start).reshape(shape[:dimensions])
        array.flags.writeable = False
        fields[name] = array
        start += -(-size * dtype.itemsize // _ALIGN) * _ALIGN
    return fields


def text(value: str) -> NDArray[np.uint8]:
    """Return text as an array of its bytes."""
    return np.frombuffer(value.encode(), np.uint8)


def as_text(array: NDArray[Any]) -> str:
    """Return an array of bytes as text."""
    return array.tobytes().decode("utf-8", "replace")


def _text(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace")
