"""Confirms a scene when all images of a window agree."""

from __future__ import annotations

from dataclasses import dataclass

from sceneslam.types.observation import UNSURE, SceneVote


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
        self._candidate_since_ns = 0
        self._last_ns = 0
        self.scene: str | None = None
        self.since_ns = 0  # the first image that said so

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
            self._candidate, self._candidate_since_ns = vote.scene, vote.stamp_ns
        self._last_ns = vote.stamp_ns
        if vote.scene == self.scene or vote.stamp_ns - self._candidate_since_ns < window_ns:
            return None
        previous, self.scene, self.since_ns = self.scene, vote.scene, self._candidate_since_ns
        return ConfirmedScene(
            stamp_ns=vote.stamp_ns, since_ns=self.since_ns, scene=vote.scene, previous=previous
        )
