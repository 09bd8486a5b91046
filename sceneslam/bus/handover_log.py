"""Log the pose's covariance at every hand-over."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.events import EventLog
from sceneslam.types.run import SessionStart


def log_uncertainty(
    log: EventLog, starts: Iterable[SessionStart], covariances: NDArray[np.float64]
) -> None:
    """Log the standard deviations of the pose where each session begins, as known at the end.

    `covariances` (N, 6, 6) are those of the trajectory's poses, in `base`, translation first.
    """
    for start in starts:
        covariance = covariances[start.row]
        log.add(
            "uncertainty",
            start.stamp_ns,
            session=start.session,
            module=start.module,
            deviation_m=float(np.sqrt(np.trace(covariance[:3, :3]))),
            deviation_rad=float(np.sqrt(np.trace(covariance[3:, 3:]))),
            covariance=covariance.tolist(),
        )
