"""How fast is a new module led through what was observed? CPU time, which load does not change.

    python experiments/catch_up.py +scenario=there_and_back

Takes the command line of `python -m sceneslam`; tells every catch-up of more than a second.
"""

from __future__ import annotations

from time import perf_counter, process_time, thread_time

from sceneslam.bus.handover import Handover
from sceneslam.cli import main

_CLOCKS = {
    "CPU of the bus's thread": thread_time,
    "of all threads": process_time,
    "by the clock": perf_counter,
}
_SHORT_S = 1.0


def timed(handover: Handover, limit: int | None) -> bool:
    """Lead the module on, and print what that took."""
    before = {name: clock() for name, clock in _CLOCKS.items()}
    is_done = advance(handover, limit)
    spent_s = {name: clock() - before[name] for name, clock in _CLOCKS.items()}
    led_s = [moment.stamp_ns / 1e9 for moment in handover.trail]
    span_s = led_s[-1] - led_s[0] if len(led_s) > 1 else 0.0
    if span_s > _SHORT_S:
        rates = [f"{name} {one_s:.2f} s, {span_s / one_s:.1f} x" for name, one_s in spent_s.items()]
        print(f"{handover.runner.key}: {span_s:.2f} s;", "; ".join(rates))
    return is_done


if __name__ == "__main__":
    advance = Handover.advance
    Handover.advance = timed  # type: ignore[method-assign]
    main()
