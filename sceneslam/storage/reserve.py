"""Reserved disk space for the results of a run."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from sceneslam.types.files import own

_BASE_BYTES = 1 << 20  # configuration, metrics, a small map and the report of a short run
_POSE_BYTES = 1500  # three trajectories, covariances, journal and events
_STEP_POSES = 500  # poses by which it is enlarged
_LENT_BYTES = 1 << 18  # released at once
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Reserve:
    """A file that occupies the space; it shrinks when the journal needs some."""

    def __init__(self, path: Path) -> None:
        self._path = own(path)
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._poses = 0
        self._bytes = 0
        self._is_lent = False

    def is_enough(self, poses: int) -> bool:
        """Reserve space for the results of `poses` poses; False if the disk is too full."""
        if self._is_lent:
            return False
        if poses < self._poses:
            return True
        self._poses = poses + _STEP_POSES
        return self._enlarge(_BASE_BYTES + self._poses * _POSE_BYTES)

    def lend(self) -> bool:
        """Release a part of the space; False if nothing is left."""
        if self._fd < 0 or not self._bytes:
            return False
        self._is_lent = True
        self._bytes = max(self._bytes - _LENT_BYTES, 0)
        os.ftruncate(self._fd, self._bytes)
        return True

    def release(self) -> None:
        """Release all space. May be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)
            self._path.unlink(missing_ok=True)

    def _enlarge(self, size: int) -> bool:
        try:
            os.posix_fallocate(self._fd, self._bytes, size - self._bytes)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._fd, self._bytes)
            return error.errno not in _FULL  # else the file system does not support reservation
        self._bytes = size
        return True
