"""A trajectory: stamped poses, and its TUM text file."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.files import replacing
from sceneslam.types.input_files import read_text

STAMP_MAX_NS = 2**62  # 146 years: differences of two stamps fit into 64 bits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses of `base` in one frame, by rising stamp."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T_world_base: NDArray[np.float64]  # (N, 4, 4)
    # (N, 6, 6) in base, as `Tracking` has them; None, or NaN in a row: as reported before.
    covariances: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """Return the positions (N, 3) [m]."""
        return self.T_world_base[:, :3, 3]

    @classmethod
    def empty(cls) -> Trajectory:
        """Return a trajectory without poses."""
        return cls(stamps_ns=np.zeros(0, np.int64), T_world_base=np.zeros((0, 4, 4)))

    @classmethod
    def read_tum(cls, path: Path) -> Trajectory:
        """Return the poses of a TUM file: `stamp_s tx ty tz qx qy qz qw`, `#` for comments.

        Poses are sorted by stamp; stamps keep their nanoseconds.
        Raises InputError when the file is missing or a line is not eight finite numbers, the last
        four a quaternion.
        """
        if not path.is_file():
            raise InputError(f"trajectory file not found: {path}")
        stamps_ns, rows = [], []
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            words = line.replace(",", " ").split()
            if not words or words[0].startswith("#"):
                continue
            try:
                stamps_ns.append(parse_stamp_ns(words[0]))
                rows.append([float(word) for word in words[1:]])
            except ValueError:
                rows.append([])
            if not _is_pose(rows[-1]):
                raise InputError(
                    f"line {number}: expected `stamp tx ty tz qx qy qz qw`, "
                    f"got {line.strip()[:60]!r}: {path}"
                )
        if not rows:
            return cls.empty()
        values = np.array(rows)
        order = np.argsort(np.array(stamps_ns), kind="stable")
        T_world_base = se3.from_quat_xyzw(values[:, :3], values[:, 3:])
        return cls(stamps_ns=np.array(stamps_ns)[order], T_world_base=T_world_base[order])

    def stamped(self, stamps_ns: NDArray[np.int64]) -> Trajectory:
        """Return the same poses with other stamps (N,), sorted by them."""
        order = np.argsort(stamps_ns, kind="stable")
        return Trajectory(stamps_ns=stamps_ns[order], T_world_base=self.T_world_base[order])

    def write_tum(self, path: Path) -> None:
        """Write the poses as a TUM file (stamps with nine decimals)."""
        quats_xyzw = se3.to_quat_xyzw(self.T_world_base) if len(self) else np.zeros((0, 4))
        with replacing(path) as file:
            file.write("# stamp_s tx ty tz qx qy qz qw\n")
            for stamp_ns, position, quat in zip(
                self.stamps_ns.tolist(), self.positions_m, quats_xyzw, strict=True
            ):
                numbers = " ".join(f"{value:.9f}" for value in (*position, *quat))
                file.write(f"{stamp_text(stamp_ns)} {numbers}\n")


def parse_stamp_ns(text: str) -> int:
    """Return a decimal number of seconds as whole nanoseconds, without a float's rounding.

    Raises ValueError for other text, and beyond `STAMP_MAX_NS`: nanoseconds are no seconds.
    """
    try:
        stamp_ns = Decimal(text).scaleb(9)
        if abs(stamp_ns) <= STAMP_MAX_NS:
            return int(stamp_ns)
    except ArithmeticError:  # of Decimal: no number, NaN, or an exponent without end
        pass
    raise ValueError(f"expected seconds, got {text[:40]!r}")


def stamp_text(stamp_ns: int) -> str:
    """Return a stamp [ns] as seconds with nine decimals, which `parse_stamp_ns` reads."""
    seconds, rest_ns = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest_ns:09d}"


def _is_pose(numbers: list[float]) -> bool:
    """Tell whether these are x y z qx qy qz qw, the quaternion of about length 1."""
    is_complete = len(numbers) == 7 and bool(np.isfinite(numbers).all())
    return is_complete and 0.5 < float(np.linalg.norm(numbers[3:])) < 2.0
