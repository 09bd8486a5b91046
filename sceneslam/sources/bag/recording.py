"""The interface of recordings of ROS messages, for all file formats."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.sources.prefetch import prefetched


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Message:
    """One recorded message, not yet decoded."""

    topic: str
    log_ns: int  # time of recording
    data: bytes


class Recording(Protocol):
    """Recorded messages, ordered by time."""

    @property
    def topics(self) -> Mapping[str, TopicType]:
        """Return the topics that hold messages."""
        ...

    @property
    def skipped(self) -> Sequence[str]:
        """Return the topics, with type and encoding, whose encoding is not read."""
        ...

    @property
    def faults(self) -> Sequence[str]:
        """Return one sentence per type of damage found so far."""
        ...

    @property
    def is_slow(self) -> bool:
        """Tell whether decompression is slower than real time."""
        ...

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Return the metadata that was recorded beside the messages."""
        ...

    def messages(self, topics: Collection[str], from_ns: int | None = None) -> Iterator[Message]:
        """Yield the messages of `topics` by recording time, from `from_ns` or the beginning on."""
        ...

    def last(self, topic: str) -> Message | None:
        """Return a topic's last message, None if that would require a full read."""
        ...

    def decode(self, message: Message) -> Any:
        """Return the decoded message, None if its bytes are invalid."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """A part of a file that is read as a whole, and is left out as a whole if damaged."""

    file: Path
    offset: int  # [bytes]
    length: int  # [bytes]
    start_ns: int
    end_ns: int
    topics: frozenset[str]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layout:
    """The positions of a file's chunks, and its topics."""

    chunks: Sequence[Chunk]
    topics: Mapping[str, TopicType]
    metadata: Mapping[str, Mapping[str, str]]
    lost_bytes: int = 0  # bytes outside of all readable chunks
    note: str = ""  # sentence on the file's damage, "" without
    skipped: Sequence[str] = ()  # topics, with type and encoding, whose encoding is not read


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChunkContent:
    """The readable messages of a chunk."""

    messages: Sequence[Message]
    lost_bytes: int = 0


INDEX_IS_DAMAGED = "its index is damaged (read without it)"


def cut_off(
    chunks: Sequence[Chunk],
    topics: Mapping[str, TopicType],
    missing: str = "the rest of the recording",
) -> str:
    """Return the sentence on a file whose end is missing: what is readable and what is not."""
    if not chunks:
        return "cut off before its first chunk was complete"
    span_s = (max(one.end_ns for one in chunks) - min(one.start_ns for one in chunks)) * 1e-9
    count = sum(topic.count for topic in topics.values())
    return (
        f"cut off after {span_s:.1f} s / {count} messages; "
        f"{missing} is missing and could not be read"
    )


ChunkReader = Callable[[Chunk], ChunkContent]


class ChunkedRecording:
    """Files of chunks, read chunk by chunk; damaged chunks are left out and reported."""

    def __init__(
        self, layouts: Sequence[Layout], read_chunk: ChunkReader, *, is_slow: bool = False
    ) -> None:
        self.is_slow = is_slow  # to decompress; chunks are then read ahead in threads
        self._chunks = sorted(
            (chunk for layout in layouts for chunk in layout.chunks),
            key=lambda chunk: (chunk.start_ns, chunk.file, chunk.offset),
        )
        self._read_chunk = read_chunk
        self._layouts = layouts
        self._damaged: dict[Chunk, int] = {}
        self._recent: tuple[Chunk, ChunkContent] | None = None
        self.topics = _merge_topics(layouts)
        self.skipped = sorted({one for layout in layouts for one in layout.skipped})
        self.metadata = {name: text for layout in layouts for name, text in layout.metadata.items()}
        self._decoder = MessageDecoder(self.topics)

    @property
    def faults(self) -> Sequence[str]:
        """Return the files' damage and the amount of lost data."""
        notes = [layout.note for layout in self._layouts if layout.note]
        lost = sum(layout.lost_bytes for layout in self._layouts) + sum(self._damaged.values())
        if lost:
            size = sum(path.stat().st_size for path in {chunk.file for chunk in self._chunks})
            share = f"{100 * lost / size:.1f} % of the file (" if size else ""
            amount = f"{_amount(lost)} of {_amount(size)})" if size else _amount(lost)
            notes.append(f"{share}{amount} is damaged and could not be read")
        return ["; ".join(notes)] if notes else []

    def messages(self, topics: Collection[str], from_ns: int | None = None) -> Iterator[Message]:
        """Yield the messages by recording time; only overlapping chunks are in memory."""
        waiting: list[tuple[int, int, int, Message]] = []
        least_ns = -(2**63) if from_ns is None else from_ns
        chunks = [
            chunk
            for chunk in self._chunks
            if chunk.end_ns >= least_ns and not chunk.topics.isdisjoint(topics)
        ]
        contents = self._contents(chunks)
        for number, chunk in enumerate(chunks):
            while waiting and waiting[0][0] < chunk.start_ns:
                yield heapq.heappop(waiting)[3]
            for index, message in enumerate(next(contents).messages):
                if message.topic in topics and message.log_ns >= least_ns:
                    heapq.heappush(waiting, (message.log_ns, number, index, message))
        while waiting:
            yield heapq.heappop(waiting)[3]

    def last(self, topic: str) -> Message | None:
        """Return the topic's last message by recording time."""
        best: Message | None = None
        for chunk in sorted(self._chunks, key=lambda chunk: chunk.end_ns, reverse=True):
            if best is not None and chunk.end_ns < best.log_ns:
                break
            if topic in chunk.topics:
                found = [
                    message for message in self._read(chunk).messages if message.topic == topic
                ]
                best = max(
                    [*found, *([best] if best else [])], key=lambda m: m.log_ns, default=None
                )
        return best

    def decode(self, message: Message) -> Any:
        """Return the decoded message, None if its bytes are invalid."""
        return self._decoder.decode(message.topic, message.data)

    def _contents(self, chunks: Sequence[Chunk]) -> Iterator[ChunkContent]:
        """Yield the chunks' contents; slow chunks are read ahead."""
        begin = 1 if self.is_slow else len(chunks)  # a caller may need the first message only
        yield from map(self._read, chunks[:begin])
        jobs = (partial(self._read_chunk, chunk) for chunk in chunks[begin:])
        if begin < len(chunks):
            for chunk, content in zip(chunks[begin:], prefetched(jobs, ahead=2), strict=True):
                yield self._noted(chunk, content)

    def _read(self, chunk: Chunk) -> ChunkContent:
        if self._recent is None or self._recent[0] != chunk:
            self._recent = (chunk, self._noted(chunk, self._read_chunk(chunk)))
        return self._recent[1]

    def _noted(self, chunk: Chunk, content: ChunkContent) -> ChunkContent:
        if content.lost_bytes:
            self._damaged[chunk] = content.lost_bytes
        return content


def _amount(count: int) -> str:
    """Return a number of bytes as text."""
    return f"{count / 1e6:.1f} MB" if count >= 100_000 else f"{count} bytes"


def _merge_topics(layouts: Sequence[Layout]) -> dict[str, TopicType]:
    """Return the topics of all files with the sums of their counts."""
    merged: dict[str, TopicType] = {}
    for layout in layouts:
        for name, topic in layout.topics.items():
            known = merged.get(name)
            merged[name] = topic if known is None else topic.with_count(topic.count + known.count)
    return merged
