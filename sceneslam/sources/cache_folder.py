"""The folder in which recordings that are made are kept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sceneslam.types.errors import InputError, told


@contextmanager
def writable(cache: Path) -> Iterator[None]:
    """Raise InputError with what to set where a cache cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"source.cache_dir: {cache} cannot be written ({told(error)}); name another folder, as "
            "by SCENESLAM_CACHE_DIR=FOLDER before the command"
        ) from error
