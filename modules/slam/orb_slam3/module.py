"""The `orb_slam3` SLAM module: ORB-SLAM3 in a process of its own, by the package pyorbslam3.

Campos et al., "ORB-SLAM3: An Accurate Open-Source Library for Visual, Visual-Inertial and Multi-Map
SLAM", T-RO 2021. The package is GPL-3: the user installs it, `worker.py` imports it in another
process, and both processes exchange only messages of the protocol.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

from sceneslam.supervision.limits import Limits
from sceneslam.types.errors import ConfigError

from ..process.module import ProcessSlam, python_command


class OrbSlam3(ProcessSlam):
    """ORB-SLAM3 on colour and depth; because of its threads, runs are not reproducible."""

    def __init__(
        self,
        *,
        vocabulary: Path | None,
        feature_count: int,
        fast_threshold: int,
        late_max_s: float,
        limits: Limits,
    ) -> None:
        if importlib.util.find_spec("pyorbslam3") is None:
            raise ConfigError("_target_", "OrbSlam3", "pip install 'sceneslam[orb_slam3]' (GPL-3)")
        if vocabulary is not None and not Path(vocabulary).is_file():
            allowed = "a file in DBoW2's text format; python -m sceneslam.vocabulary makes one"
            raise ConfigError("vocabulary", str(vocabulary), allowed)
        for name, value in (("feature_count", feature_count), ("fast_threshold", fast_threshold)):
            if value <= 0:
                raise ConfigError(name, value, "above 0")
        settings = {
            "vocabulary": None if vocabulary is None else str(Path(vocabulary).resolve()),
            "features": feature_count,
            "fast": fast_threshold,
        }
        command = python_command("sceneslam.modules.slam.orb_slam3.worker", settings)
        super().__init__(command=command, late_max_s=late_max_s, limits=limits, closes_loops=True)
