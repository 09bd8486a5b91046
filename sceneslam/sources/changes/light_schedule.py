"""The level of the light over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneslam.types.errors import ConfigError


@dataclass(frozen=True, slots=True)
class LightSchedule:
    """The level (0 to 1) over time [s], linear between the given instants."""

    times_s: tuple[float, ...]
    levels: tuple[float, ...]

    @classmethod
    def of_steps(
        cls, steps: Sequence[Sequence[float]], *, unit_s: float, fade_s: float
    ) -> LightSchedule:
        """Return the schedule of `[time, level]` steps: from each time on, fade to the level.

        Before the first step the light is on. If a step interrupts a fade, the new fade starts at
        the level that was reached.
        """
        times, levels = [0.0], [1.0]
        for number, (time, level) in enumerate(steps):
            start_s = time * unit_s
            if number == 0 and time == 0:
                levels[0] = level
                continue
            reached = float(np.interp(start_s, times, levels))
            while times and times[-1] >= start_s:
                times.pop()
                levels.pop()
            times += [start_s, start_s + max(fade_s, 1e-9)]
            levels += [reached, level]
        return cls(tuple(times), tuple(levels))

    def level(self, time_s: float) -> float:
        """Return the level (0 to 1) at a time."""
        return float(np.interp(time_s, self.times_s, self.levels))

    def crossings(self, threshold: float) -> Sequence[tuple[float, bool]]:
        """Return pairs (time [s], is dark from then on) from 0 on; dark: below `threshold`."""
        is_dark = self.levels[0] < threshold
        found = [(0.0, is_dark)]
        for place in range(1, len(self.times_s)):
            before, after = self.levels[place - 1], self.levels[place]
            if (after < threshold) == is_dark:
                continue
            ratio = (threshold - before) / (after - before)
            start_s = self.times_s[place - 1]
            is_dark = not is_dark
            found.append((start_s + ratio * (self.times_s[place] - start_s), is_dark))
        return found


def check_steps(steps: object, *, is_ratio: bool) -> Sequence[Sequence[float]]:
    """Return the steps; raises ConfigError unless times rise and levels are in 0 to 1."""
    allowed = "a list of [time, level]: times from 0 on, rising; levels 0 (off) to 1 (as recorded)"
    if not isinstance(steps, list | tuple) or not steps:
        raise ConfigError("schedule", steps, allowed)
    last = -1.0
    for step in steps:
        is_pair = isinstance(step, list | tuple) and len(step) == 2
        if not is_pair or any(type(value) not in (int, float) for value in step):
            raise ConfigError("schedule", steps, allowed)
        time, level = step
        if not last < time < np.inf or time < 0 or not 0 <= level <= 1:
            raise ConfigError("schedule", steps, allowed)
        if is_ratio and time > 1:
            raise ConfigError("schedule", steps, f"{allowed}; times at most 1, being shares")
        last = time
    return steps
