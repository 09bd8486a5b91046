"""IV-A: the mean of grey from light into dark and back, and what is confirmed when (Fig. 5)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.experiments.paper.images import draw_images
from sceneslam.experiments.paper.runs import events_of, keep_figure, number
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_least

Row = tuple[str, float, float, float | None, float, float, float | None]


class DetectionExperiment:
    """Runs the detector alone; every module is dead reckoning, which costs nothing."""

    def __init__(
        self,
        *,
        window_s: float,
        late_max_s: float,
        vote_max_ms: float,
        paper_s: Sequence[float],
    ) -> None:
        check_above(0, vote_max_ms=vote_max_ms)
        check_least(0, window_s=window_s, late_max_s=late_max_s, paper_s=paper_s)
        self._paper_s = paper_s
        self._window_s, self._late_max_s, self._vote_max_ms = window_s, late_max_s, vote_max_ms

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return when every change was confirmed, how late, and what a vote costs."""
        (outcome,) = run_trials([Trial(name="detection")])
        keep_figure(outcome, "grey_mean", folder / "grey_mean.png")
        rows = self._rows(outcome)
        pictures = {"grey_mean.png": "The mean of grey, the threshold, and confirmed changes."}
        shown_ns = list(self._shown_ns(outcome))
        if shown_ns:
            caption = "The camera's image before and after each change, and where it was."
            pictures["images.png"] = caption
            draw_images(folder / "images.png", outcome.folder, shown_ns)
        columns = ("confirmed", "first image [s]", "confirmed at [s]", "after the true change [s]")
        grey = (f"grey {self._window_s:g} s before", "grey when confirmed")
        return Verdict(
            figures=list(self._figures(outcome)),
            table=Table(columns=(*columns, *grey, "the paper's second"), rows=rows),
            pictures=pictures,
        )

    def _figures(self, outcome: TrialResult) -> Iterator[Figure]:
        switches, cost_us = outcome.metrics["switches"], outcome.metrics["detector_us"]
        for switch in switches:
            delay_s = number(switch["confirm_delay_s"])
            name = f"{switch['scene']} confirmed after the true change"
            yield Figure.at_most(name, delay_s, self._window_s + self._late_max_s, "s")
        missed = number(outcome.metrics["detection"]["missed"])
        yield Figure.at_most("changes missed", missed, 0.0)
        yield Figure.at_most("false switches", number(outcome.metrics["false_switches"]), 0.0)
        for share in ("median", "p95"):
            value_ms = number(cost_us[share]) / 1e3
            yield Figure.at_most(f"detection per frame, {share}", value_ms, self._vote_max_ms, "ms")

    def _rows(self, outcome: TrialResult) -> Sequence[Row]:
        votes = list(events_of(outcome, "vote"))
        stamps_ns = np.array([vote["stamp_ns"] for vote in votes])
        values = np.array([vote["value"] for vote in votes], float)
        delays_s = {s["stamp_ns"]: s["confirm_delay_s"] for s in outcome.metrics["switches"]}

        def grey(stamp_ns: int) -> float:
            return float(values[np.searchsorted(stamps_ns, stamp_ns, side="right") - 1])

        return [
            (
                f"{event['previous']} -> {event['scene']}",
                (event["since_ns"] - int(stamps_ns[0])) / 1e9,
                (event["stamp_ns"] - int(stamps_ns[0])) / 1e9,
                delays_s.get(event["stamp_ns"]),
                grey(event["since_ns"] - round(self._window_s * 1e9)),
                grey(event["stamp_ns"]),
                paper_s,
            )
            for event, paper_s in zip_longest(_changes(outcome), self._paper_s)
            if event is not None
        ]

    def _shown_ns(self, outcome: TrialResult) -> Iterator[int]:
        """Yield, of every change, an instant before it and the one at which it was confirmed."""
        for event in _changes(outcome):
            yield event["since_ns"] - round(self._window_s * 1e9)
            yield event["stamp_ns"]


def _changes(outcome: TrialResult) -> list[Mapping[str, Any]]:
    return [event for event in events_of(outcome, "scene") if event["previous"] is not None]
