"""Two modules that have a process each work on the same observation at once."""

from dataclasses import replace

import numpy as np
from driving import drive, events
from fakes import ExactModule, observation

from sceneslam.types.rig import Sensor

TABLE = {"Bright": ["bright", "dark"]}


class Remote(ExactModule):
    """Tracks in two steps; `calls` is shared by all, in their order."""

    def __init__(self, name, calls, **options):
        super().__init__(**options)
        self.name, self.calls, self.pending = name, calls, None

    def submit(self, observation):
        assert self.pending is None
        self.calls.append(("submit", self.name))
        self.pending = observation

    def collect(self):
        observation, self.pending = self.pending, None
        self.calls.append(("collect", self.name))
        return super().track(observation)

    def track(self, observation):
        assert self.pending is None
        self.calls.append(("track", self.name))
        return super().track(observation)

    def get_map(self):
        assert self.pending is None
        return super().get_map()


def returned(make):
    """The first choice is lost for a while, runs beside its fallback, and comes back."""
    calls = []
    modules = {"bright": make("bright", calls, lost=range(20, 50)), "dark": make("dark", calls)}
    options = {"table": TABLE, "handover": "rewind", "retry_s": 1.0, "steps": 150}
    _, atlas, log, _ = drive(modules, **options)
    return calls, atlas, log


def test_a_module_on_trial_works_while_the_active_one_does():
    calls, _, log = returned(Remote)
    assert [event["reason"] for event in events(log, "decision")][-1] == "return"
    at = calls.index(("submit", "bright"))
    assert calls[at + 1 : at + 3] == [("track", "dark"), ("collect", "bright")]
    assert calls.count(("submit", "bright")) == calls.count(("collect", "bright")) >= 9


def test_a_module_on_trial_tracks_every_observation_once():
    """Its sensor is slower than the gyro, whose samples in between a catch-up adds."""

    class Slow(Remote):
        requires = (frozenset({Sensor.POINTS}),)
        stamps_ns = ()

        def collect(self):
            self.stamps_ns += (self.pending.stamp_ns,)
            return super().collect()

        def track(self, observation):
            self.stamps_ns += (observation.stamp_ns,)
            return super().track(observation)

    def feed(index):
        points = None if index % 3 else np.zeros((1, 3), np.float32)
        return replace(observation(index), points_lidar=points, gyro_base=np.zeros((1, 4)))

    bright = Slow("bright", [], lost=range(20, 50))
    options = {"table": TABLE, "handover": "rewind", "retry_s": 1.0, "steps": 150, "feed": feed}
    drive({"bright": bright, "dark": ExactModule()}, **options)
    assert ("submit", "bright") in bright.calls
    assert len(bright.stamps_ns) == len(set(bright.stamps_ns))


def test_it_does_not_matter_whether_they_work_at_once():
    def inline(name, calls, **options):
        return ExactModule(**options)

    _, remote, _ = returned(Remote)
    _, local, _ = returned(inline)
    np.testing.assert_array_equal(remote.trajectory.T_world_base, local.trajectory.T_world_base)
    assert remote.pose_modules == local.pose_modules
