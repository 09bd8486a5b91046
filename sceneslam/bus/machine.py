"""The state machine of the paper: init, start, run, switch, terminate (Fig. 3)."""

from __future__ import annotations

from typing import Protocol

from statemachine import State, StateMachine


class Guards(Protocol):
    """What the machine asks its owner before it takes a failure's way out."""

    def candidate_left(self) -> bool:
        """Tell whether another module could still be started."""
        ...

    def fallback_active(self) -> bool:
        """Tell whether a fallback runs in place of the module that could not."""
        ...


class BusMachine(StateMachine):
    """Success and failure lead from state to state; `stop` ends the run from anywhere.

    | state     | success          | failure                                             |
    |-----------|------------------|-----------------------------------------------------|
    | init      | start            | terminate                                           |
    | start     | run              | start with the next candidate; run without while one |
    |           |                  | may come back, terminate if none                    |
    | run       | run              | switch: the scene changed or the module is unhealthy |
    | switch    | run              | run with the fallback, terminate if none            |
    """

    init = State(initial=True)
    start = State()
    run = State()
    switch = State()
    terminate = State(final=True)

    success = init.to(start) | start.to(run) | run.to(run, internal=True) | switch.to(run)
    failure = (
        init.to(terminate)
        | start.to(start, cond="candidate_left")
        | start.to(run, cond="fallback_active")
        | start.to(terminate)
        | run.to(switch)
        | switch.to(run, cond="fallback_active")
        | switch.to(terminate)
    )
    stop = terminate.from_(init, start, run, switch)

    def __init__(self, guards: Guards) -> None:
        super().__init__(listeners=[guards])

    @property
    def state(self) -> str:
        """Return the name of the state the machine is in."""
        return str(next(iter(self.configuration)).id)
