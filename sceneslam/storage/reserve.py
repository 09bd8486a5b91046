"""Room on the disk that is kept for the results, whatever else fills it."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from sceneslam.types.files import own

_BASE_BYTES = 1 << 20  # configuration, metrics, a small map and the report of a short run
_POSE_BYTES = 1500  # of a trajectory three times, its covariance, the journal and the events
_STEP_POSES = 500  # for so many it is enlarged at once
_LENT_BYTES = 1 << 18  # at once
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Reserve:
    """A file that takes up the room; it shrinks as the journal needs it, and goes at the end."""

    def __init__(self, path: Path) -> None:
        self._path = own(path)
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._poses = 0
        self._bytes = 0
        self._is_lent = False

    def is_enough(self, poses: int) -> bool:
        """Keep room for the results of so many poses; False where the disk has too little."""
        if self._is_lent:
            return False
        if poses < self._poses:
            return True
        self._poses = poses + _STEP_POSES
        return self._enlarge(_BASE_BYTES + self._poses * _POSE_BYTES)

    def lend(self) -> bool:
        """Give a part of it to who asks; False where nothing is left."""
        if self._fd < 0 or not self._bytes:
            return False
        self._is_lent = True
        self._bytes = max(self._bytes - _LENT_BYTES, 0)
        os.ftruncate(self._fd, self._bytes)
        return True

    def release(self) -> None:
        """Give all of it back to the disk. May be called twice."""
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
            return error.errno not in _FULL  # else this disk, or a limit, knows no reserve
        self._bytes = size
        return True
