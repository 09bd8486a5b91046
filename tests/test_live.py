"""Live mode: paced, newest observation first, every loss counted."""

import threading
from time import monotonic

import numpy as np
import pytest

from sceneslam.bus.live import Mailbox, run_live
from sceneslam.types.observation import Observation


def observations(count, period_ns):
    for index in range(count):
        yield Observation(stamp_ns=index * period_ns)


def test_observations_come_at_the_pace_of_their_stamps():
    began_s = monotonic()
    taken = []
    dropped = run_live(observations(6, 20_000_000), lambda o: taken.append(o.stamp_ns) or True)
    assert monotonic() - began_s >= 0.1
    assert len(taken) + dropped == 6


def test_slow_step_gets_the_newest_and_the_rest_are_counted():
    gate, taken = threading.Event(), []

    def slow_step(observation):
        taken.append(observation.stamp_ns)
        gate.wait(5.0)
        return True

    def feed():
        yield from observations(50, 1)
        gate.set()

    dropped = run_live(feed(), slow_step)
    assert taken[-1] == 49 and len(taken) + dropped == 50 and dropped > 0


def test_step_runs_in_its_own_thread_and_its_error_is_raised():
    def step(observation):
        raise ValueError(threading.current_thread().name)

    with pytest.raises(ValueError, match="bus"):
        run_live(observations(5, 1), step)


def test_step_can_end_the_run():
    taken = []

    def step(observation):
        taken.append(observation.stamp_ns)
        return False

    run_live(observations(1000, 1_000_000), step)
    assert len(taken) == 1


def test_gyro_of_a_dropped_observation_is_kept():
    mailbox = Mailbox()
    sample = np.array([[-0.01, 0.0, 0.0, 1.0]])
    mailbox.put(Observation(stamp_ns=0, gyro_base=sample))
    mailbox.put(Observation(stamp_ns=100_000_000, gyro_base=sample))
    merged = mailbox.take().gyro_base
    np.testing.assert_allclose(merged[:, 0], [-0.11, -0.01])
    assert mailbox.dropped == 1
