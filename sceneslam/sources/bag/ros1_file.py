"""ROS 1 bags as chunks of messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from mmap import ACCESS_READ, mmap
from pathlib import Path

from sceneslam.ros.messages import TopicType
from sceneslam.sources.bag import ros1_records as records
from sceneslam.sources.bag.recording import (
    INDEX_IS_DAMAGED,
    Chunk,
    ChunkContent,
    ChunkedRecording,
    Layout,
    Message,
    cut_off,
)
from sceneslam.sources.bag.ros1_survey import BagSurvey
from sceneslam.types.errors import InputError

# The first message of a part comes after the last one of the part before, and sensors send
# several per second; a busy computer loses seconds of them.
_PAUSE_MAX_S = 10.0


def open_bags(paths: Sequence[Path]) -> ChunkedRecording:
    """Return one recording of all files, parts of one bag in their order.

    Raises InputError unless all are ROS 1 bags, and each begins when the one before ends.
    """
    bags = {path: BagFile(path) for path in paths}
    layouts = [bag.layout() for bag in bags.values()]
    for before, after in pairwise(one for one in layouts if one.chunks):
        _check_continued(before, after)
    is_slow = any(bag.is_slow for bag in bags.values())
    return ChunkedRecording(layouts, lambda chunk: bags[chunk.file].read(chunk), is_slow=is_slow)


def _check_continued(before: Layout, after: Layout) -> None:
    """Raise InputError if a bag does not begin when the one before ends, and none is damaged."""
    end_ns = max(chunk.end_ns for chunk in before.chunks)
    pause_s = (min(chunk.start_ns for chunk in after.chunks) - end_ns) * 1e-9
    if abs(pause_s) > _PAUSE_MAX_S and not before.note and not after.note:
        file, last = after.chunks[0].file, before.chunks[0].file
        raise InputError(
            f"recording: not parts of one bag, give one of them: {file.name} begins "
            f"{pause_s:.1f} s after the end of {last.name}: {file.parent}"
        )


class BagFile:
    """One bag; knows its connections once `layout` has been called."""

    def __init__(self, path: Path) -> None:
        if path.stat().st_size == 0:
            raise InputError(f"recording: expected a ROS 1 bag, got an empty file: {path}")
        with path.open("rb") as file:
            blob = mmap(file.fileno(), 0, access=ACCESS_READ)
        if blob[: len(records.MAGIC)] != records.MAGIC:
            raise InputError(f"recording: this is no ROS 1 bag of format 2.0: {path}")
        self._path = path
        self._survey = BagSurvey(blob)
        self._names: dict[int, str] = {}  # connection -> topic

    @property
    def is_slow(self) -> bool:
        """Tell whether a chunk takes long to unpack."""
        kinds = {record.fields[b"compression"] for record in self._survey.chunks.values()}
        return b"bz2" in kinds

    def layout(self) -> Layout:
        """Return the chunks and topics."""
        survey = self._survey
        survey.run()
        topics = self._topics()
        chunks = [
            Chunk(
                file=self._path,
                offset=place,
                length=min(survey.chunks[place].end, len(survey.blob)) - place,
                start_ns=span.start_ns,
                end_ns=span.end_ns,
                topics=frozenset(
                    self._names[number] for number in span.counts if number in self._names
                ),
            )
            for place, span in survey.spans.items()
            if place in survey.chunks
        ]
        return Layout(
            chunks=chunks,
            topics=topics,
            metadata={},
            lost_bytes=survey.lost_bytes,
            note=self._note(chunks, topics),
        )

    def read(self, chunk: Chunk) -> ChunkContent:
        """Return the undamaged messages of a chunk."""
        survey = self._survey
        outer = survey.chunks[chunk.offset]
        is_last = survey.is_cut_off and survey.is_beyond(outer)  # the rest is missing
        data = survey.content(outer)
        if data is None:
            return ChunkContent(messages=(), lost_bytes=0 if is_last else chunk.length)
        messages, lost, position = [], 0, 0
        for record in records.records_in(data):
            lost += record.start - position
            position = record.end
            if record.opcode != records.MESSAGE:
                continue
            topic = self._names.get(record.number(b"conn"))
            if topic is not None:
                payload = data[record.data_at : record.end]
                messages.append(Message(topic=topic, log_ns=record.time_ns(b"time"), data=payload))
        lost += 0 if is_last else len(data) - position
        return ChunkContent(messages=messages, lost_bytes=lost)

    def _note(self, chunks: Sequence[Chunk], topics: Mapping[str, TopicType]) -> str:
        """Return a sentence on damage of the bag as a whole, "" without."""
        survey = self._survey
        if survey.is_sound:
            return ""
        if not survey.is_cut_off:
            return INDEX_IS_DAMAGED
        if not survey.index_at:
            return cut_off(chunks, topics)
        percent = round(100 * (1 - len(survey.blob) / survey.index_at))
        share = f"about {percent} %" if percent else "less than 1 %"
        return cut_off(chunks, topics, f"{share} of the recording")

    def _topics(self) -> dict[str, TopicType]:
        """Return the topics that hold messages; store the topic of each connection."""
        topics: dict[str, TopicType] = {}
        counts = self._survey.counts()
        for number, fields in self._survey.connections.items():
            if not counts[number]:
                continue
            topic = "/" + fields[b"topic"].decode(errors="replace").strip("/")
            self._names[number] = topic
            known = topics.get(topic)
            topics[topic] = TopicType(
                msgtype=fields[b"type"].decode(errors="replace").replace("/", "/msg/"),
                encoding="ros1",
                definition=fields.get(b"message_definition", b"").decode(errors="replace"),
                definition_format="ros1msg",
                count=counts[number] + (known.count if known else 0),
            )
        return topics
