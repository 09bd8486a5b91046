"""Files that a user names: found as typed, regular files, and read as text in any encoding."""

from __future__ import annotations

import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Collection
from pathlib import Path

from sceneslam.types.errors import InputError, text_of

_WHOLE_NUMBER = re.compile(r"(?<!\d)(?<!\d\.)\d+")  # not the decimals of a stamp, as in 1.25.png


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


def files_by_number(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Return what a folder holds with one of the suffixes (lower case), 2.png before 10.png.

    Hidden files are left out: macOS writes a `._name` beside each file on other systems' disks. A
    folder that does not exist holds nothing; raises InputError for one that cannot be read.
    """
    try:
        inside = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise InputError(f"a folder cannot be read ({text_of(error)}): {folder}") from error
    found = [path for path in inside if path.suffix.lower() in suffixes and path.name[0] != "."]
    return sorted(found, key=lambda path: _WHOLE_NUMBER.sub(_padded, path.name))


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


def _padded(number: re.Match[str]) -> str:
    return number[0].zfill(255)  # no name is longer
