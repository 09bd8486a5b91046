"""A module that sees enough, and nothing of its map for long, begins anew; the back end knows."""

from dataclasses import replace

import numpy as np
import pytest
from driving import GATE, drive, events, policy
from fakes import PERIOD_NS, ExactModule, observation, true_pose
from test_bus_decisions import NOW_NS, S, situation

from sceneslam.bus.decision import Action, decide
from sceneslam.bus.judging.hold import Health
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.run import BRIDGED

ALONE = {"Bright": ["bright"]}
FIRST = 40  # observation after the gap
GAP_NS = 2 * 10**9


class Carried(ExactModule):
    """Finds nothing of the map that it had before the gap; it can begin where it `sees`."""

    def __init__(self, sees=lambda index: True):
        super().__init__()
        self.sees = sees

    def track(self, observation):
        index = (observation.stamp_ns - GAP_NS) // PERIOD_NS
        if index < FIRST:
            return super().track(observation)
        if self.activations > 1 and self.sees(index):
            return super().track(observation)
        self.lost.add(observation.stamp_ns // PERIOD_NS)
        answer = super().track(observation)
        self.lost.clear()
        return replace(answer, can_begin=self.sees(index))


def feed(index):
    """Without wheels, and with seconds missing."""
    one = observation(index, has_odometry=False)
    return one if index < FIRST else replace(one, stamp_ns=one.stamp_ns + GAP_NS)


def carried(module, *, steps=90, **options):
    options = {"retry_s": 2.0, "handover": "rewind", "table": ALONE, "feed": feed} | options
    return drive({"bright": module}, steps=steps, **options)


def test_a_module_alone_begins_anew_from_the_first_observation_after_the_gap():
    module = Carried()
    bus, atlas, log, _ = carried(module)
    assert module.activations == 2 and bus.state == "terminate"
    assert len(atlas.trajectory) == 90 and BRIDGED not in atlas.pose_modules
    assert [one.stamp_ns for one in atlas.session_starts()] == [0, FIRST * PERIOD_NS + GAP_NS]
    decision = events(log, "decision")[-1]
    assert (decision["from"], decision["to"], decision["reason"]) == ("bright", "bright", "lost")
    assert decision["stamp_ns"] == FIRST * PERIOD_NS + GAP_NS + 2 * S
    poses = atlas.trajectory.T_world_base[FIRST:]
    for index, T_map_base in enumerate(poses):
        T_true = true_pose(feed(FIRST + index).stamp_ns)
        moved = se3.inverse(true_pose(feed(FIRST).stamp_ns)) @ T_true
        np.testing.assert_allclose(se3.inverse(poses[0]) @ T_map_base, moved, atol=1e-9)


@pytest.mark.parametrize("handover", ["cold", "warm"])
def test_without_rewind_it_begins_at_the_newest_observation(handover):
    module = Carried()
    _, atlas, _, _ = carried(module, handover=handover)
    assert module.activations == 2
    assert atlas.session_starts()[1].stamp_ns == FIRST * PERIOD_NS + GAP_NS + 2 * S


def test_where_it_is_after_the_gap_is_as_uncertain_as_the_gap_was_long():
    _, atlas, _, _ = carried(Carried())
    lost_s = (feed(FIRST).stamp_ns - feed(FIRST - 1).stamp_ns) / 1e9
    sigmas = np.sqrt(np.diagonal(atlas.covariances(None), axis1=1, axis2=2))
    assert sigmas[FIRST - 1].max() < 0.1
    expected = np.repeat([lost_s, np.pi / np.sqrt(3.0)], 3)  # 1 m/s, and any heading
    np.testing.assert_allclose(sigmas[FIRST], expected, rtol=0.1)
    assert (sigmas[FIRST:] > 0.9 * expected).all()


def test_the_same_without_a_gap_is_as_certain_as_before():
    """The fallback takes over where the first was lost: both had the same observations."""
    modules = {"bright": ExactModule(lost=range(50, 1000)), "dark": ExactModule()}
    _, atlas, _, _ = drive(modules, has_odometry=False, handover="rewind")
    assert len(atlas.session_starts()) == 2
    sigmas = np.sqrt(np.diagonal(atlas.covariances(None), axis1=1, axis2=2))
    assert sigmas.max() < 0.1


def test_in_the_dark_it_keeps_its_map():
    module = Carried(sees=lambda index: index >= 70)
    _, atlas, _, _ = carried(module, steps=85)
    assert module.activations == 1 and len(atlas.trajectory) == FIRST
    module = Carried(sees=lambda index: index >= 70)
    _, atlas, _, _ = carried(module, steps=120)
    assert module.activations == 2 and len(atlas.trajectory) == FIRST + 50


def test_another_module_is_preferred():
    modules = {"bright": Carried(), "dark": ExactModule()}
    _, atlas, _, _ = drive(modules, steps=90, feed=feed, handover="rewind", retry_s=5.0)
    assert modules["bright"].activations == 1 and atlas.pose_modules[-1] == "dark"


def test_where_no_other_tracks_it_begins_anew_itself():
    blind = ExactModule(lost=range(1000))
    modules = {"bright": Carried(), "dark": blind}
    _, atlas, log, _ = drive(modules, steps=120, feed=feed, handover="rewind", retry_s=2.0)
    assert modules["bright"].activations == 2 and blind.activations > 0
    assert atlas.pose_modules[-1] == "bright" and len(atlas.trajectory) == 120
    assert not events(log, "fault")


@pytest.mark.parametrize("handover", ["cold", "warm", "rewind"])
def test_it_may_take_seconds_to_start(handover):
    module = Carried()
    options = {"handover": handover, "startup_s": {"bright": 1.5}}
    bus, atlas, _, _ = carried(module, steps=120, **options)
    assert module.activations == 2 and atlas.pose_modules[-1] == "bright"
    assert bus.state == "terminate"


def adrift(lost_ns, **changes):
    changes = {"unheld_since_ns": NOW_NS - 9 * S, "tried": frozenset("abc"), "rounds": 9} | changes
    now = situation(adrift_since_ns=NOW_NS - lost_ns, **changes)
    return decide(policy(retry_s=2.0), now)


def test_it_gets_as_long_to_find_itself_as_a_first_choice_that_is_tried_again():
    assert adrift(2 * S - 1).action is Action.GO_ON
    assert (adrift(2 * S).action, adrift(2 * S).to) == (Action.SWITCH, ("a",))


@pytest.mark.parametrize("health", [Health.SUSPECT, Health.SILENT])
def test_only_a_module_that_says_it_is_lost_begins_anew(health):
    assert adrift(9 * S, health=health).action is Action.GO_ON


def test_a_module_that_was_suspect_before_it_was_lost_begins_anew():
    class Jumping(ExactModule):
        """Is off by a metre at one index, and lost from the next on."""

        def track(self, observation):
            index = observation.stamp_ns // PERIOD_NS
            if self.activations == 1 and index > FIRST:
                self.lost.add(index)
            answer = replace(super().track(observation), can_begin=True)
            self.lost.clear()
            shift = se3.from_xy_yaw(float(index == FIRST), 0.0, 0.0)
            return replace(answer, T_local_base=shift @ answer.T_local_base)

    module = Jumping()
    _, atlas, log, _ = carried(module, feed=observation, gate=GATE)
    assert len(events(log, "suspect")) == 1 and module.activations == 2
    assert events(log, "decision")[-1]["stamp_ns"] == (FIRST + 1) * PERIOD_NS + 2 * S
    assert atlas.pose_modules[-1] == "bright"


def test_status_of_a_module_that_begins_anew_is_logged():
    _, _, log, _ = carried(Carried())
    statuses = [event["status"] for event in events(log, "tracking")]
    assert statuses == [one.value for one in (TrackingStatus.TRACKING, TrackingStatus.LOST)] + [
        TrackingStatus.TRACKING.value
    ]


def test_a_module_that_finds_itself_before_another_has_started_keeps_its_map():
    """It is lost for 2.2 s; the other, which takes a second to start, is lost, too."""

    class Covered(ExactModule):
        def track(self, observation):
            return replace(super().track(observation), can_begin=True)

    bright, dark = Covered(lost=range(30, 52)), ExactModule(lost=range(1000))
    options = {"startup_s": {"dark": 1.0}, "retry_s": 2.0, "lost_patience_s": 2.05}
    _, atlas, log, _ = drive({"bright": bright, "dark": dark}, handover="rewind", **options)
    (refused,) = events(log, "refused")
    assert (refused["to"], refused["stamp_ns"]) == ("dark", 61 * PERIOD_NS)
    assert bright.activations == 1 and atlas.pose_modules[-1] == "bright"


def test_a_module_that_is_lost_again_gets_as_long_to_find_itself():
    class Blind(ExactModule):
        def track(self, observation):
            if observation.stamp_ns >= GAP_NS + FIRST * PERIOD_NS:
                self.lost.add(observation.stamp_ns // PERIOD_NS)
            return replace(super().track(observation), can_begin=True)

    _, _, log, _ = carried(Blind(), steps=FIRST + 70)
    decided_s = [event["stamp_ns"] / 1e9 for event in events(log, "decision")[1:]]
    assert len(decided_s) == 3 and np.diff(decided_s).min() >= 2.0


def test_silence_is_no_time_in_which_it_saw_enough():
    def silent(index):
        return (
            replace(feed(index), image_bgr=None) if index in range(FIRST + 1, 80) else feed(index)
        )

    module = Carried()
    _, atlas, _, _ = carried(module, steps=110, feed=silent)
    assert module.activations == 2
    assert atlas.session_starts()[1].stamp_ns == 80 * PERIOD_NS + GAP_NS


def test_a_first_choice_that_returns_is_as_certain_of_its_place_as_the_fallback():
    class Weak(ExactModule):
        def track(self, observation):
            return replace(super().track(observation), status=TrackingStatus.DEGRADED)

    modules = {"bright": ExactModule(lost=range(20, 75)), "dark": Weak()}
    options = {"retry_s": 2.0, "handover": "rewind", "has_odometry": False, "steps": 200}
    _, atlas, _, _ = drive(modules, **options)
    assert atlas.pose_modules[-1] == "bright" and len(atlas.session_starts()) == 3
    sigmas = np.sqrt(np.diagonal(atlas.covariances(None), axis1=1, axis2=2))
    assert sigmas.max() < 0.2


def test_what_a_map_drifted_before_the_module_was_placed_is_no_doubt_about_its_place():
    """As of a module that tracked on trial for seconds."""

    class Drifting(ExactModule):
        def track(self, observation):
            drift = np.eye(6) * (observation.stamp_ns / 1e9) ** 2
            return replace(super().track(observation), map_covariance=drift)

    modules = {"bright": ExactModule(lost=range(50, 1000)), "dark": Drifting()}
    _, atlas, _, _ = drive(modules, has_odometry=False, handover="rewind")
    first = atlas.session_starts()[1].row
    of_maps = np.diagonal(atlas._path.of_maps(), axis1=1, axis2=2).max(axis=1)
    assert of_maps[first] < 1.2 and of_maps[-1] > 50.0  # m^2: 5.0^2 - 4.9^2, not 5.0^2
