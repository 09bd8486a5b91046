"""Records of an MCAP file, verified by their checksums."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 2, 3, 4, 5, 6, 12, 15
_CHUNK_HEAD = struct.Struct("<QQQII")  # times, size, checksum, length of the compression's name
_FOOTER_BODY = struct.Struct("<QQI")  # summary start, summary offset start, summary checksum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class McapRecord:
    """One record outside of any chunk."""

    opcode: int
    body: memoryview


@dataclass(slots=True)
class Content:
    """Records collected while reading a file."""

    schemas: dict[int, Any] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)  # by channel
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)

    def take(self, records: Sequence[McapRecord] | None) -> dict[int, tuple[int, int]] | None:
        """Add records; return each channel's first and last log time [ns], None if damaged."""
        from mcap.exceptions import McapError

        try:
            return None if records is None else self._take(records)
        except (McapError, ValueError, struct.error):
            return None

    def _take(self, records: Sequence[McapRecord]) -> dict[int, tuple[int, int]]:
        from mcap import records as mcap
        from mcap.data_stream import ReadDataStream

        span: dict[int, tuple[int, int]] = {}
        for record in records:
            if record.opcode == MESSAGE:
                channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(record.body)
                first_ns, last_ns = span.get(channel, (log_ns, log_ns))
                span[channel] = (min(first_ns, log_ns), max(last_ns, log_ns))
                self.counts[channel] += 1
                continue
            stream = ReadDataStream(BytesIO(record.body))
            if record.opcode == SCHEMA:
                schema = mcap.Schema.read(stream)
                self.schemas[schema.id] = schema
            elif record.opcode == CHANNEL:
                found = mcap.Channel.read(stream)
                self.channels[found.id] = found
            elif record.opcode == METADATA:
                named = mcap.Metadata.read(stream)
                self.metadata[named.name] = dict(named.metadata)
        return span


def read_records(data: bytes) -> Sequence[McapRecord] | None:
    """Return the records in one record's bytes (of a chunk, those inside), None if damaged.

    Of a chunk that is cut off, the complete records are returned.
    """
    view = memoryview(data)
    if len(view) < RECORD_HEAD.size:
        return None
    opcode, length = RECORD_HEAD.unpack_from(view)
    body = view[RECORD_HEAD.size :]
    if len(body) < length and opcode == CHUNK:
        return _split(memoryview(_unpack_cut_chunk(body)), is_cut=True)
    if len(body) != length:
        return None
    if opcode != CHUNK:
        return [McapRecord(opcode=opcode, body=body)]
    unpacked = _unpack_chunk(body)
    return None if unpacked is None else _split(memoryview(unpacked))


def has_end(file: IO[bytes]) -> bool:
    """Tell whether the file ends with a footer and the MCAP signature."""
    size = file.seek(0, 2)
    file.seek(max(size - len(MAGIC), len(MAGIC)))
    return file.read() == MAGIC


def has_summary(file: IO[bytes]) -> bool:
    """Tell whether the file has a summary; raises ValueError if the summary is damaged."""
    tail = RECORD_HEAD.size + _FOOTER_BODY.size + len(MAGIC)
    size = file.seek(0, 2)
    if size < tail + len(MAGIC) or not has_end(file):
        raise ValueError("the file is not finished")
    file.seek(size - tail)
    end = file.read(tail)
    opcode, length = RECORD_HEAD.unpack_from(end)
    if opcode != FOOTER or length != _FOOTER_BODY.size:
        raise ValueError("the footer is damaged")
    start, _, checksum = _FOOTER_BODY.unpack_from(end, RECORD_HEAD.size)
    if start == 0:
        return False
    if not len(MAGIC) <= start <= size - tail:
        raise ValueError("the footer is damaged")
    file.seek(start)
    summary = file.read(size - len(MAGIC) - 4 - start)  # the checksum does not cover itself
    if checksum not in (0, zlib.crc32(summary)):
        raise ValueError("the summary is damaged")
    return True


def _unpack_chunk(body: memoryview) -> bytes | None:
    from mcap import records as mcap
    from mcap.data_stream import ReadDataStream
    from mcap.stream_reader import get_chunk_data_stream

    try:
        chunk = mcap.Chunk.read(ReadDataStream(BytesIO(body)))
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        return bytes(stream.read(length))
    except Exception:  # three compression libraries, each with its own exceptions
        return None


def _unpack_cut_chunk(body: memoryview) -> bytes:
    """Return the bytes that can be decompressed from the beginning of a chunk."""
    import lz4.frame  # type: ignore[import-untyped]
    import zstandard

    # Header: first and last time, size, checksum, compression, length of the compressed data.
    if len(body) < _CHUNK_HEAD.size:
        return b""
    *_, length = _CHUNK_HEAD.unpack_from(body)
    compression = bytes(body[_CHUNK_HEAD.size :][:length])
    packed = bytes(body[_CHUNK_HEAD.size + length + 8 :])
    try:
        if compression == b"lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
        if compression == b"zstd":
            return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(packed))
    except (RuntimeError, ValueError, EOFError, zstandard.ZstdError):
        return b""
    return packed if not compression else b""


def _split(view: memoryview, *, is_cut: bool = False) -> Sequence[McapRecord] | None:
    records: list[McapRecord] = []
    position = 0
    while position + RECORD_HEAD.size <= len(view):
        opcode, length = RECORD_HEAD.unpack_from(view, position)
        start = position + RECORD_HEAD.size
        position = start + length
        if position > len(view) or (opcode == MESSAGE and length < MESSAGE_HEAD.size):
            return records if is_cut else None
        records.append(McapRecord(opcode=opcode, body=view[start:position]))
    return records
