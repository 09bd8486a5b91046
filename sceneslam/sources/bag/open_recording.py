"""Opening of recordings: ROS 1 bags, rosbag2 folders (MCAP, sqlite3), MCAP files; also split."""

from __future__ import annotations

import re
import shlex
import weakref
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.sources.bag import mcap_records, ros1_records
from sceneslam.sources.bag.mcap_file import open_mcap
from sceneslam.sources.bag.recording import Message, Recording
from sceneslam.sources.bag.ros1_file import open_bags
from sceneslam.types.errors import InputError, text_of
from sceneslam.types.input_files import check_regular, files_by_number

_FIRST_LOOK_BACK_NS = 2_000_000_000
# Of `rosbag record --split`: prefix, date and number of the part, the first two or one of them.
_PART = re.compile(r"(.*?)(?:\d{4}(?:-\d\d){5})?_(\d+)")


def open_recording(path: Path) -> Recording:
    """Return the recording at `path`; raises InputError if there is no readable one."""
    if not path.exists():
        raise InputError(f"recording not found: {path}")
    if path.is_dir():
        return _open_folder(path)
    check_regular(path, "a ROS 1 bag, rosbag2 folder or MCAP file")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise InputError(f"recording cannot be read ({text_of(error)}): {path}") from error
    if not start:
        raise InputError(f"recording: the file is empty: {path}")
    if start.startswith(ros1_records.MAGIC):
        return open_bags([path])
    if start.startswith(mcap_records.MAGIC):
        return open_mcap([path])
    if start.startswith(b"SQLite format 3"):
        raise InputError(f"recording: give the rosbag2 folder, not the .db3 file in it: {path}")
    raise InputError(f"recording: expected a ROS 1 bag, rosbag2 folder or MCAP file: {path}")


def _open_folder(path: Path) -> Recording:
    files = files_by_number(path, {".mcap"})
    metadata = path / "metadata.yaml"
    if files and not _packs_messages(metadata):
        return open_mcap(files)
    if not metadata.is_file() and files_by_number(path, {".db3"}):
        how = f"ros2 bag reindex {shlex.quote(str(path))} -s sqlite3"
        raise InputError(f"recording: its metadata.yaml is missing; write it by `{how}`: {path}")
    bags = files_by_number(path, {".bag"})
    if not metadata.is_file() and bags:
        return open_bags(_parts(bags, path))
    if not metadata.is_file():
        raise InputError(
            f"recording: the folder has neither metadata.yaml nor *.mcap nor *.bag: {path}"
        )
    return FolderRecording(path)


def _parts(bags: Sequence[Path], folder: Path) -> Sequence[Path]:
    """Return bags by the number of their part; raises InputError unless they are one split bag."""
    matches = {bag: match for bag in bags if (match := _PART.fullmatch(bag.stem))}
    numbers = {int(match[2]): bag for bag, match in matches.items()}
    is_split = (
        len(numbers) == len(bags) == max(numbers) - min(numbers) + 1
        and len({match[1] for match in matches.values()}) == 1
    )
    if len(bags) > 1 and not is_split:
        names = ", ".join(bag.name for bag in bags)
        raise InputError(
            f"recording: not parts of one bag, give one of {names}"
            f" (parts end in _0, _1 and so on): {folder}"
        )
    return [numbers[number] for number in sorted(numbers)] if is_split else bags


def _packs_messages(metadata: Path) -> bool:
    """Tell whether rosbag2 compressed each message, of which an MCAP file says nothing."""
    text = metadata.read_text(errors="replace") if metadata.is_file() else ""
    return re.search(r"^\s*compression_mode:\W*message\b", text, re.I | re.M) is not None


class FolderRecording:
    """A rosbag2 folder with sqlite3 storage (or compressed files or messages).

    It is open as long as this object lives, since a compressed file is unpacked when it is opened.
    """

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import Reader

        self._path = path
        with self._guarded():
            self._reader = Reader(path)
            self._reader.open()
        weakref.finalize(self, self._reader.close)
        self.faults: Sequence[str] = ()
        self.skipped: Sequence[str] = ()
        self.is_slow = False
        self.metadata: Mapping[str, Mapping[str, str]] = {}
        self.topics = self._read_topics()
        self._decoder = MessageDecoder(self.topics)

    def messages(self, topics: Collection[str], from_ns: int | None = None) -> Iterator[Message]:
        """Yield the messages of `topics` by log time."""
        reader = self._reader
        wanted = [entry for entry in reader.connections if entry.topic in topics]
        with self._guarded():
            for entry, log_ns, data in reader.messages(wanted, start=from_ns) if wanted else ():
                yield Message(topic=entry.topic, log_ns=log_ns, data=bytes(data))

    def last(self, topic: str) -> Message | None:
        """Return the topic's last message; searches increasing time spans before the end."""
        reader, back_ns = self._reader, _FIRST_LOOK_BACK_NS
        wanted = [entry for entry in reader.connections if entry.topic == topic]
        with self._guarded():
            while True:
                start_ns = max(reader.start_time, reader.end_time - back_ns)
                found = deque(reader.messages(wanted, start=start_ns), maxlen=1)
                if found:
                    _, log_ns, data = found[0]
                    return Message(topic=topic, log_ns=log_ns, data=bytes(data))
                if start_ns == reader.start_time:
                    return None
                back_ns *= 8

    def decode(self, message: Message) -> Any:
        """Return the decoded message, None if its bytes are invalid."""
        return self._decoder.decode(message.topic, message.data)

    def _read_topics(self) -> dict[str, TopicType]:
        topics: dict[str, TopicType] = {}
        for entry in self._reader.connections:
            if not entry.msgcount:
                continue
            known = topics.get(entry.topic)
            is_idl = entry.msgdef.format.name == "IDL"
            topics[entry.topic] = TopicType(
                msgtype=entry.msgtype,
                encoding="cdr",
                definition=entry.msgdef.data,
                definition_format="ros2idl" if is_idl else "ros2msg",
                count=entry.msgcount + (known.count if known else 0),
            )
        return topics

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Raise InputError for any exception of the storage."""
        try:
            yield
        except Exception as err:  # sqlite3, yaml, zstd and rosbags have their own exceptions
            reason = " ".join(str(err).split()) or type(err).__name__
            # rosbags makes a URI of the path, in which these characters have a meaning.
            odd = re.match(r"Cannot open database .*?([#?]|%[0-9a-fA-F]{2})", reason)
            if odd is not None:
                reason = f"rosbags opens no SQLite file with {odd[1]!r} in its path: rename it"
            raise InputError(f"recording cannot be read ({reason}): {self._path}") from err
