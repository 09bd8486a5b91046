"""A live run: starting, ending and saving take as long as they like; no observation waits."""

from threading import Event
from time import sleep

import numpy as np
from driving import TABLE, assert_exact, dark_from, drive, events
from fakes import PERIOD_NS, ExactModule, observation

from sceneslam.engine.steering import Operator
from sceneslam.executors import executor
from sceneslam.types.command import SaveMap
from sceneslam.types.maps import HybridMap, PointLayer


class Slow(ExactModule):
    """Starts or ends only once it is let."""

    def __init__(self, *, may_start=None, may_end=None):
        super().__init__()
        self._may_start, self._may_end = may_start, may_end
        self.has_started = Event()

    def activate(self, rig):
        assert self._may_start is None or self._may_start.wait(10.0)
        super().activate(rig)
        self.has_started.set()

    def get_trajectory(self):
        assert self._may_end is None or self._may_end.wait(10.0)
        return super().get_trajectory()


def letting(event, at, then=None):
    """Return a feed that sets an event at an observation and awaits another soon after.

    From then on there is time between observations, as there is on a robot.
    """

    def feed(index):
        if index == at:
            event.set()
        if index > at:
            sleep(1e-3)
        if index == at + 10 and then is not None:
            assert then.wait(10.0)
        return observation(index)

    return feed


def settled(log, kind, module):
    return [one for one in events(log, kind) if one.get("to", one.get("module")) == module]


def test_module_that_starts_slowly_takes_over_when_it_is_ready():
    may_start = Event()
    modules = {"bright": ExactModule(), "dark": Slow(may_start=may_start)}
    _, atlas, log, _ = drive(
        modules,
        scene_at=dark_from(20),
        steps=400,
        confirm_window_s=0.5,
        is_live=True,
        feed=letting(may_start, 100, modules["dark"].has_started),
        handover="rewind",
        buffer_s=100.0,
    )
    assert len(atlas.trajectory) == 400
    assert_exact(atlas)
    (decision,) = settled(log, "decision", "dark")
    assert decision["stamp_ns"] >= 100 * PERIOD_NS
    assert atlas.pose_modules[60] in ("bright", "dark") and atlas.pose_modules[-1] == "dark"


def test_module_that_ends_slowly_keeps_nobody_and_its_map_is_kept():
    may_end = Event()
    modules = {"bright": Slow(may_end=may_end), "dark": ExactModule()}
    _, atlas, log, _ = drive(
        modules,
        scene_at=dark_from(20),
        confirm_window_s=0.5,
        is_live=True,
        feed=letting(may_end, 90),
    )
    assert len(atlas.trajectory) == 100
    assert settled(log, "decision", "dark")[0]["stamp_ns"] < 40 * PERIOD_NS
    assert len(atlas.sessions) == 2 and not events(log, "fault")


def test_module_that_is_called_back_while_it_ends_starts_after_that():
    may_end = Event()
    modules = {"bright": Slow(may_end=may_end), "dark": ExactModule()}
    _, atlas, log, _ = drive(
        modules,
        scene_at=lambda i: "Dark" if 20 <= i < 40 else "Bright",
        steps=600,
        confirm_window_s=0.5,
        is_live=True,
        feed=letting(may_end, 100),
    )
    assert len(atlas.trajectory) == 600
    assert_exact(atlas)
    assert [one["to"] for one in events(log, "decision")] == ["bright", "dark", "bright"]
    assert events(log, "decision")[-1]["stamp_ns"] >= 100 * PERIOD_NS


def test_run_may_end_while_a_module_starts():
    may_start = Event()
    modules = {"bright": ExactModule(), "dark": Slow(may_start=may_start)}
    drive(
        modules,
        scene_at=dark_from(20),
        confirm_window_s=0.5,
        is_live=True,
        feed=letting(may_start, 99),
    )
    assert modules["dark"].shutdowns == 1


def test_module_that_cannot_start_is_refused_when_that_is_known():
    modules = {"bright": ExactModule(), "dark": ExactModule(raises_on_activate=True)}
    _, atlas, log, _ = drive(modules, scene_at=dark_from(20), steps=300, is_live=True)
    by = list(atlas.pose_modules)  # bridged until the first module has started, beside the poses
    assert len(atlas.trajectory) == 300 and set(by[by.index("bright") :]) == {"bright"}
    assert "no licence" in events(log, "fault")[0]["what"]


def test_trial_that_cannot_start_is_logged_and_delays_the_next():
    class Once(ExactModule):
        """Can be started once."""

        def __init__(self, **options):
            super().__init__(**options)
            self.starts, self.has_failed = 0, Event()

        def activate(self, rig):
            self.starts += 1
            if self.starts > 1:
                self.has_failed.set()
                raise RuntimeError("no licence")
            super().activate(rig)

    bright, dark = Once(lost=range(20, 1000)), Slow()

    def feed(index):
        assert index != 30 or dark.has_started.wait(10.0)
        assert index != 150 or bright.has_failed.wait(10.0)
        return observation(index)

    modules = {"bright": bright, "dark": dark}
    _, _, log, _ = drive(modules, feed=feed, is_live=True, retry_s=5.0, steps=160)
    assert bright.starts == 2
    assert [event["what"] for event in events(log, "fault")] == [
        "slam.bright could not be activated: RuntimeError: no licence"
    ]


def test_trial_has_its_time_to_see_motion_after_a_slow_start():
    """It takes longer than `retry_s` to start, and then needs ten images."""
    answered, may_start, has_started, dark = [], Event(), Event(), Slow()

    class SlowAgain(ExactModule):
        def activate(self, rig):
            if self.activations:
                assert may_start.wait(10.0)
            super().activate(rig)
            if self.activations > 1:
                has_started.set()

        def track(self, observation):
            if self.activations > 1:
                answered.append(observation.stamp_ns)
                if len(answered) > 10:
                    self.lost.clear()
            return super().track(observation)

    def feed(index):
        assert index != 30 or dark.has_started.wait(10.0)
        if index == 100:
            may_start.set()
            assert has_started.wait(10.0)
        return observation(index)

    modules = {"bright": SlowAgain(lost=range(20, 1000)), "dark": dark}
    _, atlas, log, _ = drive(modules, feed=feed, is_live=True, retry_s=2.0, steps=160)
    assert [one["reason"] for one in events(log, "decision")] == ["first", "lost", "return"]
    assert atlas.pose_modules[-1] == "bright"
    assert_exact(atlas)


def test_map_is_saved_beside_the_pose_and_its_failure_is_told(tmp_path):
    may_save, told = Event(), []

    def save(hybrid, folder):
        may_save.wait(10.0)
        if folder.name == "full":
            raise OSError(28, "no room")

    def note(event, stamp_ns, **fields):
        told.append((event, stamp_ns, fields["what"], fields.get("why")))

    nothing = PointLayer(points=np.zeros((0, 3), np.float32))
    hybrid = HybridMap(points=nothing, point_modules=np.zeros(0, np.uint8), modules=())
    operator = Operator((), print, TABLE, save, tmp_path, note, executor("save", is_live=True))
    for name in ("floor", "full", "a/b"):
        operator.obey(SaveMap(name=name, hybrid=hybrid), 1)
    assert [one[2] for one in told] == ["a/b"]
    may_save.set()
    operator.close(7)
    assert told[1:] == [
        ("command", 7, "floor", None),
        ("command_refused", 7, "full", "OSError: [Errno 28] no room"),
    ]
