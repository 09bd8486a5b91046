"""MCAP files as chunks: by their index or, if it is damaged, by a full read."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO

from sceneslam.ros.messages import TopicType
from sceneslam.sources.bag import mcap_records as records
from sceneslam.sources.bag.recording import (
    INDEX_IS_DAMAGED,
    Chunk,
    ChunkContent,
    ChunkedRecording,
    Layout,
    Message,
    cut_off,
)
from sceneslam.types.errors import InputError

ENCODINGS = ("cdr", "ros1")
_KEPT = (records.SCHEMA, records.CHANNEL, records.MESSAGE, records.CHUNK, records.METADATA)


def open_mcap(paths: Sequence[Path]) -> ChunkedRecording:
    """Return one recording of all files; raises InputError unless all are MCAP files."""
    files = {path: McapFile(path) for path in paths}
    layouts = [file.layout() for file in files.values()]
    return ChunkedRecording(layouts, lambda chunk: files[chunk.file].read(chunk))


class McapFile:
    """One file; knows its channels once `layout` has been called."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: dict[int, str] = {}  # channel -> topic

    def layout(self) -> Layout:
        """Return the chunks and topics, from the index or, if it is damaged, from the content."""
        from mcap.exceptions import McapError

        size = self._path.stat().st_size
        if size == 0:
            raise InputError(f"recording: expected an MCAP file, got an empty one: {self._path}")
        with self._path.open("rb") as file:
            if file.read(len(records.MAGIC)) != records.MAGIC:
                raise InputError(f"recording: this is no MCAP file: {self._path}")
            try:
                layout, note = self._from_index(file), ""
            except (McapError, ValueError, KeyError, struct.error, OSError):
                layout, note = None, INDEX_IS_DAMAGED
            return layout or self._from_content(file, size, note)

    def read(self, chunk: Chunk) -> ChunkContent:
        """Return a chunk's messages; a damaged chunk is left out as a whole."""
        with self._path.open("rb") as file:
            file.seek(chunk.offset)
            found = records.read_records(file.read(chunk.length))
        if found is None:
            return ChunkContent(messages=(), lost_bytes=chunk.length)
        messages = []
        for record in found:
            if record.opcode != records.MESSAGE:
                continue
            channel, _, log_ns, _ = records.MESSAGE_HEAD.unpack_from(record.body)
            if channel in self._names:
                data = bytes(record.body[records.MESSAGE_HEAD.size :])
                messages.append(Message(topic=self._names[channel], log_ns=log_ns, data=data))
        return ChunkContent(messages=messages)

    def _from_index(self, file: IO[bytes]) -> Layout | None:
        """Return the layout by the file's summary, None if it has no summary.

        Raises any exception of the reader if the summary is damaged.
        """
        from mcap.reader import SeekingReader

        if not records.has_summary(file):
            return None
        file.seek(0)
        reader = SeekingReader(file)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            return None
        if not summary.statistics.channel_message_counts:  # a writer need not count by channel
            return None
        metadata = {entry.name: dict(entry.metadata) for entry in reader.iter_metadata()}
        content = records.Content(
            schemas=summary.schemas,
            channels=summary.channels,
            counts=Counter(summary.statistics.channel_message_counts),
            metadata=metadata,
        )
        topics = self._topics(content)
        chunks = [
            Chunk(
                file=self._path,
                offset=entry.chunk_start_offset,
                length=entry.chunk_length,
                start_ns=entry.message_start_time,
                end_ns=entry.message_end_time,
                topics=self._named(entry.message_index_offsets or summary.channels),
            )
            for entry in summary.chunk_indexes
        ]
        # No index lists the messages outside of chunks.
        begin = len(records.MAGIC)
        for entry in sorted(summary.chunk_indexes, key=lambda entry: entry.chunk_start_offset):
            chunks += self._messages_between(file, begin, entry.chunk_start_offset)
            begin = entry.chunk_start_offset + entry.chunk_length + entry.message_index_length
        chunks += self._messages_between(file, begin, self._path.stat().st_size)
        return Layout(
            chunks=chunks, topics=topics, metadata=metadata, skipped=list(_skipped(content))
        )

    def _messages_between(self, file: IO[bytes], begin: int, end: int) -> Iterator[Chunk]:
        """Yield the messages in a part of the file without chunks, each as a chunk of its own."""
        while begin + records.RECORD_HEAD.size <= end:
            file.seek(begin)
            opcode, length = records.RECORD_HEAD.unpack(file.read(records.RECORD_HEAD.size))
            whole = records.RECORD_HEAD.size + length
            if opcode == records.DATA_END or begin + whole > end:
                return
            if opcode == records.MESSAGE and length >= records.MESSAGE_HEAD.size:
                head = file.read(records.MESSAGE_HEAD.size)
                channel, _, log_ns, _ = records.MESSAGE_HEAD.unpack(head)
                yield Chunk(
                    file=self._path,
                    offset=begin,
                    length=whole,
                    start_ns=log_ns,
                    end_ns=log_ns,
                    topics=self._named([channel]),
                )
            begin += whole

    def _from_content(self, file: IO[bytes], size: int, note: str) -> Layout:
        """Return the layout by reading the whole file, up to its last readable record.

        `note` describes the damage of the index.
        """
        content, spans, lost = records.Content(), [], 0
        position, is_complete, is_cut = len(records.MAGIC), False, not records.has_end(file)
        while position + records.RECORD_HEAD.size <= size and not is_complete:
            file.seek(position)
            opcode, length = records.RECORD_HEAD.unpack(file.read(records.RECORD_HEAD.size))
            whole = records.RECORD_HEAD.size + length
            if position + whole > size and not (is_cut and opcode == records.CHUNK):
                break
            whole = min(whole, size - position)
            is_complete = opcode == records.DATA_END
            if opcode in _KEPT:
                file.seek(position)
                span = content.take(records.read_records(file.read(whole)))
                lost += whole if span is None else 0
                spans.append((position, whole, span))
            position += whole
        topics = self._topics(content)
        chunks = [
            Chunk(
                file=self._path,
                offset=offset,
                length=length,
                start_ns=min(first for first, _ in span.values()),
                end_ns=max(last for _, last in span.values()),
                topics=self._named(span),
            )
            for offset, length, span in spans
            if span
        ]
        if not is_complete and not is_cut:
            lost += size - position  # damage within the file, not at its end
        elif not is_complete:
            note = cut_off(chunks, topics)
        return Layout(
            chunks=chunks,
            topics=topics,
            metadata=content.metadata,
            lost_bytes=lost,
            note=note,
            skipped=list(_skipped(content)),
        )

    def _named(self, channels: Iterable[int]) -> frozenset[str]:
        return frozenset(self._names[number] for number in channels if number in self._names)

    def _topics(self, content: records.Content) -> dict[str, TopicType]:
        """Return the topics that hold ROS messages; store the topic of each channel."""
        topics: dict[str, TopicType] = {}
        for number, channel in content.channels.items():
            schema = content.schemas.get(channel.schema_id)
            count = content.counts[number]
            if channel.message_encoding not in ENCODINGS or schema is None or not count:
                continue
            self._names[number] = channel.topic
            known = topics.get(channel.topic)
            topics[channel.topic] = TopicType(
                msgtype=schema.name
                if "/msg/" in schema.name
                else schema.name.replace("/", "/msg/"),
                encoding=channel.message_encoding,
                definition=schema.data.decode(errors="replace"),
                definition_format=schema.encoding,
                count=count + (known.count if known else 0),
            )
        return topics


def _skipped(content: records.Content) -> Iterator[str]:
    """Yield the topics, with type and encoding, whose encoding is not read."""
    for number, channel in content.channels.items():
        if content.counts[number] and channel.message_encoding not in ENCODINGS:
            schema = content.schemas.get(channel.schema_id)
            name = "" if schema is None else f"{schema.name}, "
            yield f"{channel.topic} ({name}{channel.message_encoding})"
