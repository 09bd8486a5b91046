"""Contents of a ROS 1 bag: from its index or, if that is damaged, from a full read."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from mmap import mmap

from sceneslam.sources.bag import ros1_records as records
from sceneslam.sources.bag.ros1_records import BagRecord

_INDEX_RECORD_BYTES, _INDEX_ENTRY_BYTES = 55, 12
_CONNECTION_BYTES = 8192  # approximate size of a connection record with its message definition
_KNOWN = range(records.MESSAGE, records.CONNECTION + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChunkSpan:
    """The time range of a chunk and its number of messages per connection."""

    start_ns: int
    end_ns: int
    counts: dict[int, int]


@dataclass(slots=True, eq=False)
class BagSurvey:
    """The contents of a bag; a chunk's position is the first byte of its record."""

    blob: mmap
    chunks: dict[int, BagRecord] = field(default_factory=dict)
    spans: dict[int, ChunkSpan] = field(default_factory=dict)
    connections: dict[int, dict[bytes, bytes]] = field(default_factory=dict)  # topic, type, ...
    index_at: int | None = None  # [bytes], by the bag's header; 0: the bag was never closed
    is_sound: bool = True
    lost_bytes: int = 0

    def run(self) -> None:
        """Read the records; unpack the chunks as well if the index is damaged."""
        gaps = self._walk()
        named = {number for span in self.spans.values() for number in span.counts}
        is_whole = set(self.spans) == set(self.chunks) and named <= set(self.connections)
        if self.is_sound and is_whole:
            return
        self.is_sound = False
        for place, record in self.chunks.items():
            self._look_into(place, record)
        for place, gap_bytes in gaps.items():
            span = self.spans.get(place)
            counts = span.counts if span else {}
            index_bytes = _INDEX_RECORD_BYTES * len(counts)
            index_bytes += _INDEX_ENTRY_BYTES * sum(counts.values())
            self.lost_bytes += max(0, gap_bytes - index_bytes)

    @property
    def is_cut_off(self) -> bool:
        """Tell whether the bag ends before its index begins."""
        if self.index_at:
            return self.index_at > len(self.blob)
        return self.index_at == 0 or any(map(self.is_beyond, self.chunks.values()))

    def is_beyond(self, record: BagRecord) -> bool:
        """Tell whether a record extends beyond the end of the file."""
        return record.end > len(self.blob)

    def counts(self) -> Counter[int]:
        """Return how many messages each connection has."""
        total: Counter[int] = Counter()
        for span in self.spans.values():
            total.update(span.counts)
        return total

    def content(self, record: BagRecord) -> bytes | None:
        """Return a chunk's bytes, possibly cut off; None if they cannot be unpacked."""
        data = self.blob[record.data_at : record.end]
        return records.unpack(record.fields.get(b"compression", b""), data)

    def _walk(self) -> dict[int, int]:
        """Read all records; return the unreadable bytes after each chunk, by its position."""
        gaps: dict[int, int] = {}
        position = chunk_end = len(records.MAGIC)
        last = -1  # position of the last chunk
        while position < len(self.blob):
            record = records.record_at(self.blob, position)
            if record is not None and self._take(position, record):
                if record.opcode == records.CHUNK:
                    last, chunk_end = position, record.end
                position = record.end
                continue
            self.is_sound = False
            found = records.find_chunk(self.blob, chunk_end)
            spare = _CONNECTION_BYTES * max(len(self.connections), 1)
            end = len(self.blob) - spare if found is None else found
            if found is not None or not self.is_cut_off:
                gaps[last] = end - chunk_end
            position = len(self.blob) if found is None else found
        self.is_sound &= position == len(self.blob)
        return gaps

    def _take(self, place: int, record: BagRecord) -> bool:
        """Store a record's content; return whether it is valid (a chunk may be cut off)."""
        if record.opcode not in _KNOWN:
            return False
        if record.opcode != records.CHUNK and self.is_beyond(record):
            return False
        if record.opcode == records.CHUNK:
            self.chunks[place] = record
        elif record.opcode == records.BAG_HEADER:
            self.index_at = int.from_bytes(record.fields[b"index_pos"], "little")
        elif record.opcode == records.CONNECTION:
            self._take_connection(record, self.blob[record.data_at : record.end])
        elif record.opcode == records.CHUNK_INFO:
            data = self.blob[record.data_at : record.end]
            numbers = [int.from_bytes(data[at : at + 4], "little") for at in range(0, len(data), 4)]
            counts = dict(zip(numbers[::2], numbers[1::2], strict=False))
            self.spans[int.from_bytes(record.fields[b"chunk_pos"], "little")] = ChunkSpan(
                start_ns=record.time_ns(b"start_time"),
                end_ns=record.time_ns(b"end_time"),
                counts=counts,
            )
        return True

    def _take_connection(self, record: BagRecord, data: bytes) -> None:
        definition = records.header_fields(data)
        if definition and b"type" in definition and b"topic" in record.fields:
            topic = {b"topic": record.fields[b"topic"]}
            self.connections[record.number(b"conn")] = {**definition, **topic}

    def _look_into(self, place: int, record: BagRecord) -> None:
        """Read connections, times and message counts from a chunk's content."""
        data = self.content(record) or b""
        counts: Counter[int] = Counter()
        times_ns = []
        for inner in records.records_in(data):
            if inner.opcode == records.CONNECTION:
                self._take_connection(inner, data[inner.data_at : inner.end])
            elif inner.opcode == records.MESSAGE:
                counts[inner.number(b"conn")] += 1
                times_ns.append(inner.time_ns(b"time"))
        if times_ns:
            self.spans[place] = ChunkSpan(
                start_ns=min(times_ns), end_ns=max(times_ns), counts=dict(counts)
            )
