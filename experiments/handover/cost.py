"""The experiment `switch_cost`: how long the robot waits while its module is changed.

`conf/experiment/switch_cost.yaml` says how it is called, `experiments/handover.md` what was found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict

_KINDS = ("warm", "rewind")
_SHORT_S = 0.5  # of the recording: so few images say nothing of the rate


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """What one change of module took, by the wall clock."""

    story: str
    kind: str
    to: str
    reason: str
    first_pose_ms: float
    handover_ms: float  # until the new module has caught up
    catch_up_s: float  # of the recording, that it was led through

    @property
    def rate(self) -> float:
        """Return seconds of the recording per second; NaN where there was nothing to catch up."""
        is_long = self.catch_up_s >= _SHORT_S
        return 1e3 * self.catch_up_s / self.handover_ms if is_long else float("nan")


class SwitchCostExperiment:
    """Runs stories with `warm` and with `rewind`, and times every change of module."""

    def __init__(
        self, *, stories: Sequence[str], first_pose_max_ms: float, catch_up_min: float
    ) -> None:
        if not stories:
            raise ConfigError("stories", list(stories), "one or more")
        for name, value in (
            ("first_pose_max_ms", first_pose_max_ms),
            ("catch_up_min", catch_up_min),
        ):
            if not 0 < value < float("inf"):
                raise ConfigError(name, value, "a number above 0")
        self._stories = stories
        self._first_pose_max_ms, self._catch_up_min = first_pose_max_ms, catch_up_min

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return the cost of every switch."""
        cells = [(story, kind) for story in self._stories for kind in _KINDS]
        trials = [
            Trial(
                name=f"{story}/{kind}",
                overrides=(f"story={story}",),
                values={"policy": {"handover": kind}},
            )
            for story, kind in cells
        ]
        outcomes = run_trials(trials)
        costs = [
            cost
            for cell, outcome in zip(cells, outcomes, strict=True)
            for cost in _costs(outcome, *cell)
        ]
        return Verdict(figures=list(self._figures(costs)), table=_table(costs))

    def _figures(self, costs: Sequence[Cost]) -> Iterator[Figure]:
        warm = [cost.first_pose_ms for cost in costs if cost.kind == "warm"]
        rates = [cost.rate for cost in costs if cost.kind == "rewind" and cost.rate > 0]
        first_ms = float(np.percentile(warm, 95)) if warm else float("nan")
        rate = float(np.percentile(rates, 5)) if rates else float("nan")
        name = f"warm: from the decision to the first pose, p95 of {len(warm)}"
        yield Figure.at_most(name, first_ms, self._first_pose_max_ms, "ms")
        name = f"rewind: catch-up over real time, p5 of {len(rates)}"
        yield Figure.at_least(name, rate, self._catch_up_min)


def _costs(outcome: TrialResult, story: str, kind: str) -> Iterator[Cost]:
    for switch in outcome.metrics["switches"]:
        yield Cost(
            story=story,
            kind=kind,
            to=switch["to"],
            reason=switch["reason"],
            first_pose_ms=_number(switch["first_pose_ms"]),
            handover_ms=_number(switch["cost_ms"]),
            catch_up_s=_number(switch["catch_up_s"]),
        )


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _table(costs: Sequence[Cost]) -> Table:
    columns = ("story", "hand-over", "to", "why", "first pose [ms]", "caught up [ms]", "of [s]")
    rows = [
        (c.story, c.kind, c.to, c.reason, c.first_pose_ms, c.handover_ms, c.catch_up_s)
        for c in costs
    ]
    return Table(columns=columns, rows=rows)
