"""Damage that a source met, counted by kind."""

from __future__ import annotations

from collections.abc import Sequence


class FaultLog:
    """Counts faults; remembers where each kind came first."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._first: dict[str, str] = {}

    def add(self, kind: str, where: str, count: int = 1) -> None:
        """Count faults; `kind` reads like `colour image could not be decoded`."""
        self._counts[kind] = self._counts.get(kind, 0) + count
        self._first.setdefault(kind, where)

    def clear(self) -> None:
        """Forget everything, for a new reading."""
        self._counts.clear()
        self._first.clear()

    def sentences(self) -> Sequence[str]:
        """Return one sentence per kind."""
        return [
            f"{kind}: {count} {'time' if count == 1 else 'times, first'} at {self._first[kind]}"
            for kind, count in self._counts.items()
        ]


def at_stamp(stamp_ns: int) -> str:
    """Return the words for a place in time."""
    return f"stamp {stamp_ns * 1e-9:.6f} s"
