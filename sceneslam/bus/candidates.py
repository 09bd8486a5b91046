"""Which of a scene's modules can still be tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sceneslam.bus.runner import Runner


class Candidates:
    """Goes through the table's modules of one scene, in order, each once."""

    def __init__(
        self, scenes: Mapping[str, Sequence[str]], runners: Mapping[str, Runner], window_s: float
    ) -> None:
        self.scene = ""  # the confirmed scene that the active module answers to
        self._scenes, self._runners = scenes, runners
        self._window_ns = round(window_s * 1e9)
        self._tried: set[str] = set()
        self._rounds = 0  # how often all were tried since one held its pose

    def begin(self, scene: str) -> None:
        """Start with all modules of a scene."""
        self.scene, self._tried, self._rounds = scene, set(), 0

    def use(self, key: str) -> None:
        """Note that a module is being tried."""
        self._tried.add(key)

    def left(self) -> list[str]:
        """Return the modules that were not tried and have not failed, in the table's order."""
        return [
            key
            for key in self._scenes[self.scene]
            if key not in self._tried and not self._runners[key].is_failed
        ]

    def reconsider(self, active: str, *, held_ns: int, lost_ns: int) -> None:
        """Give the others a new chance when the active module has earned it by its loss.

        That is when it had held its pose for a window before, or when none is left and it has
        been lost for a window, each time for twice as long, so that they do not take turns.
        """
        if held_ns >= self._window_ns:
            self._tried, self._rounds = {active}, 0
        elif not self.left() and lost_ns >= self._window_ns << self._rounds:
            self._tried, self._rounds = {active}, self._rounds + 1
