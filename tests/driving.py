"""Drives the bus along a path on which every module knows its motion exactly."""

import numpy as np
from fakes import PERIOD_NS, RIG, ScriptedDetector, observation, true_pose

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.bus import Bus
from sceneslam.bus.judging.gate import GateSettings
from sceneslam.bus.pace import PaceSettings
from sceneslam.bus.policy import Policy
from sceneslam.storage.events import EventLog
from sceneslam.types import se3

GATE = GateSettings(sigmas=3.0)
TABLE = {"Bright": ["bright", "dark"], "Dark": ["dark", "bright"]}


def policy(**changes):
    values = {
        "handover": "warm",
        "confirm_window_s": 2.0,
        "first_confirm_window_s": 0.0,
        "lost_patience_s": 0.3,
        "retry_s": 1e6,
        "buffer_s": 12.0,
        "buffer_mb": 256.0,
        "catch_up": PaceSettings(period_s=0.0, step_m=0.0),
        "scene_filter": None,
        "gate": None,
        "startup_s": {},
    }
    return Policy(**(values | changes))


def drive(modules, *, steps=100, scene_at=lambda i: "Bright", table=TABLE, **options):
    """Run the bus over a straight drive; return it with its atlas, log and detector."""
    has_odometry = options.pop("has_odometry", True)
    catch_up_steps, is_live = options.pop("catch_up_steps", None), options.pop("is_live", False)
    rig, selected = options.pop("rig", RIG), options.pop("selected", "")
    feed = options.pop("feed", lambda index: observation(index, has_odometry=has_odometry))
    atlas, log, detector = Atlas(voxel_m=0.05), EventLog(), ScriptedDetector(scene_at)
    bus = Bus(
        detector=detector,
        modules=modules,
        scenes=table,
        policy=policy(**options),
        rig=rig,
        back_end=atlas,
        log=log,
        catch_up_steps=catch_up_steps,
        is_live=is_live,
    )
    bus.select(selected)
    for index in range(steps):
        if bus.state == "terminate":
            break
        observed = feed(index)
        bus.step(observed)
        atlas.observe(observed, bus.up_base)
    bus.close(index * PERIOD_NS)
    return bus, atlas, log, detector


def events(log, kind):
    return [event for event in log.events if event["event"] == kind]


def dark_from(index):
    return lambda i: "Dark" if i >= index else "Bright"


def assert_exact(atlas):
    T_first = true_pose(int(atlas.trajectory.stamps_ns[0]))
    for stamp_ns, T_map_base in zip(
        atlas.trajectory.stamps_ns.tolist(), atlas.trajectory.T_world_base, strict=True
    ):
        expected = se3.inverse(T_first) @ true_pose(stamp_ns)
        np.testing.assert_allclose(T_map_base, expected, atol=1e-9)
