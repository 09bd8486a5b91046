"""A run told in a few lines and in plain sentences."""

import re
from dataclasses import replace

from evaluation_runs import (
    PERIOD_NS,
    SETTINGS,
    START_NS,
    happened,
    loop,
    switch_events,
    switched_run,
    true_loop,
)

from sceneslam.evaluation.metrics import evaluate
from sceneslam.evaluation.report.story import tell
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.types.run import Event, RunResult


def with_events(*events: Event, dropped: int = 0) -> RunResult:
    run = switched_run()
    return replace(run, events=[*run.events, *events], dropped=dropped)


def fault(what: str) -> Event:
    return happened("fault", START_NS, what=what)


def summary_of(run: RunResult) -> list[str]:
    return summary_lines(evaluate(run, true_loop(), settings=SETTINGS, reference=loop(200)))


def test_summary_has_at_most_nine_short_lines():
    again = [
        event
        for k in range(110, 190, 5)
        for event in switch_events(START_NS + k * PERIOD_NS, START_NS)
    ]
    lines = summary_of(with_events(*again))
    assert 5 <= len(lines) <= 9
    assert all(len(line) <= 120 for line in lines)
    assert "10.0 s: rgbd -> laser (scene: Dark), 2.00 s after the change" in lines[2]
    crowded = summary_of(with_events(*again, fault("a " * 200), fault("b"), dropped=10**6))
    assert len(crowded) <= 9
    assert all(len(line) <= 120 for line in crowded)
    shown = sum(" -> " in line for line in crowded)
    assert f"and {17 - shown} more switches (see report.html)" in crowded


def test_summary_counts_faults_and_quotes_the_first_in_one_line():
    lines = summary_of(with_events(fault("laser failed:\nbad  scan"), fault("again")))
    assert "faults: 2, first: laser failed: bad scan" in lines
    assert not any("faults" in line for line in summary_of(switched_run()))


def test_long_fault_is_shortened_where_it_has_no_spaces():
    (line,) = [line for line in summary_of(with_events(fault("x" * 500))) if "faults" in line]
    assert line.startswith("faults: 1, first: xxx")
    assert len(line) == 120


def test_dropped_observations_are_told_when_there_are_some():
    run = with_events(dropped=45)
    assert summary_of(run)[0].startswith("200 observations in 19.9 s (45 dropped), 200 poses")
    told = " ".join(tell(evaluate(run, None, settings=SETTINGS)))
    assert "45 more were dropped" in told
    assert "dropped" not in " ".join(summary_of(switched_run()))
    assert "dropped" not in " ".join(tell(evaluate(switched_run(), None, settings=SETTINGS)))


def test_largest_error_has_its_unit():
    assert re.search(r"ATE 0\.\d{4} m \(max 0\.\d{3} m\)", "\n".join(summary_of(switched_run())))
