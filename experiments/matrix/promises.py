"""What a matrix promises."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sceneslam.experiments.matrix.cell import Cell, mean, regret_of
from sceneslam.types.experiment import Figure

_WHOLE = 0.99  # of a drive: an error over less of it is not beside the oracle's


@dataclass(frozen=True, slots=True, kw_only=True)
class Promises:
    """Bounds of the judged strategy, and of what it is compared with; None asks for nothing."""

    judged: str
    regret_max: float  # of the judged strategy against the oracle, over all stories
    correct_min: float | None = None  # of the judged strategy; None: that of the best module alone
    alone_correct_max: float | None = None  # no module alone is correct for more of the time
    false_max: float | None = None  # false switches of the judged strategy, at any seed
    unswitched: Sequence[str] = ()  # stories in which the judged strategy changes no module

    def figures(self, cells: Sequence[Cell], alone: Sequence[str]) -> Iterator[Figure]:
        """Yield every promise with what was measured; `alone` names the modules' strategies."""
        means = mean(cells)
        for story in dict.fromkeys(cell.story for cell in cells):
            of = {cell.strategy: cell for cell in means if cell.story == story}
            yield from self._of_story(story, of[self.judged], [of[name] for name in alone])
        ours = [cell for cell in cells if cell.strategy == self.judged]
        name = f"{self.judged}: regret over all stories"
        yield Figure.at_most(name, regret_of(ours), self.regret_max)
        least = float(np.nanmin([regret_of(drives) for drives in _whole(cells)]))
        yield Figure.at_least("least regret of any strategy, any seed", least, 0.0)
        if self.false_max is not None:
            most = float(np.max([cell.false_switches for cell in ours]))
            yield Figure.at_most(f"{self.judged}: false switches, any seed", most, self.false_max)

    def _of_story(self, story: str, ours: Cell, alone: Sequence[Cell]) -> Iterator[Figure]:
        least = self.correct_min
        if least is None:
            least = max(cell.correct_rate for cell in alone)
        yield Figure.at_least(f"{story}: Correct Rate, {self.judged}", ours.correct_rate, least)
        if self.alone_correct_max is not None:
            for cell in alone:
                name = f"{story}: Correct Rate, {cell.strategy}"
                yield Figure.at_most(name, cell.correct_rate, self.alone_correct_max)
        if story in self.unswitched:
            yield Figure.at_most(f"{story}: switches", ours.switches, 0.0)


def _whole(cells: Sequence[Cell]) -> list[list[Cell]]:
    """Return, per strategy and seed, the drives of all stories, if all have poses everywhere."""
    groups: dict[tuple[str, int | None], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.strategy, cell.seed), []).append(cell)
    return [drives for drives in groups.values() if min(one.coverage for one in drives) >= _WHOLE]
