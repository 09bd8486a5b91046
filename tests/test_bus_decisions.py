"""What the bus decides on either side of each duration of the policy."""

import pytest
from driving import policy

from sceneslam.bus.decision import Action, Situation, StandbyTrial, decide
from sceneslam.bus.judging.hold import Health
from sceneslam.types.errors import ConfigError

S = 10**9
NOW_NS = 100 * S


def situation(**changes):
    """`a`, the first choice, is lost since now; `b` and `c` could take over."""
    values = {
        "stamp_ns": NOW_NS,
        "scene": "Bright",
        "served_scene": "Bright",
        "active": "a",
        "health": Health.LOST,
        "unheld_since_ns": NOW_NS,
        "held_ns": 0,
        "is_blind": False,
        "choices": ("a", "b", "c"),
        "served_choices": ("a", "b", "c"),
        "tried": frozenset("a"),
        "rounds": 0,
        "trial": StandbyTrial.NONE,
        "retry_ns": 10**18,
        "may_return": False,
    }
    return Situation(**(values | changes))


def decided(lost_ns, **changes):
    patient = policy(lost_patience_s=0.3, confirm_window_s=2.0)
    return decide(patient, situation(unheld_since_ns=NOW_NS - lost_ns, **changes))


@pytest.mark.parametrize(("is_blind", "patience_ns"), [(False, 300_000_000), (True, 30_000_000)])
def test_a_lost_module_is_replaced_when_the_patience_is_over(is_blind, patience_ns):
    assert decided(patience_ns - 1, is_blind=is_blind).action is Action.GO_ON
    verdict = decided(patience_ns, is_blind=is_blind)
    assert (verdict.action, verdict.to, verdict.reason) == (Action.SWITCH, ("b", "c"), "lost")


@pytest.mark.parametrize(("rounds", "window_s"), list(enumerate([2, 4, 8, 16, 16])))
def test_all_modules_are_tried_again_after_a_window_that_doubles_three_times(rounds, window_s):
    changes = {"tried": frozenset("abc"), "rounds": rounds}
    assert decided(window_s * S - 1, **changes).action is Action.GO_ON
    verdict = decided(window_s * S, **changes)
    assert (verdict.to, verdict.rounds) == (("b", "c"), rounds + 1)


def test_a_module_that_tracked_for_a_window_may_be_followed_by_any_other():
    changes = {"tried": frozenset("ab"), "rounds": 2}
    short, long = (decided(S, held_ns=ns, **changes) for ns in (2 * S - 1, 2 * S))
    assert (short.to, short.rounds) == (("c",), 2)
    assert (long.to, long.rounds) == (("b", "c"), 0)


def test_a_failed_module_is_replaced_at_once_by_any_other():
    assert decided(0, health=Health.FAILED).to == ("b", "c")
    last = decided(0, health=Health.FAILED, tried=frozenset("abc"), rounds=3)
    assert (last.to, last.rounds, last.reason) == (("b", "c"), 0, "failed")


def test_nothing_is_started_while_failed_modules_restart():
    gone = {"health": Health.FAILED, "active": "", "served_choices": (), "choices": ()}
    assert decided(S, may_return=True, **gone).action is Action.GO_ON
    assert decided(S, may_return=False, **gone).action is Action.SWITCH


def test_a_suspect_fallback_gives_way_to_the_first_choice_only_when_that_is_due():
    suspect = {"health": Health.SUSPECT, "active": "b", "tried": frozenset()}
    assert decided(S, retry_ns=NOW_NS + 1, **suspect).to == ("c",)
    assert decided(S, retry_ns=NOW_NS, **suspect).to == ("a", "c")


def test_the_first_choice_is_tried_again_when_it_is_due():
    fallback = {"active": "b", "health": Health.HELD}
    assert decided(0, retry_ns=NOW_NS + 1, **fallback).action is Action.GO_ON
    due = decided(0, retry_ns=NOW_NS, **fallback)
    assert (due.action, due.to) == (Action.TRY, ("a",))
    running = decided(0, retry_ns=0, trial=StandbyTrial.RUNNING, **fallback)
    assert running.action is Action.GO_ON
    assert decided(0, retry_ns=0, active="a", health=Health.HELD).action is Action.GO_ON


@pytest.mark.parametrize("health", Health)
@pytest.mark.parametrize("tried", ["", "abc"])
def test_a_first_choice_that_passed_its_trial_returns_whatever_the_fallback_does(health, tried):
    changes = {"active": "b", "health": health, "tried": frozenset(tried)}
    passed = decided(0, trial=StandbyTrial.PASSED, **changes)
    assert (passed.action, passed.to, passed.reason) == (Action.SWITCH, ("a",), "return")
    new = decided(0, trial=StandbyTrial.PASSED, scene="Dark", choices=("c",), **changes)
    assert (new.to, new.reason) == (("c",), "scene")


def test_a_new_scene_keeps_a_module_that_serves_both_unless_it_failed():
    new = {"scene": "Dark", "choices": ("a", "b")}
    assert decided(0, **new).action is Action.TELL
    assert decided(0, **new, health=Health.FAILED).to == ("a", "b")
    assert decided(0, **(new | {"choices": ("b", "a")})).to == ("b", "a")
    assert decided(0, **(new | {"choices": ()})).action is Action.GO_ON


@pytest.mark.parametrize(
    "key", ["confirm_window_s", "lost_patience_s", "retry_s", "buffer_s", "buffer_mb"]
)
def test_durations_and_sizes_may_be_zero_and_not_less(key):
    assert getattr(policy(**{key: 0.0}), key) == 0.0
    with pytest.raises(ConfigError, match=key):
        policy(**{key: -1e-9})


@pytest.mark.parametrize("value", [-0.1, float("inf"), float("nan"), "long"])
def test_a_start_up_time_is_some_seconds(value):
    assert policy(startup_s={"dark": 0.0, "bright": 8}).startup_s["bright"] == 8
    with pytest.raises(ConfigError, match=r"startup_s\.dark"):
        policy(startup_s={"dark": value})
