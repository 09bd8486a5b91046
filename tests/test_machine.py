"""The paper's state machine is the table that the design gives."""

import pytest
from statemachine.exceptions import TransitionNotAllowed

from sceneslam.bus.bus import BusMachine

SUCCESS = {"init": "start", "start": "run", "switch": "run"}
FAILURE = {  # state -> (with another candidate, without)
    "init": ("terminate", "terminate"),
    "start": ("start", "terminate"),
    "run": ("switch", "switch"),
    "switch": ("run", "terminate"),
}


class Answers:
    def __init__(self, answer):
        self.answer = answer

    def candidate_left(self):
        return self.answer

    def fallback_active(self):
        return self.answer


def machine_in(state, answer=True):
    machine = BusMachine(Answers(answer))
    path = {"init": [], "start": ["success"], "run": ["success"] * 2}
    path["switch"] = [*path["run"], "failure"]
    path["terminate"] = ["stop"]
    for event in path[state]:
        machine.send(event)
    assert machine.state == state
    return machine


@pytest.mark.parametrize("state", SUCCESS)
def test_success_leads_on(state):
    machine = machine_in(state)
    machine.send("success")
    assert machine.state == SUCCESS[state]


@pytest.mark.parametrize("answer", [True, False])
@pytest.mark.parametrize("state", FAILURE)
def test_failure_leads_to_what_is_left(state, answer):
    machine = machine_in(state, answer)
    machine.send("failure")
    assert machine.state == FAILURE[state][0 if answer else 1]


def test_success_is_no_event_of_a_state_that_goes_on():
    machine = machine_in("run")
    with pytest.raises(TransitionNotAllowed):
        machine.send("success")


@pytest.mark.parametrize("state", FAILURE)
def test_every_state_can_be_stopped(state):
    machine = machine_in(state)
    machine.send("stop")
    assert machine.state == "terminate" and machine.is_terminated


@pytest.mark.parametrize("event", ["success", "failure", "stop"])
def test_nothing_leaves_terminate(event):
    machine = machine_in("terminate")
    with pytest.raises(TransitionNotAllowed):
        machine.send(event)


def test_an_error_in_a_guard_is_raised_and_the_state_stays():
    class Broken(Answers):
        def candidate_left(self):
            raise RuntimeError("broken guard")

    machine = BusMachine(Broken(True))
    machine.send("success")
    with pytest.raises(RuntimeError, match="broken guard"):
        machine.send("failure")
    assert machine.state == "start"


def test_every_state_is_reached_and_has_an_unguarded_way_to_terminate():
    machine = BusMachine(Answers(False))
    ways = {state.id: state.transitions for state in machine.states}
    reached, left = set(), ["init"]
    while left:
        name = left.pop()
        reached.add(name)
        left += [way.target.id for way in ways[name] if way.target.id not in reached]
    assert reached == set(ways)
    for name in reached - {"terminate"}:
        assert any(way.target.id == "terminate" and not list(way.cond) for way in ways[name]), name
