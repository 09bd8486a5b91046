"""Counts of damaged data that a source has found, by type."""

from __future__ import annotations

from collections.abc import Sequence


class FaultLog:
    """Counts faults; stores where each type occurred first."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._first: dict[str, str] = {}

    def add(self, kind: str, where: str, count: int = 1) -> None:
        """Count faults; `kind` reads like `colour image could not be decoded`."""
        self._counts[kind] = self._counts.get(kind, 0) + count
        self._first.setdefault(kind, where)

    def clear(self) -> None:
        """Delete all counts, before the source is read again."""
        self._counts.clear()
        self._first.clear()

    def sentences(self) -> Sequence[str]:
        """Return one sentence per kind."""
        return [
            f"{kind}: {count} {'time' if count == 1 else 'times, first'} at {self._first[kind]}"
            for kind, count in self._counts.items()
        ]


def at_stamp(stamp_ns: int) -> str:
    """Return "at stamp ... s"."""
    return f"stamp {stamp_ns * 1e-9:.6f} s"
