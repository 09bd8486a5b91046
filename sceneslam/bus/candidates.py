"""Which of a scene's modules can still be tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sceneslam.bus.runner import Runner


class Candidates:
    """The table scene -> modules, and which of the served scene's modules were tried."""

    def __init__(
        self,
        scenes: Mapping[str, Sequence[str]],
        runners: Mapping[str, Runner],
        retry_s: float,
        *,
        waits: bool,
    ) -> None:
        self.scene = ""  # the confirmed scene that the active module serves
        self.tried: frozenset[str] = frozenset()
        self.rounds = 0  # how often all were tried in vain
        self.retry_ns = 0  # when the first choice may be tried again
        self._scenes, self._runners, self._waits = scenes, runners, waits
        self._retry_ns, self._retries = round(retry_s * 1e9), 0

    def of(self, scene: str) -> tuple[str, ...]:
        """Return the modules of a scene that can run, in the table's order.

        Those that must be waited for are among them where that is allowed.
        """
        if self._waits:
            return self.returning(scene)
        return tuple(key for key in self._scenes.get(scene, ()) if self._runners[key].can_run)

    def returning(self, scene: str) -> tuple[str, ...]:
        """Return the modules of a scene that can run, at once or later."""
        return tuple(key for key in self._scenes.get(scene, ()) if self._runners[key].may_return)

    def serve(self, scene: str) -> None:
        """Start with all modules of a scene."""
        if scene != self.scene:
            self.scene, self.rounds, self._retries = scene, 0, 0

    def limit(self, keys: Sequence[str], rounds: int) -> None:
        """Leave only some of the scene's modules to be tried."""
        self.tried, self.rounds = frozenset(self._scenes[self.scene]) - frozenset(keys), rounds

    def use(self, key: str) -> None:
        """Note that a module is being tried."""
        self.tried |= {key}

    def left(self) -> list[str]:
        """Return the modules that were not tried and have not failed, in the table's order."""
        return [key for key in self.of(self.scene) if key not in self.tried]

    def postpone(self, stamp_ns: int, *, is_in_vain: bool) -> None:
        """Let the first choice be tried again after a while, longer after each vain trial."""
        self._retries = self._retries + 1 if is_in_vain else 0
        self.retry_ns = stamp_ns + (self._retry_ns << min(self._retries, _DOUBLINGS))


_DOUBLINGS = 5
