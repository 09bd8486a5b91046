"""Messages between two processes: whole packets on a socket, arrays in lent shared memory."""

from __future__ import annotations

import marshal
import mmap
import os
import pickle
import select
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import finalize

import numpy as np

from sceneslam.supervision.packing import packed

_PACKET_BYTES = 1 << 15  # what travels in the packet itself: a socket's buffer holds several
_PACKET_MAX_BYTES = 1 << 16
_LINE_BYTES = 64  # of a cache line: where each array begins

_Place = tuple[int, int, list[tuple[int, int]]]  # a block, its capacity, where its parts are


@dataclass(slots=True, kw_only=True, eq=False)
class _Block:
    """Shared memory that this end writes; it has no name, so that none is ever left behind."""

    memory: mmap.mmap
    fd: int | None  # until the other end has it


class Channel:
    """One end of a line of messages, each anything that can be pickled.

    Arrays are written once, to a block of shared memory, and read there in place: the block is
    lent, and used anew when nothing at the other end looks at it any more. So an array may be kept
    for as long as one likes. Arrays arrive read-only.
    """

    def __init__(self, line: socket.socket) -> None:
        self._line = line
        self._blocks: list[_Block] = []
        self._free: list[int] = []  # of the blocks
        self._borrowed: dict[int, mmap.mmap] = {}  # the other end's blocks
        self._returned: list[int] = []  # those of them that nothing here looks at any more

    def send(self, message: object, timeout_s: float | None = None) -> None:
        """Send a message; raises OSError where the other end is gone or its line is full."""
        head, arrays = packed(message)
        self._line.settimeout(timeout_s)
        if not arrays and len(head) <= _PACKET_BYTES:
            self._line.send(self._packet(head, None))
            return
        parts = [memoryview(head), *arrays]
        spans = _layout(parts)
        index = self._borrow(spans[-1][1])
        block = self._blocks[index]
        for part, (start, stop) in zip(parts, spans, strict=True):
            block.memory[start:stop] = part
        packet = self._packet(None, (index, len(block.memory), spans))
        socket.send_fds(self._line, [packet], [] if block.fd is None else [block.fd])
        self._forget_fd(block)

    def receive(self, timeout_s: float | None = None) -> Any:
        """Return the next message; raises TimeoutError, or EOFError where the other end is gone."""
        self._line.settimeout(timeout_s)
        try:
            packet, fds, _, _ = socket.recv_fds(self._line, _PACKET_MAX_BYTES, 1)
        except ConnectionError as error:
            raise EOFError from error
        if not packet:
            raise EOFError
        returned, head, place = marshal.loads(packet)
        self._free += returned
        arrays: list[Any] = []
        if place is not None:
            head, *arrays = self._look_at(place, fds)
        return pickle.loads(head, buffers=arrays)

    def has_message(self) -> bool:
        """Tell whether `receive` would return, or raise, at once."""
        waiting = select.poll()
        waiting.register(self._line, select.POLLIN)
        return bool(waiting.poll(0))

    def close(self) -> None:
        """Hang up; what was received stays readable."""
        self._line.close()
        for block in self._blocks:
            self._forget_fd(block)

    def _packet(self, head: bytes | None, place: _Place | None) -> bytes:
        """Return what goes over the socket, with the blocks that the other end has back."""
        returned, self._returned = self._returned, []
        return marshal.dumps((returned, head, place))

    def _borrow(self, size: int) -> int:
        """Return the smallest free block that holds `size` bytes, a new one where there is none."""
        fitting = [index for index in self._free if len(self._blocks[index].memory) >= size]
        if fitting:
            index = min(fitting, key=lambda index: len(self._blocks[index].memory))
            self._free.remove(index)
            return index
        fd = os.memfd_create("sceneslam")
        capacity = 1 << (size - 1).bit_length()  # so that messages of about one size share
        os.ftruncate(fd, capacity)
        self._blocks.append(_Block(memory=mmap.mmap(fd, capacity), fd=fd))
        return len(self._blocks) - 1

    def _look_at(self, place: _Place, fds: Sequence[int]) -> list[Any]:
        """Return the parts in a block of the other end, which has it back when they are gone."""
        index, capacity, spans = place
        for fd in fds:
            self._borrowed[index] = mmap.mmap(fd, capacity, prot=mmap.PROT_READ)
            os.close(fd)
        memory = np.frombuffer(self._borrowed[index], np.uint8)
        finalize(memory, self._give_back, index)
        return [memory[start:stop] for start, stop in spans]

    def _give_back(self, index: int) -> None:
        self._returned.append(index)

    def _forget_fd(self, block: _Block) -> None:
        if block.fd is not None:
            os.close(block.fd)
            block.fd = None


def _layout(parts: Sequence[memoryview]) -> list[tuple[int, int]]:
    """Return where each part begins and ends in a block."""
    spans, start = [], 0
    for part in parts:
        spans.append((start, start + part.nbytes))
        start += -(-part.nbytes // _LINE_BYTES) * _LINE_BYTES
    return spans
