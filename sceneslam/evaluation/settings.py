"""What counts as matched and as correct when a run is held against its ground truth."""

from __future__ import annotations

from dataclasses import dataclass, fields

from sceneslam.types.errors import ConfigError


@dataclass(slots=True, kw_only=True)
class EvaluationSettings:
    """Limits of the metrics; every one is a positive number."""

    association_gap_s: float  # a pose and its true pose are at most this far apart
    rpe_interval_s: float  # the relative pose error is taken over this time
    correct_limit_m: float  # a pose is correct within this distance of the truth ...
    correct_limit_rad: float  # ... and this angle

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 < value < float("inf"):
                raise ConfigError(field.name, value, "a finite number above 0")
