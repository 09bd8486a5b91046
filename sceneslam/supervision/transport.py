"""Messages between two processes: packets on a socket, large arrays in shared memory."""

from __future__ import annotations

import array
import marshal
import mmap
import os
import select
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from time import monotonic_ns
from typing import Any
from weakref import ref

import numpy as np
from numpy.typing import NDArray

from sceneslam.supervision.packing import put_together, take_apart

_PACKET_BYTES = 1 << 15  # largest data within a packet; a socket's buffer holds several
_PACKET_MAX_BYTES = 1 << 16
_FD_BYTES = socket.CMSG_SPACE(4)
_WRITTEN, _VOID = b"w", b"v"  # states of an announced message
_AWAKE_NS = 200_000  # several times the latency of sleep and wake-up
_LINE_BYTES = 64  # a cache line; alignment of arrays
_Place = tuple[int, int, list[tuple[int, int]]]  # block, capacity, begin and end of its parts


@dataclass(slots=True, kw_only=True, eq=False)
class _Block:
    """Anonymous shared memory that this end writes, so that no file is left behind."""

    memory: mmap.mmap
    fd: int | None  # until it was sent to the other end


class Channel:
    """One end of a bidirectional channel of messages, each any value that can be pickled.

    Arrays are copied once, to a block of shared memory, and read there in place: the block is
    reused only when nothing at the other end refers to it any more. So an array may be kept for any
    time. Received arrays are read-only.
    """

    def __init__(self, line: socket.socket, pidfd: int | None = None) -> None:
        """Use the socket `line`; `pidfd` becomes readable when the other process has ended."""
        self._line, self._pidfd = line, pidfd
        self._arrivals = select.poll()
        self._arrivals.register(line, select.POLLIN)
        if pidfd is not None:
            self._arrivals.register(pidfd, select.POLLIN)
        self._blocks: list[_Block] = []
        self._free: list[int] = []  # indices of free blocks
        self._borrowed: dict[int, mmap.mmap] = {}  # the other end's blocks
        self._looked_at: dict[int, ref[NDArray[np.uint8]]] = {}  # borrowed blocks in use here
        self._returned: list[int] = []  # borrowed blocks that are no longer in use

    def send(self, message: object) -> None:
        """Send a message; raises OSError if the other end has ended or its buffer is full.

        Messages are announced before arrays are written, so that the other end wakes up in
        parallel.
        """
        large: list[memoryview] = []
        head = marshal.dumps(take_apart(message, large))
        if not large and len(head) <= _PACKET_BYTES:
            self._line.send(self._packet(head, None), socket.MSG_DONTWAIT)
            return
        is_short = len(head) <= _PACKET_BYTES
        parts = large if is_short else [memoryview(head), *large]
        spans = _layout(parts)
        index = self._borrow(spans[-1][1])
        block = self._blocks[index]
        packet = self._packet(head if is_short else None, (index, len(block.memory), spans))
        fds = [] if block.fd is None else [_as_message(block.fd)]
        end = _VOID
        try:
            self._line.sendmsg([packet], fds, socket.MSG_DONTWAIT)
            for part, (start, stop) in zip(parts, spans, strict=True):
                block.memory[start:stop] = part
            end = _WRITTEN
        finally:
            self._line.send(end, socket.MSG_DONTWAIT)
        self._forget_fd(block)

    def receive(self, timeout_s: float | None = None) -> Any:
        """Return the next message; raises TimeoutError, or EOFError if the other end has ended.

        With a timeout, it first polls for a short time, since a reply may be near.
        """
        awake_ns = 0 if timeout_s is None else _AWAKE_NS
        while True:
            packet, extra = self._arrival(timeout_s, awake_ns)
            if packet in (_WRITTEN, _VOID):
                continue  # the message was cancelled
            returned, head, place = marshal.loads(packet)
            self._free += returned
            if place is None:
                return put_together(marshal.loads(head), [])
            parts: list[Any] = self._look_at(place, extra)
            # The message is built while the arrays are still being written.
            message = None if head is None else put_together(marshal.loads(head), parts)
            if self._arrival(timeout_s, _AWAKE_NS)[0] == _WRITTEN:
                if head is None:
                    head, *large = parts
                    return put_together(marshal.loads(head), large)
                return message

    def _arrival(self, timeout_s: float | None, awake_ns: int) -> tuple[bytes, Sequence[Any]]:
        """Return the next packet and its ancillary data; poll for `awake_ns` before sleeping."""
        asleep_ns = monotonic_ns() + awake_ns
        while True:
            try:
                packet, extra, _, _ = self._line.recvmsg(
                    _PACKET_MAX_BYTES, _FD_BYTES, socket.MSG_DONTWAIT
                )
            except BlockingIOError:
                if monotonic_ns() < asleep_ns:
                    os.sched_yield()
                else:
                    self._sleep(timeout_s)
                continue
            except ConnectionError as error:
                raise EOFError from error
            if not packet:
                raise EOFError
            return packet, extra

    def _sleep(self, timeout_s: float | None) -> None:
        """Wait for a packet."""
        arrivals = self._arrivals.poll(None if timeout_s is None else 1000.0 * timeout_s)
        if not arrivals:
            raise TimeoutError
        if all(fd == self._pidfd for fd, _ in arrivals):
            raise EOFError

    def has_message(self) -> bool:
        """Tell whether `receive` would return or raise without waiting."""
        return bool(self._arrivals.poll(0))

    def close(self) -> None:
        """Close the channel; received arrays stay readable."""
        self._line.close()
        pidfd, self._pidfd = self._pidfd, None
        if pidfd is not None:
            os.close(pidfd)
        for block in self._blocks:
            self._forget_fd(block)

    def _packet(self, head: bytes | None, place: _Place | None) -> bytes:
        """Return the bytes of a packet, with the blocks that are returned to the other end."""
        returned, self._returned = self._returned, []
        return marshal.dumps((returned, head, place))

    def _borrow(self, size: int) -> int:
        """Return the smallest free block of at least `size` bytes, or a new one."""
        fitting = [index for index in self._free if len(self._blocks[index].memory) >= size]
        if fitting:
            index = min(fitting, key=lambda index: len(self._blocks[index].memory))
            self._free.remove(index)
            return index
        fd = os.memfd_create("sceneslam")
        capacity = 1 << (size - 1).bit_length()  # messages of similar size share blocks
        os.ftruncate(fd, capacity)
        self._blocks.append(_Block(memory=mmap.mmap(fd, capacity), fd=fd))
        return len(self._blocks) - 1

    def _look_at(self, place: _Place, extra: Sequence[Any]) -> list[NDArray[np.uint8]]:
        """Return the arrays in a block of the other end; it is returned when they are deleted."""
        index, capacity, spans = place
        if extra:
            fd = int.from_bytes(extra[0][2], "little")
            self._borrowed[index] = mmap.mmap(fd, capacity, prot=mmap.PROT_READ)
            os.close(fd)
        memory = np.frombuffer(self._borrowed[index], np.uint8)
        returned = self._give_back
        self._looked_at[index] = ref(memory, lambda _: returned(index))
        return [memory[start:stop] for start, stop in spans]

    def _give_back(self, index: int) -> None:
        self._returned.append(index)

    def _forget_fd(self, block: _Block) -> None:
        if block.fd is not None:
            os.close(block.fd)
            block.fd = None


def _as_message(fd: int) -> tuple[int, int, array.array[int]]:
    return (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [fd]))


def _layout(parts: Sequence[memoryview]) -> list[tuple[int, int]]:
    """Return begin and end of each part in a block [bytes]."""
    spans, start = [], 0
    for part in parts:
        spans.append((start, start + part.nbytes))
        start += -(-part.nbytes // _LINE_BYTES) * _LINE_BYTES
    return spans
