"""Modules that break every promise they can, one at a time."""

import ctypes
import logging
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import replace

import numpy as np
from fakes import PERIOD_NS, ExactModule

from sceneslam.types.maps import GridLayer, MapLayers, PointLayer
from sceneslam.types.trajectory import Trajectory

SHEAR = np.array([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def with_pose(change):
    return lambda tracking: replace(tracking, T_local_base=change(tracking.T_local_base))


def put(T_local_base, row, column, value):
    changed = T_local_base.copy()
    changed[row, column] = value
    return changed


def as_is(**fields):
    return lambda tracking: replace(tracking, **fields)


ANSWERS = {
    "none": lambda tracking: None,
    "a number": lambda tracking: 5.0,
    "the matrix alone": lambda tracking: tracking.T_local_base,
    "no pose": with_pose(lambda T: None),
    "a pose of text": with_pose(lambda T: "here"),
    "a list of texts": with_pose(lambda T: [["a"] * 4] * 4),
    "a ragged pose": with_pose(lambda T: [[1.0], [2.0, 3.0]]),
    "a complex pose": with_pose(lambda T: T + 1j),
    "a position alone": with_pose(lambda T: T[:3, 3]),
    "NaN in the rotation": with_pose(lambda T: put(T, 0, 1, np.nan)),
    "NaN in the position": with_pose(lambda T: put(T, 1, 3, np.nan)),
    "an infinite position": with_pose(lambda T: put(T, 1, 3, np.inf)),
    "infinities that cancel": with_pose(lambda T: put(put(T, 1, 3, np.inf), 0, 3, -np.inf)),
    "a position beyond all measure": with_pose(lambda T: put(T, 1, 3, 1e200)),
    "a scaled rotation": with_pose(lambda T: T * np.array([[1.5], [1.5], [1.5], [1.0]])),
    "a sheared rotation": with_pose(lambda T: T @ SHEAR),
    "a mirrored rotation": with_pose(lambda T: T @ np.diag([1.0, 1.0, -1.0, 1.0])),
    "zeros": with_pose(np.zeros_like),
    "a wrong last row": with_pose(lambda T: put(T, 3, 0, 0.5)),
    "no status": as_is(status=None),
    "a status of text": as_is(status="tracking"),
    "a stamp long ago": as_is(stamp_ns=-(10**18)),
    "a stamp to come": as_is(stamp_ns=10**18),
    "a stamp of text": as_is(stamp_ns="now"),
    "no stamp": as_is(stamp_ns=None),
    "covariance NaN": as_is(covariance=np.full((6, 6), np.nan)),
    "covariance infinite": as_is(covariance=np.full((6, 6), np.inf)),
    "covariance huge": as_is(covariance=np.eye(6) * 1e300),
    "covariance negative": as_is(covariance=-np.eye(6)),
    "covariance of positions": as_is(covariance=np.eye(3)),
    "covariance of text": as_is(covariance="small"),
    "quality NaN": as_is(quality_ratio=float("nan")),
    "quality of text": as_is(quality_ratio="good"),
    "inliers of text": as_is(inliers="many"),
    "no inliers": as_is(inliers=None),
    "inliers NaN": as_is(inliers=float("nan")),
    "revision of text": as_is(revision="second"),
    "no revision": as_is(revision=None),
}

MAPS = {
    "none": None,
    "text": "a map",
    "a cloud of text": MapLayers(points=PointLayer(points="cloud")),
    "a flat cloud": MapLayers(points=PointLayer(points=np.zeros(7, np.float32))),
    "a cloud of NaN": MapLayers(points=PointLayer(points=np.full((9, 3), np.nan, np.float32))),
    "a cloud beyond all measure": MapLayers(
        points=PointLayer(points=np.full((9, 3), 1e30, np.float32))
    ),
    "too few colours": MapLayers(
        points=PointLayer(points=np.ones((9, 3), np.float32), colors_bgr=np.ones((2, 3), np.uint8))
    ),
    "a grid of nothing": MapLayers(
        grid=GridLayer(
            log_odds=np.zeros((0, 0), np.float32), resolution_m=0.0, origin_xy_m=(0.0, 0.0)
        )
    ),
    "a grid of NaN": MapLayers(
        grid=GridLayer(
            log_odds=np.full((4, 4), np.nan, np.float32), resolution_m=0.1, origin_xy_m=(np.nan, 0)
        )
    ),
    "a pose graph of text": MapLayers(pose_graph="graph"),
}

POSES = np.tile(np.eye(4), (3, 1, 1))
STAMPS_NS = np.arange(3, dtype=np.int64) * PERIOD_NS
TRAJECTORIES = {
    "none": None,
    "a list": [1, 2, 3],
    "text inside": Trajectory(stamps_ns="a", T_world_base="b"),
    "poses of NaN": Trajectory(stamps_ns=STAMPS_NS, T_world_base=POSES * np.nan),
    "sheared poses": Trajectory(stamps_ns=STAMPS_NS, T_world_base=POSES @ SHEAR),
    "fewer poses than stamps": Trajectory(stamps_ns=STAMPS_NS, T_world_base=POSES[:2]),
    "stamps that fall": Trajectory(stamps_ns=STAMPS_NS[::-1], T_world_base=POSES),
    "stamps of another time": Trajectory(stamps_ns=STAMPS_NS + 10**18, T_world_base=POSES),
    "stamps in a column": Trajectory(stamps_ns=STAMPS_NS[:, None], T_world_base=POSES),
    "stamps in seconds": Trajectory(stamps_ns=STAMPS_NS * 1e-9, T_world_base=POSES),
    "positions beyond all measure": Trajectory(
        stamps_ns=STAMPS_NS, T_world_base=POSES * np.array([1, 1, 1, 1e200])
    ),
}


class UnspeakableError(Exception):
    """Cannot even be printed."""

    def __str__(self):
        raise RuntimeError


class UnheardError(BaseException):
    """Not an Exception."""


ERRORS = {
    "Exception": Exception("as usual"),
    "SystemExit": SystemExit(3),
    "KeyboardInterrupt": KeyboardInterrupt(),
    "GeneratorExit": GeneratorExit(),
    "StopIteration": StopIteration(),
    "MemoryError": MemoryError(),
    "unspeakable": UnspeakableError(),
    "unheard": UnheardError("not an Exception"),
    "recursion": None,
}


def throw(name):
    if name == "recursion":
        return throw(name)
    raise ERRORS[name]


class Answers(ExactModule):
    """Answers wrongly at one observation, from one on if it is `always` so."""

    def __init__(self, answer, at=20, is_always=False):
        super().__init__()
        self._answer, self._at, self._is_always = ANSWERS[answer], at, is_always

    def track(self, observation):
        tracking = super().track(observation)
        index = observation.stamp_ns // PERIOD_NS
        is_now = index >= self._at if self._is_always else index == self._at
        return self._answer(tracking) if is_now else tracking


class Leaves(ExactModule):
    """Leaves a map and a trajectory that are none."""

    def __init__(self, layers=None, trajectory=None):
        super().__init__()
        self._layers, self._trajectory = layers, trajectory

    def get_map(self):
        return MAPS[self._layers] if self._layers else super().get_map()

    def get_trajectory(self):
        return TRAJECTORIES[self._trajectory] if self._trajectory else super().get_trajectory()


class Throws(ExactModule):
    """Raises what nobody should, in one of its methods."""

    def __init__(self, error, method, at=20):
        super().__init__()
        self._error, self._method, self._at = error, method, at

    def __getattribute__(self, name):
        inherited = super().__getattribute__(name)
        if name.startswith("_") or name != self._method:
            return inherited
        if name == "requires":
            return throw(self._error)
        return self._track if name == "track" else lambda *arguments: throw(self._error)

    def _track(self, observation):
        if observation.stamp_ns // PERIOD_NS == self._at:
            throw(self._error)
        return ExactModule.track(self, observation)


class Wrecks(ExactModule):
    """Does something to the process it lives in, at one observation."""

    def __init__(self, how, at=20):
        super().__init__()
        self._how, self._at = how, at

    def track(self, observation):
        if observation.stamp_ns // PERIOD_NS == self._at:
            getattr(self, self._how)()
        return super().track(observation)

    def die(self):
        os._exit(0)

    def overflow_the_stack(self):
        again = ctypes.CFUNCTYPE(None)(lambda: again())
        threading.stack_size(1 << 16)
        sys.setrecursionlimit(10**9)
        again()

    def wait_for_ever(self):
        lock = threading.Lock()
        with lock:
            lock.acquire()

    def wait_for_a_thread(self):
        thread = threading.Thread(target=self.wait_for_ever)
        thread.start()
        thread.join()

    def stop(self):
        os.kill(os.getpid(), signal.SIGSTOP)

    def print_megabytes(self):
        sys.stdout.write("nonsense " * 1_000_000)

    def log_megabytes(self):
        for _ in range(20):
            logging.getLogger("hostile").warning("nonsense " * 50_000)

    def close_descriptors(self):
        os.closerange(0, 256)

    def use_up_descriptors(self):
        self._hoard = []
        while True:
            self._hoard.append(os.open("/dev/null", os.O_RDONLY))

    def babble(self):
        """Write nonsense to every descriptor that there is."""
        for fd in range(3, 64):
            with suppress(OSError):
                os.write(fd, b"nonsense")

    def fork(self):
        if os.fork() == 0:
            signal.pause()

    def fork_and_die(self):
        self.fork()
        os._exit(1)

    def start_a_daemon(self):
        subprocess.Popen(
            [sys.executable, "-c", "import signal; signal.pause()  # hostile daemon"],
            start_new_session=True,
        )

    def start_a_thread_that_stays(self):
        threading.Thread(target=signal.sigwait, args=({signal.SIGUSR1},)).start()

    def move(self):
        os.chdir("/")
        os.umask(0o777)
        os.environ.clear()

    def ignore_signals(self):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def signal_its_group(self):
        os.killpg(0, signal.SIGTERM)
