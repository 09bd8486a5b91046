"""Modules in processes of their own, and modules that harm the process they live in."""

import logging
import os
import signal
import time
from contextlib import contextmanager
from functools import partial

import numpy as np
from fakes import ExactModule

from sceneslam.supervision.isolated import IsolatedModule
from sceneslam.supervision.limits import Limits


def limits(**changes):
    values = {
        "step_deadline_s": 20.0,
        "start_deadline_s": 60.0,
        "memory_limit_mb": 2000,
        "restarts_max": 3,
        "restart_window_s": 60.0,
        "restart_backoff_s": 0.01,
        "threads": 1,
    }
    return Limits(**(values | changes))


@contextmanager
def isolating():
    """Give a function that puts what `make` builds into a process, and end the processes."""
    modules = []

    def isolated(make, **changes):
        modules.append(IsolatedModule("slam.test", make, limits(**changes)))
        return modules[-1]

    yield isolated
    for module in modules:
        module.close()


class Harmful(ExactModule):
    """Does one thing at one index that a process may not survive."""

    def __init__(self, how, at=3):
        super().__init__()
        self._how, self._at = how, at

    def track(self, observation):
        tracking = super().track(observation)
        if observation.stamp_ns == self._at * 10**8:
            return getattr(self, self._how)()
        return tracking

    def hang(self):
        time.sleep(1000)

    def hang_in_native_code(self):
        int("9" * 4300) ** 10**6  # holds the interpreter's lock

    def be_killed(self):
        os.kill(os.getpid(), signal.SIGKILL)

    def crash(self):
        os.kill(os.getpid(), signal.SIGSEGV)

    def leave(self):
        raise SystemExit(3)

    def really_leave(self):
        os._exit(3)

    def flood_memory(self):
        self.hoard = [np.ones(1 << 24) for _ in range(1000)]

    def raise_what_cannot_travel(self):
        raise OddError("left", "right")

    def answer_what_cannot_travel(self):
        return lambda: None

    def complain(self):
        logging.getLogger("modules.harmful").warning("the lens is dirty")


class OddError(Exception):
    """Its constructor asks for more than it passes on."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


class Hoarder(ExactModule):
    """Keeps every image it sees, as a module keeps keyframes."""

    def activate(self, rig):
        super().activate(rig)
        self.images = []

    def track(self, observation):
        self.images.append(observation.image_bgr)
        return super().track(observation)

    def get_trajectory(self):
        """Return what it kept: the grey of every image."""
        return np.array([image.mean() for image in self.images])


def harmful(how, **options):
    return partial(Harmful, how, **options)


class InterruptsItsParent(ExactModule):
    """Lets Ctrl-C be pressed while its answer is awaited; the map is still there afterwards."""

    def __init__(self, at):
        super().__init__()
        self._at = at

    def track(self, observation):
        if observation.stamp_ns == self._at * 10**8:
            os.kill(os.getppid(), signal.SIGINT)
            time.sleep(0.1)
        return super().track(observation)
