"""How often a module that failed may be started again: pure arithmetic on the clock's readings."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from isolation import limits

from sceneslam.supervision.limits import Restarts


def restarts(**changes):
    values = {"restarts_max": 3, "restart_window_s": 60.0, "restart_backoff_s": 0.2}
    return Restarts(limits(**(values | changes)))


def test_the_first_restart_is_at_once_and_each_further_one_waits_twice_as_long():
    budget, waits_s = restarts(), []
    for _ in range(3):
        budget.note_failure(100.0)
        waits_s.append(budget.wait_s(100.0))
    assert waits_s == pytest.approx([0.0, 0.2, 0.4])


def test_no_wait_is_longer_than_the_pace_that_the_window_allows():
    budget = restarts(restarts_max=1000)
    for _ in range(100):
        budget.note_failure(100.0)
    assert budget.wait_s(100.0) == pytest.approx(0.06)


def test_a_spent_budget_waits_until_the_window_has_moved_on():
    budget = restarts()
    for now_s in (100.0, 101.0, 102.0, 103.0):
        budget.note_failure(now_s)
    assert budget.is_spent(103.0) and budget.wait_s(103.0) == pytest.approx(57.0)
    assert not budget.is_spent(160.5)


def test_without_restarts_one_failure_spends_the_budget():
    budget = restarts(restarts_max=0)
    assert not budget.is_spent(0.0)
    budget.note_failure(1.0)
    assert budget.is_spent(1.0) and budget.wait_s(1.0) == pytest.approx(60.0)


@given(st.lists(st.floats(0.0, 30.0), max_size=20), st.integers(0, 5))
def test_never_more_failures_in_a_window_than_restarts_and_one(gaps_s, restarts_max):
    budget, now_s, starts_s = restarts(restarts_max=restarts_max), 0.0, [0.0]
    for gap_s in gaps_s:
        now_s += gap_s
        if budget.wait_s(now_s) == 0.0 and not budget.is_spent(now_s):
            budget.note_failure(now_s)
            starts_s.append(now_s)
    for start_s in starts_s[1:]:
        assert sum(start_s <= other_s < start_s + 60.0 for other_s in starts_s[1:]) <= (
            restarts_max + 1
        )
