"""A program that does one thing wrong at a moment that its seed chooses: `hostile.py SEED`.

It speaks the protocol with the standard library alone. `KINDS` are the wrongs, `plan` the choice.
"""

from __future__ import annotations

import os
import random
import signal
import struct
import sys
import time

HEAD, FIELD = struct.Struct("<8s16sIIQ"), struct.Struct("<32s4sI3Q")
MOMENTS = ("hello", "activate", "scene", "track", "trajectory", "map")
_ANYWHERE = """
    garbage torn torn_and_gone announces_terabytes field_too_long unknown_type four_dimensions
    hangs hangs_deaf stops drips floods_output floods_errors floods_answers exits_0 exits_3
    crashes aborts leaves_a_child closes_output closes_input gives_up hoards_memory wrong_kind
    wrong_number other_version
"""
_IN_POSES = """
    nan infinite skewed mirrored future past stranger unordered too_few bad_status
    nan_covariance no_stamps
"""
ANYWHERE, IN_POSES = tuple(_ANYWHERE.split()), tuple(_IN_POSES.split())
KINDS = (*ANYWHERE, *IN_POSES)


def plan(seed: int) -> tuple[str, str, int]:
    """Return which wrong, at which kind of request, and for `track` at the how many-th."""
    rng = random.Random(seed)
    kind = KINDS[seed % len(KINDS)]
    is_of_track = kind in (*IN_POSES, "floods_answers")  # else its first answer is right
    moment = "track" if is_of_track else rng.choice((*MOMENTS, "track", "track"))
    return kind, moment, rng.randrange(1, 8)


def field(name: str, code: str, shape: tuple[int, ...], values: bytes) -> bytes:
    """Return one array."""
    sizes = [*shape, 1, 1, 1][:3]
    head = FIELD.pack(name.encode(), code.encode(), len(shape), *sizes)
    return head + values + bytes(-len(values) % 8)


def message(kind: str, number: int, fields: list[bytes]) -> bytes:
    """Return a whole message."""
    body = b"".join(fields)
    return HEAD.pack(b"SceneSL1", kind.encode(), number, len(fields), len(body)) + body


def pose_fields(stamps: list[int], transforms: list[list[float]], more: list[bytes]) -> list[bytes]:
    """Return the reply to `track`."""
    flat = [value for transform in transforms for value in transform]
    count = len(transforms)
    return [
        field("stamps_ns", "i8", (len(stamps),), struct.pack(f"<{len(stamps)}q", *stamps)),
        field("T_local_base", "f8", (count, 4, 4), struct.pack(f"<{len(flat)}d", *flat)),
        *more,
    ]


def transform(x: float, turn: tuple[float, ...] = (1, 0, 0, 0, 1, 0, 0, 0, 1)) -> list[float]:
    """Return a 4x4 matrix, row by row."""
    r = turn
    return [*r[:3], x, *r[3:6], 0.0, *r[6:9], 0.0, 0.0, 0.0, 0.0, 1.0]


class Program:
    """Answers well until its moment comes."""

    def __init__(self, seed: int) -> None:
        self.kind, self.moment, self.at = plan(seed)
        self.rng = random.Random(seed)
        self.out = os.dup(1)
        self.tracked = 0

    def run(self) -> None:
        """Serve."""
        while True:
            head = sys.stdin.buffer.read(HEAD.size)
            if len(head) < HEAD.size:
                return
            _, raw, number, count, length = HEAD.unpack(head)
            kind = raw.rstrip(b"\0").decode()
            body = sys.stdin.buffer.read(length)
            self.answer(kind, number, stamp(body, count) if kind == "track" else 0)

    def answer(self, kind: str, number: int, stamp_ns: int) -> None:
        """Answer one request, or do the wrong."""
        self.tracked += kind == "track"
        is_now = kind == self.moment and (kind != "track" or self.tracked == self.at)
        if is_now and self.kind in ANYWHERE:
            getattr(self, self.kind)(kind, number)
        self.write(message(kind, number, self.fields(kind, stamp_ns, is_now)))

    def fields(self, kind: str, stamp_ns: int, is_now: bool) -> list[bytes]:
        """Return the fields of a reply; wrong ones where it is time."""
        if kind == "hello":
            return [field("requires", "u1", (8,), b"odometry")]
        if kind == "trajectory":
            return pose_fields([], [], [])
        if kind != "track":
            return []
        good = transform(0.1 * self.tracked)
        if not is_now or self.kind not in IN_POSES:
            return pose_fields([stamp_ns], [good], [])
        second_ns = 10**9
        wrong: dict[str, list[bytes]] = {
            "nan": pose_fields([stamp_ns], [transform(float("nan"))], []),
            "infinite": pose_fields([stamp_ns], [transform(float("inf"))], []),
            "skewed": pose_fields([stamp_ns], [transform(0, (1, 0.5, 0, 0, 1, 0, 0, 0, 1))], []),
            "mirrored": pose_fields([stamp_ns], [transform(0, (1, 0, 0, 0, 1, 0, 0, 0, -1))], []),
            "future": pose_fields([stamp_ns + 5 * second_ns], [good], []),
            "past": pose_fields([stamp_ns - 10 * second_ns], [good], []),
            "stranger": pose_fields([stamp_ns + 1], [good], []),
            "unordered": pose_fields([stamp_ns, stamp_ns], [good, good], []),
            "too_few": pose_fields([stamp_ns, stamp_ns + 1], [good], []),
            "bad_status": pose_fields(
                [stamp_ns], [good], [field("status", "i8", (1,), struct.pack("<q", 7))]
            ),
            "nan_covariance": pose_fields(
                [stamp_ns],
                [good],
                [field("covariance", "f8", (1, 6, 6), struct.pack("<36d", *[float("nan")] * 36))],
            ),
            "no_stamps": [],
        }
        return wrong[self.kind]

    def write(self, data: bytes) -> None:
        """Write all of it."""
        while data:
            data = data[os.write(self.out, data) :]

    def garbage(self, kind: str, number: int) -> None:
        """Write random bytes."""
        self.write(self.rng.randbytes(self.rng.choice((40, 100, 5000))))
        time.sleep(1000)

    def torn(self, kind: str, number: int) -> None:
        """Write half a message."""
        self.write(message(kind, number, self.fields(kind, 0, False))[:39])
        time.sleep(1000)

    def torn_and_gone(self, kind: str, number: int) -> None:
        """Write half a message, and end."""
        self.write(message(kind, number, self.fields(kind, 0, False))[:39])
        os._exit(0)

    def announces_terabytes(self, kind: str, number: int) -> None:
        """Announce more than there is."""
        self.write(HEAD.pack(b"SceneSL1", kind.encode(), number, 1, 1 << 42))
        time.sleep(1000)

    def field_too_long(self, kind: str, number: int) -> None:
        """Announce a field that is longer than its message."""
        self.write(message(kind, number, [FIELD.pack(b"a", b"f8", 3, 1 << 62, 1 << 62, 9)]))

    def unknown_type(self, kind: str, number: int) -> None:
        """Send an array of a type that the protocol has not."""
        self.write(message(kind, number, [field("a", "O8", (1,), bytes(8))]))

    def four_dimensions(self, kind: str, number: int) -> None:
        """Send an array of four dimensions."""
        self.write(message(kind, number, [field("a", "f8", (1, 1, 1, 1), bytes(8))]))

    def hangs(self, kind: str, number: int) -> None:
        """Do nothing."""
        time.sleep(1000)

    def hangs_deaf(self, kind: str, number: int) -> None:
        """Compute for ever, deaf to all signals that can be ignored."""
        for number_ in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
            signal.signal(number_, signal.SIG_IGN)
        while True:
            pass

    def stops(self, kind: str, number: int) -> None:
        """Stop as by Ctrl-Z."""
        os.kill(os.getpid(), signal.SIGSTOP)

    def drips(self, kind: str, number: int) -> None:
        """Write a byte now and then."""
        for byte in message(kind, number, [field("a", "f8", (1000,), bytes(8000))]):
            self.write(bytes([byte]))
            time.sleep(0.01)

    def floods_output(self, kind: str, number: int) -> None:
        """Write without end."""
        while True:
            self.write(bytes(1 << 16))

    def floods_errors(self, kind: str, number: int) -> None:
        """Complain without end."""
        while True:
            os.write(2, b"warning: odd\n" * 1000)

    def floods_answers(self, kind: str, number: int) -> None:
        """Answer without end."""
        data = message(kind, number, self.fields(kind, 0, False))
        while True:
            self.write(data)

    def exits_0(self, kind: str, number: int) -> None:
        """End."""
        os._exit(0)

    def exits_3(self, kind: str, number: int) -> None:
        """End, and say why."""
        os.write(2, b"fatal: no camera\n")
        os._exit(3)

    def crashes(self, kind: str, number: int) -> None:
        """Be ended for touching memory that is not its own."""
        os.kill(os.getpid(), signal.SIGSEGV)

    def aborts(self, kind: str, number: int) -> None:
        """Be ended by an assertion."""
        os.abort()

    def leaves_a_child(self, kind: str, number: int) -> None:
        """End, and leave a process in a session of its own that keeps the pipes open."""
        if os.fork() == 0:
            os.setsid()
            time.sleep(1000)
        os._exit(0)

    def closes_output(self, kind: str, number: int) -> None:
        """Hang up, and live on."""
        os.close(self.out)
        os.close(1)
        time.sleep(1000)

    def closes_input(self, kind: str, number: int) -> None:
        """Stop to listen, and live on."""
        os.close(0)
        time.sleep(1000)

    def gives_up(self, kind: str, number: int) -> None:
        """Say that it cannot."""
        self.write(message("error", number, [field("text", "u1", (7,), b"no idea")]))
        time.sleep(1000)

    def hoards_memory(self, kind: str, number: int) -> None:
        """Ask for more memory than it may have."""
        hoard = []
        while True:
            hoard.append(bytes(1 << 26))

    def wrong_kind(self, kind: str, number: int) -> None:
        """Answer something else."""
        self.write(message("weather", number, []))

    def wrong_number(self, kind: str, number: int) -> None:
        """Answer what was asked long ago."""
        self.write(message(kind, number + 7, self.fields(kind, 0, False)))

    def other_version(self, kind: str, number: int) -> None:
        """Speak the next version."""
        self.write(message(kind, number, []).replace(b"SceneSL1", b"SceneSL2"))


def stamp(body: bytes, count: int) -> int:
    """Return the stamp of an observation."""
    start = 0
    for _ in range(count):
        name, code, dimensions, *shape = FIELD.unpack_from(body, start)
        start += FIELD.size
        if name.rstrip(b"\0") == b"stamp_ns":
            return int(struct.unpack_from("<q", body, start)[0])
        size = int(code[1:2])
        for length in shape[:dimensions]:
            size *= length
        start += -(-size // 8) * 8
    raise ValueError("an observation without a stamp")


if __name__ == "__main__":
    Program(int(sys.argv[1])).run()
