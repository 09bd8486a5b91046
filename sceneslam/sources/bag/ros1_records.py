"""Records of a ROS 1 bag (format 2.0)."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from mmap import mmap

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 5, 6, 7
_U32, _TIME = struct.Struct("<I"), struct.Struct("<II")
_FIELDS = {  # required header fields of each record and their lengths [bytes], 0: any
    MESSAGE: {b"conn": 4, b"time": 8},
    BAG_HEADER: {b"index_pos": 8},
    CHUNK: {b"compression": 0},
    CHUNK_INFO: {b"chunk_pos": 8, b"start_time": 8, b"end_time": 8},
    CONNECTION: {b"conn": 4, b"topic": 0},
}
_LONGEST_HEADER = 1 << 16  # [bytes]; a longer one is damage

Blob = bytes | mmap


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BagRecord:
    """One record: its header fields and the position of its data."""

    opcode: int
    fields: dict[bytes, bytes]
    start: int  # [bytes]
    data_at: int  # [bytes]
    data_length: int  # [bytes]

    @property
    def end(self) -> int:
        """Return where the next record begins [bytes]."""
        return self.data_at + self.data_length

    def number(self, name: bytes) -> int:
        """Return a field that is an unsigned 32-bit number."""
        return int(_U32.unpack(self.fields[name])[0])

    def time_ns(self, name: bytes) -> int:
        """Return a field that is a time [ns]."""
        seconds, nanoseconds = _TIME.unpack(self.fields[name])
        return int(seconds) * 10**9 + int(nanoseconds)


def header_fields(header: bytes) -> dict[bytes, bytes] | None:
    """Return the fields of a record's header, None if their lengths contradict the header's."""
    fields, position = {}, 0
    while position < len(header):
        if position + _U32.size > len(header):
            return None
        (length,) = _U32.unpack_from(header, position)
        position += _U32.size
        name, equals, value = header[position : position + length].partition(b"=")
        position += length
        if not equals or position > len(header):
            return None
        fields[name] = value
    return fields


def record_at(data: Blob, position: int) -> BagRecord | None:
    """Return the record at a position [bytes], None at the end of the data; it may be cut off."""
    if position + _U32.size > len(data):
        return None
    (length,) = _U32.unpack_from(data, position)
    start = position + _U32.size
    end = start + length
    if length > _LONGEST_HEADER or end + _U32.size > len(data):
        return None
    fields = header_fields(data[start:end])
    if fields is None or not _is_complete(fields):
        return None
    (size,) = _U32.unpack_from(data, end)
    return BagRecord(
        opcode=fields[b"op"][0],
        fields=fields,
        start=position,
        data_at=end + _U32.size,
        data_length=size,
    )


def records_in(data: bytes) -> Iterator[BagRecord]:
    """Yield a chunk's records; after damage, continue at the next message."""
    position: int | None = 0
    while position is not None and position < len(data):
        record = record_at(data, position)
        if record is None or record.end > len(data):
            position = find_message(data, position + 1)
        else:
            yield record
            position = record.end


def find_chunk(data: Blob, start: int) -> int | None:
    """Return the position [bytes] of the first chunk record at or after `start`, None without."""
    return _find(data, start, b"compression=", CHUNK)


def find_message(data: bytes, start: int) -> int | None:
    """Return the position [bytes] of the first message at or after `start`, None without."""
    return _find(data, start, b"op=\x02", MESSAGE)


def _find(data: Blob, start: int, mark: bytes, opcode: int) -> int | None:
    found = data.find(mark, start)
    while found >= 0:
        # The fields stand in any order: the record begins up to 64 bytes before this one.
        for position in range(max(start, found - 64), found - 7):
            record = record_at(data, position)
            if record is not None and record.opcode == opcode:
                return position
        found = data.find(mark, found + 1)
    return None


def _is_complete(fields: dict[bytes, bytes]) -> bool:
    """Tell whether a record has all required fields of its type."""
    if len(fields.get(b"op", b"")) != 1:
        return False
    needed = _FIELDS.get(fields[b"op"][0], {})
    return all(name in fields and size in (0, len(fields[name])) for name, size in needed.items())


def unpack(compression: bytes, data: bytes) -> bytes | None:
    """Return a chunk's records, None when they cannot be decompressed."""
    import lz4.frame  # type: ignore[import-untyped]

    try:
        if compression == b"bz2":
            return bz2.decompress(data)
        if compression == b"lz4":
            return bytes(lz4.frame.decompress(data))
    except (OSError, ValueError, RuntimeError, EOFError):
        return None
    return data if compression == b"none" else None
