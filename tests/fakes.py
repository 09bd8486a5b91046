"""Stand-ins that break their promises on demand."""

from __future__ import annotations

import json
import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from sceneslam.types import se3
from sceneslam.types.command import Pause
from sceneslam.types.errors import InputError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import (
    UNSURE,
    Observation,
    SceneVote,
    Tracking,
    TrackingStatus,
)
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth, SceneChange

PERIOD_NS = 100_000_000
TWIST = np.array([0.5, 0.1, 0.05, 0.1, -0.2, 0.3])  # per second: it climbs and turns on all axes
RIG = Rig(sensors=frozenset({Sensor.ODOMETRY, Sensor.IMAGE}))


def true_pose(stamp_ns: int) -> np.ndarray:
    """The robot moves at a constant twist."""
    return se3.exp(stamp_ns / 1e9 * TWIST)


def observation(index: int, *, has_odometry: bool = True) -> Observation:
    stamp_ns = index * PERIOD_NS
    T_odom_base = true_pose(stamp_ns)
    return Observation(
        stamp_ns=stamp_ns,
        image_bgr=np.zeros((2, 2, 3), np.uint8),
        T_odom_base=T_odom_base if has_odometry else None,
    )


class ScriptedDetector:
    """Votes for the scene that `scene_at` names for an index."""

    quantity = ""
    scenes = ("Bright", "Dark")
    requires = (frozenset({Sensor.IMAGE}),)

    def __init__(self, scene_at):
        self.scene_at = scene_at
        self.is_shut_down = False

    def activate(self, rig):
        pass

    def get_scene(self, observation):
        scene = self.scene_at(observation.stamp_ns // PERIOD_NS)
        return SceneVote(stamp_ns=observation.stamp_ns, scene=scene or UNSURE)

    def shutdown(self):
        self.is_shut_down = True


class ExactModule:
    """Knows the motion exactly, but at the indices in `lost`, `raises` and `returns_nan`."""

    requires = (frozenset({Sensor.IMAGE}),)

    def __init__(self, *, lost=(), raises=(), returns_nan=(), raises_on_activate=False):
        self.lost, self.raises, self.returns_nan = set(lost), set(raises), set(returns_nan)
        self.raises_on_activate = raises_on_activate
        self.activations, self.shutdowns, self.scenes = 0, 0, []

    def activate(self, rig):
        if self.raises_on_activate:
            raise RuntimeError("no licence")
        self.activations += 1
        self._first_ns, self._T_local_base, self._T_map_local = None, se3.identity(), se3.identity()

    def set_pose(self, T_map_local):
        self._T_map_local = T_map_local

    def set_scene(self, scene):
        self.scenes.append(scene)

    def track(self, observation):
        index = observation.stamp_ns // PERIOD_NS
        if index in self.raises:
            raise RuntimeError("out of memory")
        if index in self.lost:
            return Tracking(
                stamp_ns=observation.stamp_ns,
                T_local_base=self._T_local_base,
                status=TrackingStatus.LOST,
            )
        if self._first_ns is None:
            self._first_ns = observation.stamp_ns
        T_first = true_pose(self._first_ns)
        self._T_local_base = se3.inverse(T_first) @ true_pose(observation.stamp_ns)
        if index in self.returns_nan:
            self._T_local_base = self._T_local_base * np.nan
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=self._T_local_base,
            status=TrackingStatus.TRACKING,
        )

    def get_trajectory(self):
        return Trajectory.empty()

    def get_map(self):
        return MapLayers()

    def shutdown(self):
        self.shutdowns += 1


class LingeringModule(ExactModule):
    """Leaves two threads running that wait for ever, one of them of a pool."""

    def __init__(self):
        super().__init__()
        threading.Thread(target=threading.Event().wait, name="lingering").start()
        ThreadPoolExecutor(1, "lingering").submit(threading.Event().wait)


class ClosingModule(ExactModule):
    """Says that it closes loops itself, if it is told to say so."""

    def __init__(self, closes_loops=True):
        super().__init__()
        self.closes_loops = closes_loops


class FakeSource:
    """A drive of `steps` observations with exact truth; it can break half-way."""

    def __init__(self, steps: int, dark_from: int, breaks_at: int | None = None, fault: str = ""):
        self._steps, self._dark_from, self._breaks_at = steps, dark_from, breaks_at
        self._fault = fault
        self.rig = RIG

    @property
    def length(self):
        return self._steps

    @property
    def faults(self):
        return (self._fault,) if self._fault else ()

    def __iter__(self):
        for index in range(self._steps):
            if index == self._breaks_at:
                raise InputError("the recording breaks off: fake.bag")
            grey = 30 if index >= self._dark_from else 180
            yield replace(observation(index), image_bgr=np.full((2, 2, 3), grey, np.uint8))

    def ground_truth(self):
        poses = np.stack([observation(index).T_odom_base for index in range(self._steps)])
        stamps_ns = np.arange(self._steps, dtype=np.int64) * PERIOD_NS
        scenes = (SceneChange(stamp_ns=0, scene="Bright"),)
        if self._dark_from < self._steps:
            scenes += (SceneChange(stamp_ns=self._dark_from * PERIOD_NS, scene="Dark"),)
        trajectory = Trajectory(stamps_ns=stamps_ns, T_world_base=poses)
        return GroundTruth(trajectory=trajectory, scenes=scenes)


class LateStamps(FakeSource):
    """A recording that stamped every other observation late, so that their order is another one."""

    def logged_ns(self, stamps_ns):
        return stamps_ns + 3 * PERIOD_NS * (stamps_ns // PERIOD_NS % 2)


class InterruptedModule(ExactModule):
    """Presses Ctrl-C at an index."""

    def __init__(self, at: int):
        super().__init__()
        self._at = at

    def track(self, observation):
        if observation.stamp_ns // PERIOD_NS == self._at:
            raise KeyboardInterrupt
        return super().track(observation)


class DepthModule(ExactModule):
    """Needs what the fake source has not."""

    requires = (frozenset({Sensor.DEPTH}),)


class Mute:
    """Cannot be built, and does not say why."""

    def __init__(self):
        raise AssertionError


class SourceWithoutTruth(FakeSource):
    def ground_truth(self):
        raise InputError("groundtruth.txt: line 3")


class LiveFeedSource(FakeSource):
    """Measures now, until it is closed."""

    is_open = True

    @property
    def live(self):
        return self

    def close(self):
        LiveFeedSource.is_open = False


class BuggyTruth(FakeSource):
    """Raises an error of its own where the truth is asked for."""

    def ground_truth(self):
        raise ValueError("7 numbers")


class TruthOfNaN(FakeSource):
    """Knows where it was, but for the numbers."""

    def ground_truth(self):
        truth = super().ground_truth()
        truth.trajectory.T_world_base[:] = np.nan
        return truth


class InterruptedSource(FakeSource):
    """Is stopped while it renders; its truth would have to be rendered too."""

    def __iter__(self):
        raise KeyboardInterrupt

    def ground_truth(self):
        raise AssertionError


class BuggySource(FakeSource):
    """Divides by zero half-way."""

    def __iter__(self):
        for index, found in enumerate(super().__iter__()):
            yield found if index < 50 else index / 0


class IdleSink:
    """A sink that writes nothing."""

    def open(self, rig, folder):
        pass

    def write(self, observation, T_map_base, module):
        pass

    def write_event(self, event):
        pass

    def write_truth(self, truth):
        pass

    def close(self):
        pass


class Display(IdleSink):
    """A sink that writes no file."""

    writes_files = False


class FullDisk(IdleSink):
    """A sink that cannot write."""

    def write(self, observation, T_map_base, module):
        raise OSError("no space left on device")


class PausingSink(IdleSink):
    """Pauses the run before the third observation, until the sixth; writes down what it hears."""

    def open(self, rig, folder):
        self._path, self._asked, self._heard = folder / "heard.json", 0, []

    def commands(self):
        self._asked += 1
        return {3: [Pause(is_paused=True)], 6: [Pause(is_paused=False)]}.get(self._asked, [])

    def write_event(self, event):
        self._heard.append({"asked": self._asked, **event})

    def close(self):
        self._path.write_text(json.dumps(self._heard))


class DeafSink(IdleSink):
    """Cannot hear its operator."""

    def commands(self):
        raise OSError("no such microphone")


class ClosedSink(IdleSink):
    """Cannot be opened."""

    def open(self, rig, folder):
        raise OSError("no such device")


class Intruder(ClosedSink):
    """Somebody who puts a file of his own into the run's folder while it runs."""

    def __init__(self, name):
        self._name = name

    def open(self, rig, folder):
        (folder / self._name).write_text("mine")


class Killer(ClosedSink):
    """Sends its process a signal at an observation; SIGKILL, as where no memory is left."""

    def __init__(self, at, number=signal.SIGKILL):
        self._left, self._number = at, number

    def open(self, rig, folder):
        pass

    def write(self, observation, T_map_base, module):
        if self._left == 0:
            os.kill(os.getpid(), self._number)
        self._left -= 1


class Presser(IdleSink):
    """Presses Ctrl-C when it is closed, which is while the results are saved."""

    def __init__(self, times):
        self._times = times

    def close(self):
        for _ in range(self._times):
            signal.raise_signal(signal.SIGINT)


class Waiter(ClosedSink):
    """Waits at an observation until a pipe is closed."""

    def __init__(self, at, until):
        self._left, self._until = at, until

    def open(self, rig, folder):
        self._folder = folder

    def write(self, observation, T_map_base, module):
        if self._left == 0:
            (self._folder / "waiting").touch()
            os.read(self._until, 1)
        self._left -= 1


class SourceWhoseTruthNeedsTheTrajectory(FakeSource):
    """Fails where the trajectory is not on disk before what is true is asked for."""

    def __init__(self, steps, dark_from, folder):
        super().__init__(steps, dark_from)
        self._folder = Path(folder)

    def ground_truth(self):
        if not (self._folder / "trajectory.tum").exists():
            raise InputError("asked too early")
        return super().ground_truth()
