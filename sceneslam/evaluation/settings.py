"""Limits for matched and correct poses in the comparison with ground truth."""

from __future__ import annotations

from dataclasses import dataclass, fields

from sceneslam.evaluation.correctness import CorrectLimits
from sceneslam.types.errors import ConfigError


@dataclass(slots=True, kw_only=True)
class EvaluationSettings:
    """Limits of the metrics, finite numbers, all but `_ratio` above 0; and names of scenes."""

    association_gap_s: float  # a pose and its true pose are at most this far apart
    rpe_interval_s: float  # the relative pose error is taken over this time
    segment_m: float  # the segment error is taken over this distance along the true path
    correct_limit_m: float  # a pose is correct within this distance of the truth ...
    correct_limit_ratio: float  # ... plus this share of the distance driven so far ...
    correct_limit_rad: float  # ... and within this angle
    coverage_min_ratio: float  # of the observations get a pose; with less a run is incomplete
    drawn_threshold: float | None  # of the detector's values, a line in their figure
    scenes: dict[str, str]  # a detector's name of a scene -> the name that the truth has for it

    def __post_init__(self) -> None:
        for scene, name in self.scenes.items():
            if not isinstance(name, str) or not name:
                raise ConfigError(f"scenes.{scene}", name, "the name of a true scene")
        for field in fields(self):
            if field.name in ("scenes", "drawn_threshold"):
                continue
            value = getattr(self, field.name)
            is_ratio = field.name.endswith("_ratio")
            if not (value > 0 or (is_ratio and value == 0)) or value == float("inf"):
                allowed = "0 or a finite number above" if is_ratio else "a finite number above 0"
                raise ConfigError(field.name, value, allowed)
        if self.coverage_min_ratio > 1:
            raise ConfigError("coverage_min_ratio", self.coverage_min_ratio, "0 to 1")

    @property
    def limits(self) -> CorrectLimits:
        """Return the error within which a pose is correct."""
        return CorrectLimits(
            limit_m=self.correct_limit_m,
            limit_rad=self.correct_limit_rad,
            limit_ratio=self.correct_limit_ratio,
        )
