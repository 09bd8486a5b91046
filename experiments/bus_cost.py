"""Print what the bus itself costs per observation, beside one event of its state machine.

The detector answers at once and the module dead-reckons, so that what is left is the bus; images
of 640x480 with depth are fresh ones, as a source gives them, and the buffer for `rewind` is full.
Both are medians of the wall clock, taken in turns: their ratio depends little on what else runs.

Run it by: python experiments/bus_cost.py
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from statistics import median
from time import perf_counter_ns

import numpy as np

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.bus import Bus, BusMachine
from sceneslam.bus.judging.gate import GateSettings
from sceneslam.bus.pace import PaceSettings
from sceneslam.bus.policy import Policy
from sceneslam.experiments.scripts import settings
from sceneslam.modules.slam.odometry import Odometry
from sceneslam.storage.events import EventLog
from sceneslam.types import se3
from sceneslam.types.observation import Observation, SceneVote
from sceneslam.types.rig import Rig, Sensor

COUNT, WARM = 1100, 500  # observations; the first of them fill the buffer
PERIOD_NS = 33_333_333
RIG = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.ODOMETRY}))


class OneScene:
    """Votes at once."""

    quantity, scenes = "", ("Any",)
    requires = (frozenset({Sensor.IMAGE}),)

    def activate(self, rig: Rig) -> None:
        """Do nothing."""

    def get_scene(self, observation: Observation) -> SceneVote:
        """Return the only scene."""
        return SceneVote(stamp_ns=observation.stamp_ns, scene="Any", value=1.0)

    def shutdown(self) -> None:
        """Do nothing."""


def policy(*, gate: bool, buffer: bool) -> Policy:
    """Return the shipped policy, with or without its gate and its buffer."""
    values = settings("policy/default.yaml")
    limits, pace = values.pop("gate"), values.pop("catch_up")
    del limits["_target_"], pace["_target_"]
    judge = GateSettings(**limits) if gate else None
    shipped = Policy(**values, gate=judge, catch_up=PaceSettings(**pace))
    return shipped if buffer else replace(shipped, buffer_s=0.0)


def observations() -> Iterator[Observation]:
    """Yield a drive with fresh images."""
    rng = np.random.default_rng(0)
    image_bgr = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    depth_m = np.ones((480, 640), np.float32)
    for index in range(COUNT):
        yield Observation(
            stamp_ns=index * PERIOD_NS,
            image_bgr=image_bgr.copy(),
            depth_m=depth_m.copy(),
            T_odom_base=se3.from_xy_yaw(0.01 * index, 0.0, 0.001 * index),
        )


class Owner:
    """Answers what the machine asks, and does nothing in its states."""

    def candidate_left(self) -> bool:
        """Return that there is one."""
        return True

    def fallback_active(self) -> bool:
        """Return that there is one."""
        return True

    def on_enter_run(self) -> None:
        """Do nothing."""

    def on_enter_switch(self) -> None:
        """Do nothing."""


def measure(policy: Policy) -> tuple[float, float]:
    """Return the medians of what the bus costs per observation, and of an event [us]."""
    machine = BusMachine(Owner())
    for event in ("success", "success"):
        machine.send(event)
    modules = {key: _dead_reckoning() for key in ("one", "other")}
    bus = Bus(
        detector=OneScene(),
        modules=modules,
        scenes={"Any": list(modules)},
        policy=policy,
        rig=RIG,
        back_end=Atlas(voxel_m=0.05),
        log=EventLog(),
    )
    events_us = []
    for observation in observations():
        began_ns = perf_counter_ns()
        machine.send("failure" if len(events_us) % 2 == 0 else "success")  # to switch and back
        events_us.append((perf_counter_ns() - began_ns) / 1e3)
        bus.step(observation)
    bus.close(0)
    return median(bus.bus_us[WARM:]), median(events_us[WARM:])


def _dead_reckoning() -> Odometry:
    return Odometry()


def main() -> None:
    """Print the cost with each part switched off, side by side."""
    for gate, buffer in ((False, False), (False, True), (True, False), (True, True)):
        bus_us, event_us = measure(policy(gate=gate, buffer=buffer))
        parts = f"gate {'on' if gate else 'off':3}  buffer {'on' if buffer else 'off':3}"
        print(
            f"{parts}  {bus_us:7.1f} us  {bus_us / event_us:5.2f} x an event of {event_us:.0f} us"
        )


if __name__ == "__main__":
    main()
