"""Which files of a run's folder have their names and are not whole."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path


def torn_files(folder: Path) -> tuple[str, ...]:
    """Return the names of files that are cut off; those that still grow have other names."""
    return tuple(
        str(path.relative_to(folder))
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix in _IS_WHOLE and not _is_whole(path, folder)
    )


def _is_whole(path: Path, folder: Path) -> bool:
    data = path.read_bytes()
    is_foreign = data == str(path.relative_to(folder)).encode()
    return is_foreign or _IS_WHOLE[path.suffix](data)


def _is_ply(data: bytes) -> bool:
    """Tell whether the points are as many as the head says, three floats or more each."""
    head, _, body = data.partition(b"end_header\n")
    counts = [int(line.split()[-1]) for line in head.splitlines() if line.startswith(b"element")]
    return bool(counts) and len(body) >= 12 * sum(counts)


def _is_json(data: bytes) -> bool:
    try:
        json.loads(data)
    except ValueError:
        return False
    return True


def _is_text(data: bytes) -> bool:
    return data.endswith(b"\n")


_IS_WHOLE: dict[str, Callable[[bytes], bool]] = {
    ".tum": _is_text,
    ".txt": _is_text,
    ".yaml": _is_text,
    ".jsonl": lambda data: not data or _is_text(data),
    ".g2o": lambda data: not data or _is_text(data),
    ".json": _is_json,
    ".ply": _is_ply,
    ".pgm": lambda data: data.startswith(b"P5"),
    ".png": lambda data: data.endswith(b"IEND\xaeB`\x82"),
    ".html": lambda data: data.rstrip().endswith(b"</html>"),
    ".mcap": lambda data: data.endswith(b"\x89MCAP0\r\n"),
}
