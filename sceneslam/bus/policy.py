"""When and how to change the module: the settings of `conf/policy`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from sceneslam.bus.judging.gate import GateSettings
from sceneslam.bus.pace import PaceSettings
from sceneslam.bus.scene.bayes_filter import BayesFilter, BayesSettings
from sceneslam.bus.scene.scene_filter import SceneFilter, WindowFilter
from sceneslam.types.errors import ConfigError
from sceneslam.types.run import HANDOVERS


@dataclass(slots=True, kw_only=True)
class Policy:
    """The switching policy; every duration is measured on the recording's clock."""

    handover: str  # how the pose passes from module to module
    confirm_window_s: float  # all images of this window must agree on a new scene
    first_confirm_window_s: float  # the same for the first scene
    scene_filter: BayesSettings | None  # confirms scenes in place of the window; None: the window
    lost_patience_s: float  # a lost module is bridged this long before its fallback takes over
    retry_s: float  # a fallback runs this long before the scene's first choice is tried again
    buffer_s: float  # observations are remembered this long, for `rewind`
    buffer_mb: float  # up to this size; beyond it, older sensor data is thinned
    catch_up: PaceSettings  # which observations are skipped in a catch-up
    gate: GateSettings | None  # how far a module's motion may differ from odometry, None: unchecked
    startup_s: dict[str, float]  # slam key -> time its start takes on the recording's clock

    def __post_init__(self) -> None:
        if self.handover not in HANDOVERS:
            raise ConfigError("handover", self.handover, " | ".join(HANDOVERS))
        amounts = {field.name: getattr(self, field.name) for field in fields(self)}
        amounts = {key: value for key, value in amounts.items() if key.endswith(("_s", "_mb"))}
        amounts |= {f"startup_s.{key}": value for key, value in amounts.pop("startup_s").items()}
        for key, value in amounts.items():
            if not isinstance(value, int | float) or not 0 <= value < float("inf"):
                unit = "megabytes" if key == "buffer_mb" else "seconds"
                raise ConfigError(key, value, f"{unit}, 0 or more")

    def make_scene_filter(self, scenes: Sequence[str]) -> SceneFilter:
        """Return a new filter of votes for `scenes`."""
        if self.scene_filter is not None:
            return BayesFilter(scenes, self.scene_filter)
        return WindowFilter(
            window_s=self.confirm_window_s, first_window_s=self.first_confirm_window_s
        )
