"""Confirm a scene by the votes so far: the filter's interface, and the paper's window."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from sceneslam.types.observation import UNSURE, SceneVote

_USUAL = 3  # the least of so many intervals between votes is the usual one


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfirmedScene:
    """A scene that the votes so far confirm."""

    stamp_ns: int  # of the vote that confirmed it
    scene: str
    previous: str | None
    since_ns: int  # of the first vote that supports it


class SceneFilter(Protocol):
    """Turns votes, given by rising stamp, into confirmed scenes."""

    @property
    def posterior(self) -> Mapping[str, float] | None:
        """Return the probability of every scene after the last vote, None if unknown."""
        ...

    def update(self, vote: SceneVote) -> ConfirmedScene | None:
        """Return the scene that this vote confirms, None when nothing changes.

        An UNSURE vote counts neither for a scene nor against it.
        """
        ...


class WindowFilter:
    """Confirms a scene when all images of a window agree (paper Sec. III-B)."""

    posterior = None

    def __init__(self, *, window_s: float, first_window_s: float) -> None:
        self._window_ns = round(window_s * 1e9)
        self._first_window_ns = round(first_window_s * 1e9)
        self._candidate: str | None = None
        self._candidate_since_ns = 0
        self._last_ns = 0
        self._intervals_ns: deque[int] = deque(maxlen=_USUAL)  # of the last votes
        self._scene: str | None = None  # confirmed last, None before the first

    def update(self, vote: SceneVote) -> ConfirmedScene | None:
        """Return the scene that this vote confirms, None when nothing changes.

        After an unusual gap between votes, longer than the window, the window restarts.
        """
        if vote.scene == UNSURE:
            return None
        window_ns = self._first_window_ns if self._scene is None else self._window_ns
        interval_ns = vote.stamp_ns - self._last_ns
        usual_ns = min(self._intervals_ns) if len(self._intervals_ns) == _USUAL else 0
        silent = interval_ns > max(window_ns, 2 * usual_ns)
        self._intervals_ns.append(interval_ns)
        if vote.scene != self._candidate or silent:
            self._candidate, self._candidate_since_ns = vote.scene, vote.stamp_ns
        self._last_ns = vote.stamp_ns
        if vote.scene == self._scene or vote.stamp_ns - self._candidate_since_ns < window_ns:
            return None
        previous, self._scene = self._scene, vote.scene
        return ConfirmedScene(
            stamp_ns=vote.stamp_ns,
            since_ns=self._candidate_since_ns,
            scene=vote.scene,
            previous=previous,
        )
