"""The journal of a run: every call of the atlas, written at once, for recovery after a crash.

`journal.bin` begins with `MAGIC`; records follow, little endian: kind (1 byte), length of the body
(4), CRC-32 of kind and body (4), body. A pose is the upper three rows of its matrix, 12 float64.

| kind | body |
|---|---|
| `H` | JSON: what the results need beside the configuration (`JournalHeader`) |
| `O` | stamp [ns] of an observation; its pose is reported as it is now |
| `S` | T_map_local and T_new_told of a new session, key of its module |
| `L` | stamp, T_local_base of the session |
| `P` | stamp, T_map_base, two covariances (each a byte 1 and 21 numbers, or a byte 0), its module |
| `R` | stamp from which on poses are taken back; T_new_told of the last one left, if it is known |
| `M` | stamps and T_new_old at which the atlas corrects the poses otherwise than before |
| `F` | the same of the end: all of it, of the poses as their modules revised them |
| `C` | number of a session, a byte 1 (0: no covariances); revised stamps, poses and covariances |

A pose takes about 410 bytes, 580 with a covariance of the map. The file goes when the run's results
are written.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import TrajectoryLog
from sceneslam.types.covariance import TRIANGLE, symmetric, triangle
from sceneslam.types.errors import InputError
from sceneslam.types.files import LogFile
from sceneslam.types.rig import Wheels
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

JOURNAL = "journal.bin"
MAGIC = b"SceneSLAM journal 6\n"
_HEAD = struct.Struct("<cII")
_STAMP = struct.Struct("<q")
_POSE_BYTES = 12 * 8


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalHeader:
    """Data for the results of a run that are not in its configuration."""

    title: str
    value_label: str  # of the detector's votes
    wheels: Wheels | None  # of the odometry, None without it
    began_in: str  # base folder of relative paths


class Journal:
    """Writes the journal: `flush` passes records to the system, `sync` waits for the disk.

    If the disk is full, the run continues without the journal, and `fault` says so.
    """

    def __init__(
        self, path: Path, head: JournalHeader, make_room: Callable[[], bool] = lambda: False
    ) -> None:
        self._path = path
        self._waiting = bytearray(MAGIC)
        self._file = LogFile(path, make_room)
        self._add(b"H", json.dumps(asdict(head)).encode())

    @property
    def fault(self) -> str:
        """Return why the file is incomplete, "" if it is complete."""
        return self._file.fault

    def add_observation(self, stamp_ns: int) -> None:
        """Record that an observation was processed, and its pose reported."""
        self._add(b"O", _STAMP.pack(stamp_ns))

    def add_session(self, module: str, T_map_local: Transform, T_new_told: Transform) -> None:
        """Record that a session begins."""
        self._add(b"S", _pose(T_map_local) + _pose(T_new_told) + module.encode())

    def add_local(self, stamp_ns: int, T_local_base: Transform) -> None:
        """Record a pose of the session's trajectory, T_local_base (4, 4) [m]."""
        self._add(b"L", _STAMP.pack(stamp_ns) + _pose(T_local_base))

    def add_pose(
        self,
        stamp_ns: int,
        T_map_base: Transform,
        module: str,
        covariance: NDArray[np.float64] | None,
        map_covariance: NDArray[np.float64] | None,
    ) -> None:
        """Record a pose of the global trajectory, T_map_base (4, 4) [m]; covariances in base."""
        body = _STAMP.pack(stamp_ns) + _pose(T_map_base)
        for known in (covariance, map_covariance):
            body += b"\0" if known is None else b"\1" + triangle(known).tobytes()
        self._add(b"P", body + module.encode())

    def add_rewind(self, stamp_ns: int, T_new_told: Transform | None) -> None:
        """Record that the poses from a stamp on are removed."""
        self._add(b"R", _STAMP.pack(stamp_ns) + (b"" if T_new_told is None else _pose(T_new_told)))

    def add_correction(self, stamps_ns: NDArray[np.int64], T_new_old: NDArray[np.float64]) -> None:
        """Record the correction of poses, T_new_old (N, 4, 4) [m], at stamps (N,)."""
        self._add(b"M", _poses(stamps_ns, T_new_old))

    def add_final(self, stamps_ns: NDArray[np.int64], T_new_old: NDArray[np.float64]) -> None:
        """Record the final correction of revised poses, T_new_old (N, 4, 4) [m], at stamps (N,)."""
        self._add(b"F", _poses(stamps_ns, T_new_old))

    def add_end(self, session: int, revised: Trajectory) -> None:
        """Record the revised trajectory of a session."""
        known = revised.covariances
        body = _STAMP.pack(session) + (b"\0" if known is None else b"\1")
        body += _poses(revised.stamps_ns, revised.T_world_base)
        self._add(b"C", body if known is None else body + triangle(known).tobytes())

    def flush(self) -> None:
        """Pass all records to the operating system."""
        self._file.append(bytes(self._waiting))
        self._waiting.clear()

    def sync(self) -> None:
        """Wait until the records are on disk; may be called by another thread."""
        self._file.sync()

    def close(self) -> None:
        """Close the file. May be called twice."""
        self.flush()
        self._file.close()

    def remove(self) -> None:
        """Remove the file, when the run's results are written."""
        self.close()
        self._path.unlink(missing_ok=True)

    def _add(self, kind: bytes, body: bytes) -> None:
        if self._file.is_open:
            self._waiting += _HEAD.pack(kind, len(body), _crc(kind, body)) + body


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """The contents of a journal, except for the calls of the atlas."""

    head: JournalHeader
    observed_ns: NDArray[np.int64]
    torn_bytes: int  # bytes that are no complete record, or none that can be read


def read_journal(path: Path, log: TrajectoryLog) -> Kept:
    """Repeat the journal's calls on `log`, up to the last complete record.

    A record that cannot be read is left out. Raises InputError for a file that is not a journal.
    """
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        raise InputError(f"not a journal of this version: {path}")
    head, observed_ns, read = None, [], len(MAGIC)
    for kind, body in _records(data):
        with suppress(ValueError):
            if kind == b"H":
                given = json.loads(body)
                wheels = given.pop("wheels")
                head = JournalHeader(**given, wheels=wheels and Wheels(**wheels))
            elif kind == b"O":
                observed_ns.append(_number(body))
                log.add_observation(observed_ns[-1])
            else:
                _TELL[kind](log, body)
            read += _HEAD.size + len(body)
    if head is None:
        raise InputError(f"the journal ends within its first record: {path}")
    stamps_ns = np.array(observed_ns, np.int64)
    return Kept(head=head, observed_ns=stamps_ns, torn_bytes=len(data) - read)


def _records(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and body of every complete record."""
    at = len(MAGIC)
    while at + _HEAD.size <= len(data):
        kind, length, crc = _HEAD.unpack_from(data, at)
        body = data[at + _HEAD.size : at + _HEAD.size + length]
        if len(body) < length or _crc(kind, body) != crc:
            return
        yield kind, body
        at += _HEAD.size + length


def _tell_session(log: TrajectoryLog, body: bytes) -> None:
    module = body[2 * _POSE_BYTES :].decode()
    log.add_session(module, _transform(body), _transform(body[_POSE_BYTES:]))


def _tell_local(log: TrajectoryLog, body: bytes) -> None:
    log.add_local(_number(body), _transform(body[_STAMP.size :]))


def _tell_pose(log: TrajectoryLog, body: bytes) -> None:
    covariance, rest = _covariance(body[_STAMP.size + _POSE_BYTES :])
    map_covariance, module = _covariance(rest)
    T_map_base = _transform(body[_STAMP.size :])
    log.add_pose(_number(body), T_map_base, module.decode(), covariance, map_covariance)


def _covariance(body: bytes) -> tuple[NDArray[np.float64] | None, bytes]:
    """Return a covariance (6, 6) at the beginning, None without one, and what follows it."""
    if not body[0]:
        return None, body[1:]
    end = 1 + 8 * TRIANGLE
    return symmetric(np.frombuffer(body[1:end])), body[end:]


def _tell_rewind(log: TrajectoryLog, body: bytes) -> None:
    T_new_told = body[_STAMP.size :]
    log.add_rewind(_number(body), _transform(T_new_told) if T_new_told else None)


def _tell_correction(log: TrajectoryLog, body: bytes) -> None:
    correction = _trajectory(body)
    log.add_correction(correction.stamps_ns, correction.T_world_base)


def _tell_final(log: TrajectoryLog, body: bytes) -> None:
    final = _trajectory(body)
    log.add_final(final.stamps_ns, final.T_world_base)


def _tell_end(log: TrajectoryLog, body: bytes) -> None:
    has_covariances, rest = body[_STAMP.size], body[_STAMP.size + 1 :]
    if not has_covariances:
        log.add_end(_number(body), _trajectory(rest))
        return
    each = _STAMP.size + _POSE_BYTES
    end = len(rest) // (each + 8 * TRIANGLE) * each  # of the poses
    covariances = symmetric(np.frombuffer(rest[end:]).reshape(-1, TRIANGLE))
    log.add_end(_number(body), replace(_trajectory(rest[:end]), covariances=covariances))


_TELL = {
    b"S": _tell_session,
    b"L": _tell_local,
    b"P": _tell_pose,
    b"R": _tell_rewind,
    b"M": _tell_correction,
    b"F": _tell_final,
    b"C": _tell_end,
}


def _number(body: bytes) -> int:
    return int(_STAMP.unpack_from(body)[0])


def _crc(kind: bytes, body: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(kind))


def _pose(T_a_b: Transform) -> bytes:
    return T_a_b[:3].tobytes()


def _poses(stamps_ns: NDArray[np.int64], T_a_b: NDArray[np.float64]) -> bytes:
    return stamps_ns.tobytes() + np.ascontiguousarray(T_a_b[:, :3]).tobytes()


def _trajectory(body: bytes) -> Trajectory:
    """Return stamps and poses as `_poses` wrote them."""
    count = len(body) // (_STAMP.size + _POSE_BYTES)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = np.frombuffer(body, offset=count * _STAMP.size).reshape(-1, 3, 4)
    return Trajectory(stamps_ns=np.frombuffer(body, np.int64, count), T_world_base=poses)


def _transform(body: bytes) -> Transform:
    T_a_b = np.eye(4)
    T_a_b[:3] = np.frombuffer(body, count=12).reshape(3, 4)
    return T_a_b
