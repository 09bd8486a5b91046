"""When to change the scene and the module: settings and pure decisions."""

from __future__ import annotations

from dataclasses import dataclass, fields

from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import UNSURE, SceneVote

HANDOVERS = ("cold",)


@dataclass(slots=True, kw_only=True)
class Policy:
    """The switching policy; every duration is of the recording's clock."""

    handover: str  # how the pose passes from module to module
    confirm_window_s: float  # all images of this window must agree on a new scene
    first_confirm_window_s: float  # the same for the first scene
    lost_patience_s: float  # a lost module is bridged this long before its fallback takes over ...
    blind_patience_s: float  # ... and this long where no odometry bridges
    bridge_s: float  # without odometry, constant velocity fills gaps up to this long

    def __post_init__(self) -> None:
        if self.handover not in HANDOVERS:
            raise ConfigError("handover", self.handover, " | ".join(HANDOVERS))
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name.endswith("_s") and not 0 <= value < float("inf"):
                raise ConfigError(field.name, value, "seconds, 0 or more")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfirmedScene:
    """A scene on which all images of a window agreed."""

    stamp_ns: int  # when the window was full
    since_ns: int  # the first image of the window that says so
    scene: str
    previous: str | None


class SceneFilter:
    """Confirms a scene when all images of a window agree (paper Sec. III-A)."""

    def __init__(self, *, window_s: float, first_window_s: float) -> None:
        self._window_ns = round(window_s * 1e9)
        self._first_window_ns = round(first_window_s * 1e9)
        self._candidate: str | None = None
        self._since_ns = 0
        self._last_ns = 0
        self.scene: str | None = None

    def update(self, vote: SceneVote) -> ConfirmedScene | None:
        """Return the scene that this vote confirms, None when nothing changes.

        Observations without an image (UNSURE) are not images: they neither agree nor disagree.
        A silence longer than the window holds no evidence, so that the window starts anew.
        """
        if vote.scene == UNSURE:
            return None
        window_ns = self._first_window_ns if self.scene is None else self._window_ns
        silent = vote.stamp_ns - self._last_ns > window_ns
        if vote.scene != self._candidate or silent:
            self._candidate, self._since_ns = vote.scene, vote.stamp_ns
        self._last_ns = vote.stamp_ns
        if vote.scene == self.scene or vote.stamp_ns - self._since_ns < window_ns:
            return None
        previous, self.scene = self.scene, vote.scene
        return ConfirmedScene(
            stamp_ns=vote.stamp_ns, since_ns=self._since_ns, scene=vote.scene, previous=previous
        )
