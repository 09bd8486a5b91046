"""What the event log tells of a hand-over: its cost, and how sure the pose was."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.events import EventLog
from sceneslam.bus.handover import Handover


def log_cost(log: EventLog, handover: Handover, stamp_ns: int) -> None:
    """Log what a hand-over took; never part of what is reproducible."""
    span_s = (stamp_ns - handover.began_at.stamp_ns) / 1e9
    log.add(
        "cost",
        stamp_ns,
        module=handover.runner.key,
        handover_ms=handover.cost_ns / 1e6,
        first_pose_ms=handover.first_cost_ns / 1e6,
        catch_up_s=span_s,
    )


def log_uncertainty(log: EventLog, atlas: Atlas, covariances: NDArray[np.float64]) -> None:
    """Log, for every session, how sure the pose is where it begins, as known at the end.

    `covariances` (N, 6, 6) are those of the trajectory's poses, in `base`, translation first.
    """
    for start in atlas.session_starts():
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
