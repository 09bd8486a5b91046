"""Trajectories that other systems recorded: TUM files, and those of OpenLORIS-Scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text
from sceneslam.types.trajectory import Trajectory, parse_stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedTrajectory:
    """The poses of one frame in one sequence; a header that a file lacks is "" or None."""

    scene: str
    frame: str  # whose poses these are
    sequence: int | None
    trajectory: Trajectory  # T_world_frame; empty where the system failed


def read_recorded(path: Path) -> tuple[RecordedTrajectory, ...]:
    """Return the sequences of a file, in its order; one without headers is one sequence.

    Header lines are `scene:`, `frame:`, and `seq:`, which begins a sequence; other `key:` lines
    and `#` comments are passed over. A pose is `stamp_s [output stamp] x y z qx qy qz qw`. Poses
    that are no poses (not finite, no rotation) are left out, and of a repeated stamp the last one
    written counts. Raises InputError when the file is missing or a line is neither.
    """
    if not path.is_file():
        raise InputError(f"trajectory file not found: {path}")
    headers: dict[str, str] = {}
    found: list[_Rows] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        text = line.partition("#")[0].strip()
        key, colon, value = text.partition(":")
        if colon:
            headers[key.strip().lower()] = value.strip()
            if key.strip().lower() == "seq":
                found.append(_Rows(headers, f"line {number}", path))
        elif text:
            if not found:
                found.append(_Rows(headers, f"line {number}", path))
            found[-1].add(text, f"line {number}", path)
    return tuple(rows.finished() for rows in found)


class _Rows:
    """One sequence while it is read."""

    def __init__(self, headers: dict[str, str], where: str, path: Path) -> None:
        sequence = headers.get("seq")
        if sequence is not None and not sequence.isdecimal():
            raise InputError(f"{where}: expected `seq: NUMBER`, got {sequence[:60]!r}: {path}")
        self._scene, self._frame = headers.get("scene", ""), headers.get("frame", "")
        self._sequence = None if sequence is None else int(sequence)
        self._poses: dict[int, list[float]] = {}  # stamp [ns] -> x y z qx qy qz qw

    def add(self, text: str, where: str, path: Path) -> None:
        words = text.replace(",", " ").split()
        try:
            stamp_ns, values = parse_stamp_ns(words[0]), [float(word) for word in words[1:]]
        except ValueError:
            stamp_ns, values = 0, []
        if len(values) not in (7, 8):
            raise InputError(
                f"{where}: expected `stamp [stamp] x y z qx qy qz qw`, got {text[:60]!r}: {path}"
            )
        pose = values[-7:]
        if np.isfinite(pose).all() and any(pose[3:]):
            self._poses[stamp_ns] = pose

    def finished(self) -> RecordedTrajectory:
        trajectory = Trajectory.empty()
        if self._poses:
            stamps_ns = np.array(sorted(self._poses), np.int64)
            values = np.array([self._poses[stamp_ns] for stamp_ns in stamps_ns.tolist()])
            T_world_frame = se3.from_quat_xyzw(values[:, :3], values[:, 3:])
            trajectory = Trajectory(stamps_ns=stamps_ns, T_world_base=T_world_frame)
        return RecordedTrajectory(
            scene=self._scene, frame=self._frame, sequence=self._sequence, trajectory=trajectory
        )
