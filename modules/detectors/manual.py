"""Scenes from a schedule or an operator's keyboard, as in the paper's manual mode."""

from __future__ import annotations

import logging
import sys
import threading
from bisect import bisect_right
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor

_log = logging.getLogger(__name__)
_SCHEDULE = "a list of [seconds, scene] by rising seconds, the first at 0"


class Manual:
    """Votes for the scene of the schedule, or the last one typed by the operator.

    `schedule` holds [seconds since the first observation, scene]. With `operator` a line typed on
    standard input replaces the schedule from then on, if it is a scene of the schedule or of
    `scenes`.
    """

    quantity = ""
    requires = (frozenset[Sensor](),)
    feature_settings: tuple[str, ...] = ()

    def __init__(
        self, schedule: list[list[float | str]], operator: bool, scenes: list[str] | None
    ) -> None:
        is_pair = [len(entry) == 2 and isinstance(entry[1], str) for entry in schedule]
        if not is_pair or not all(is_pair):
            raise ConfigError("schedule", schedule, _SCHEDULE)
        try:
            self._starts_s = [float(entry[0]) for entry in schedule]
        except ValueError:
            raise ConfigError("schedule", schedule, _SCHEDULE) from None
        if self._starts_s[0] != 0 or sorted(set(self._starts_s)) != self._starts_s:
            raise ConfigError("schedule", schedule, _SCHEDULE)
        self._names = [str(entry[1]) for entry in schedule]
        self._operator = operator
        self.scenes = tuple(dict.fromkeys([*self._names, *(scenes or [])]))
        self._typed: str | None = None
        self._first_ns: int | None = None

    def activate(self, rig: Rig) -> None:
        """Start the schedule at the next observation; hear what is typed from now on."""
        self._first_ns, self._typed = None, None
        if self._operator:
            _keyboard.pass_to(self._hear)

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the scene at the observation's stamp."""
        return self.decide(observation.stamp_ns, None)

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return None: there are no features."""

    def decide(self, stamp_ns: int, features: NDArray[np.float64] | None) -> SceneVote:
        """Return the scene at the stamp."""
        if self._first_ns is None:
            self._first_ns = stamp_ns
        elapsed_s = (stamp_ns - self._first_ns) / 1e9
        index = max(bisect_right(self._starts_s, elapsed_s) - 1, 0)
        scene = self._typed or self._names[index]
        return SceneVote(stamp_ns=stamp_ns, scene=scene)

    def shutdown(self) -> None:
        """Hear no more."""
        _keyboard.release(self._hear)

    def _hear(self, line: str) -> None:
        if line in self.scenes:
            self._typed = line
        elif line:
            _log.warning("scene: got %r, allowed: %s", line, ", ".join(self.scenes))


class _Keyboard:
    """Standard input, of which a process has one: whoever asked last hears its lines."""

    def __init__(self) -> None:
        self._hear: Callable[[str], None] | None = None
        self._thread: threading.Thread | None = None  # waits for a line until the input ends

    def pass_to(self, hear: Callable[[str], None]) -> None:
        """Call `hear` with each line from now on, in the reading thread."""
        self._hear = hear
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._read, daemon=True, name="operator")
            self._thread.start()

    def release(self, hear: Callable[[str], None]) -> None:
        """Call `hear` no more; the thread waits on."""
        if self._hear == hear:
            self._hear = None

    def _read(self) -> None:
        for line in sys.stdin:
            hear = self._hear
            if hear is not None:
                hear(line.strip())


_keyboard = _Keyboard()
