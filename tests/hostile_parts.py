"""A source, a detector and a sink that break every promise they can, one at a time."""

from dataclasses import replace

import numpy as np
from fakes import PERIOD_NS, FakeSource, IdleSink
from hostile import SHEAR, put, throw

from sceneslam.modules.detectors.grey_mean import GreyMean
from sceneslam.types import se3


class BreaksOff(FakeSource):
    """Goes wrong half-way, or says nonsense."""

    def __init__(self, how, steps=100, dark_from=1000, at=50):
        super().__init__(steps, dark_from)
        self._how, self._at = how, at

    def __iter__(self):
        for index, found in enumerate(super().__iter__()):
            yield found if index < self._at else getattr(self, self._how)(found, index)

    def throw(self, found, index):
        raise ValueError("the driver crashed")

    def leave(self, found, index):
        raise SystemExit(3)

    def image_empty(self, found, index):
        return replace(found, image_bgr=np.zeros((0, 0, 3), np.uint8))

    def image_grows(self, found, index):
        return replace(found, image_bgr=np.full((9, 7, 3), 180, np.uint8))

    def image_is_grey(self, found, index):
        return replace(found, image_bgr=np.full((9, 7), 180, np.uint8))

    def image_is_float(self, found, index):
        return replace(found, image_bgr=np.full((9, 7, 3), np.nan))

    def depth_is_nan(self, found, index):
        return replace(found, depth_m=np.full((9, 7), np.nan, np.float32))

    def odometry_is_infinite(self, found, index):
        return replace(found, T_odom_base=np.full((4, 4), np.inf))

    def odometry_is_sheared(self, found, index):
        return replace(found, T_odom_base=found.T_odom_base @ SHEAR)

    def odometry_is_reset(self, found, index):
        return replace(found, T_odom_base=se3.from_xy_yaw(5.0, 2.0, 1.0) @ found.T_odom_base)

    def odometry_is_far(self, found, index):
        return replace(found, T_odom_base=put(found.T_odom_base, 0, 3, 1e200))

    def stamp_is_negative(self, found, index):
        return replace(found, stamp_ns=-found.stamp_ns)

    def stamp_is_zero(self, found, index):
        return replace(found, stamp_ns=0)

    def stamp_is_huge(self, found, index):
        return replace(found, stamp_ns=2**70)

    def stamp_jumps_years(self, found, index):
        return replace(found, stamp_ns=found.stamp_ns + 10 * 31_536_000 * 10**9)

    def stamp_jumps_back_years(self, found, index):
        return replace(found, stamp_ns=found.stamp_ns - 10 * 31_536_000 * 10**9)

    def stamp_is_float(self, found, index):
        return replace(found, stamp_ns=float(found.stamp_ns))

    def nothing(self, found, index):
        return None

    def gyro_is_infinite(self, found, index):
        return replace(found, gyro_base=np.full((5, 4), np.inf))


class Votes:
    """Passes on a grey mean's votes, but one."""

    quantity = ""

    def __init__(self, how):
        self._how = how
        self._inner = GreyMean(threshold=100.0, hysteresis=0.0, scenes=["Bright", "Dark"])
        self.scenes, self.requires = self._inner.scenes, self._inner.requires

    def activate(self, rig):
        if self._how == "throws at once":
            raise RuntimeError("no weights")
        self._inner.activate(rig)

    def get_scene(self, observation):
        vote = self._inner.get_scene(observation)
        if observation.stamp_ns // PERIOD_NS < 20:
            return vote
        if self._how == "throws":
            raise RuntimeError("out of memory")
        if self._how in ("none", "a text"):
            return None if self._how == "none" else "Bright"
        if self._how == "an unknown scene":
            return replace(vote, scene="Fog")
        if self._how == "no scene":
            return replace(vote, scene=None)
        if self._how == "leaves":
            raise SystemExit(3)
        return replace(vote, value=float("nan"), stamp_ns=vote.stamp_ns - 10**12)

    def shutdown(self):
        if self._how == "throws at the end":
            raise RuntimeError("still busy")


class Fails(IdleSink):
    """Fails in one of its methods."""

    def __init__(self, method, error="Exception"):
        self._method, self._error = method, error
        if method == "__init__":
            throw(error)

    def __getattribute__(self, name):
        if name == object.__getattribute__(self, "_method"):
            return lambda *arguments: throw(object.__getattribute__(self, "_error"))
        return object.__getattribute__(self, name)


class Clears(IdleSink):
    """Empties every event that it is given, and what is in it."""

    def write_event(self, event):
        event["posterior"].clear()
        event.clear()
