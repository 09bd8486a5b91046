"""Modules that can be started again after they failed: the bus goes on without, and with them."""

import numpy as np
import pytest
from driving import assert_exact, dark_from, drive, events
from fakes import PERIOD_NS, ExactModule, observation


class Phoenix(ExactModule):
    """Fails at the indices in `raises`, once each; is ready again when asked often enough."""

    def __init__(self, *, asked=0, budget=100, **options):
        super().__init__(**options)
        self.failures, self._asked, self._budget, self._left = 0, asked, budget, 0

    @property
    def is_ready(self):
        self._left -= 1
        return self._left < 0 and not self.is_spent

    @property
    def is_spent(self):
        return self.failures > self._budget

    def note_failure(self):
        self.failures, self._left = self.failures + 1, self._asked

    def track(self, observation):
        index = observation.stamp_ns // PERIOD_NS
        try:
            return super().track(observation)
        finally:
            self.raises.discard(index)


ALONE = {"Bright": ["only"], "Dark": ["only"]}


def test_the_only_module_is_started_again_at_once():
    only = Phoenix(raises={30, 60})
    bus, atlas, log, _ = drive({"only": only}, table=ALONE, has_odometry=False)
    assert bus.state == "terminate" and only.activations == 3 and only.failures == 2
    assert len(atlas.trajectory) == 100 and len(events(log, "fault")) == 2
    assert_exact(atlas)


@pytest.mark.parametrize("name", ["is_ready", "is_spent", "note_failure"])
def test_a_failed_module_that_cannot_tell_whether_it_returns_does_not_return(name, caplog):
    class Mute(Phoenix):
        """Has a member that raises once it has failed."""

        def __getattribute__(self, asked):
            if asked == name and not object.__getattribute__(self, "raises"):
                raise OSError("the licence server is gone")
            return object.__getattribute__(self, asked)

    modules = {"bright": Mute(raises={30}), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, retry_s=1.0)
    assert atlas.pose_modules == ("bright",) * 30 + ("dark",) * 70
    assert len(events(log, "fault")) == 1
    assert caplog.text.count("slam.bright could not tell whether it can be started again") == 1
    assert_exact(atlas)


@pytest.mark.parametrize("choices", [("bright", "dark"), ("dark", "bright")])
def test_a_module_that_fails_where_the_scene_changes_ends_before_it_starts_again(choices):
    class Noting(Phoenix):
        """Notes in which order it is started and shut down."""

        calls = ()

        def activate(self, rig):
            self.calls += ("activate",)
            super().activate(rig)

        def shutdown(self):
            self.calls += ("shutdown",)
            super().shutdown()

    bright = Noting(raises={60})
    modules = {"bright": bright, "dark": ExactModule(raises_on_activate=True)}
    table = {"Bright": ["bright"], "Dark": choices}
    _, atlas, log, _ = drive(modules, table=table, scene_at=dark_from(40))
    assert events(log, "decision")[-1]["stamp_ns"] == 60 * PERIOD_NS
    assert bright.calls == ("activate", "shutdown") * 2
    assert_exact(atlas)


def test_live_the_bus_goes_on_without_any_module_until_one_is_ready():
    only = Phoenix(raises={30}, asked=50)
    _, atlas, log, _ = drive({"only": only}, table=ALONE, catch_up_steps=4)
    assert only.activations == 2 and len(atlas.trajectory) == 100
    assert "" in {event["active"] for event in events(log, "situation")}
    assert [event["to"] for event in events(log, "state")].count("terminate") == 1
    assert_exact(atlas)


def test_both_modules_may_fail_and_come_back():
    bright, dark = Phoenix(raises={30, 33}), Phoenix(raises={30, 31, 32})
    _, atlas, _, _ = drive({"bright": bright, "dark": dark}, has_odometry=False)
    assert len(atlas.trajectory) == 100
    assert_exact(atlas)


def test_a_module_that_came_back_to_the_scene_it_is_first_for_is_used_again():
    bright = Phoenix(raises={30})
    modules = {"bright": bright, "dark": ExactModule()}
    _, atlas, _, _ = drive(modules, handover="rewind", retry_s=2.0, steps=200)
    assert atlas.pose_modules[35] == "dark" and atlas.pose_modules[-1] == "bright"
    assert_exact(atlas)


def test_a_trial_ends_where_a_better_choice_is_ready_again():
    modules = {
        "first": Phoenix(raises={30}, asked=90),
        "second": ExactModule(lost=range(30, 40)),
        "third": ExactModule(),
    }
    table = {"Bright": ["first", "second", "third"]}
    options = {"handover": "rewind", "retry_s": 1.0, "catch_up_steps": 4}
    bus, atlas, log, _ = drive(modules, table=table, **options)
    assert [event["to"] for event in events(log, "decision")] == ["first", "third", "first"]
    assert modules["second"].activations == 2 and len(bus.runners["second"].track_ms) < 20
    assert_exact(atlas)


def test_a_module_whose_budget_is_spent_ends_the_run_as_one_that_cannot_be_restarted():
    only = Phoenix(raises={30, 31}, budget=1)
    bus, atlas, log, _ = drive({"only": only}, table=ALONE, has_odometry=False)
    assert only.failures == 2 and bus.state == "terminate"
    assert len(atlas.trajectory) < 40 and np.isfinite(atlas.trajectory.T_world_base).all()
    assert [event["from"] for event in events(log, "state")][-1] == "switch"


def test_a_short_silence_of_the_wheels_while_they_bridge_costs_no_pose():
    def feed(index):
        return observation(index, has_odometry=not 40 <= index < 44)

    lost = ExactModule(lost=range(30, 60))
    _, atlas, _, _ = drive({"bright": lost, "dark": ExactModule(lost=range(1000))}, feed=feed)
    assert len(atlas.online) == 100


@pytest.mark.parametrize("handover", ["cold", "warm", "rewind"])
@pytest.mark.parametrize("catch_up_steps", [None, 4])
def test_modules_that_all_fail_at_the_start_may_come_back(handover, catch_up_steps):
    modules = {"bright": Phoenix(raises={0, 1, 2}, asked=3), "dark": Phoenix(raises={0, 1})}
    options = {"handover": handover, "catch_up_steps": catch_up_steps}
    bus, atlas, log, _ = drive(modules, **options)
    assert [event["to"] for event in events(log, "state")].count("terminate") == 1
    assert len(atlas.trajectory) >= 90 and bus.state == "terminate"
    assert np.isfinite(atlas.trajectory.T_world_base).all()


def test_modules_that_fail_for_good_at_the_start_end_the_run():
    modules = {key: Phoenix(raises=set(range(100)), budget=2) for key in ("bright", "dark")}
    _, atlas, log, _ = drive(modules)
    states = [event["to"] for event in events(log, "state")]
    assert states[-1] == "terminate" and log.events[-1]["stamp_ns"] < 50 * PERIOD_NS
    assert len(atlas.trajectory) < 50
