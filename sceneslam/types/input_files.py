"""Files that a user names: found as typed, regular files, and read as text in any encoding."""

from __future__ import annotations

from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from pathlib import Path

from sceneslam.types.errors import InputError, text_of


def given_path(path: str) -> Path:
    """Return a path as its user means it: `~` is a home folder; raises InputError for none."""
    if not path.strip():
        raise InputError("a path is empty, expected that of a file or folder")
    try:
        return Path(path).expanduser()
    except RuntimeError:  # nobody of that name
        return Path(path)


def given_file(path: str, expected: str) -> Path:
    """Return the path of a file; raises InputError where it is missing or no regular file.

    Opening a pipe waits for its writer, and a device never ends.
    """
    file = given_path(path)
    if not file.exists():
        raise InputError(f"recording not found, expected {expected}: {path}")
    check_regular(file, expected)
    return file


def given_folder(path: str, expected: str = "a folder") -> Path:
    """Return the path of a folder; raises InputError where it does not exist."""
    folder = given_path(path)
    if not folder.is_dir():
        got = ", got a file" if folder.exists() else ""
        raise InputError(f"recording not found, expected {expected}{got}: {path}")
    return folder


def check_regular(file: Path, expected: str) -> None:
    """Raise InputError for what exists and is no regular file."""
    if not file.is_file():
        kind = "a folder" if file.is_dir() else "a pipe or a device"
        raise InputError(f"expected {expected}, got {kind}: {file}")


def read_text(file: Path) -> str:
    """Return a text file's content by its byte order mark; raises InputError if unreadable.

    Bytes that are no UTF-8 are replaced: comments may be in any encoding, numbers are ASCII.
    """
    try:
        check_regular(file, "a text file")
        data = file.read_bytes()
        encoding = "utf-16" if data[:2] in (BOM_UTF16_LE, BOM_UTF16_BE) else "utf-8-sig"
        return data.decode(encoding, errors="replace")
    except OSError as error:
        raise InputError(f"a file cannot be read ({text_of(error)}): {file}") from error
