"""Horizons, bounds and medians of the bus, each on both sides of its limit."""

from dataclasses import replace
from types import SimpleNamespace

import hostile
import numpy as np
import pytest
from driving import dark_from, drive, events
from fakes import PERIOD_NS, RIG, ExactModule, observation

from sceneslam.bus.bridge import Bridge
from sceneslam.bus.changeover import Candidates
from sceneslam.bus.judging.gate import NOBODY, Gate, GateSettings, Judgement
from sceneslam.bus.judging.hold import Health, Hold
from sceneslam.bus.judging.recent import CovarianceMonitor, RecentMedian
from sceneslam.bus.judging.runner import Runner
from sceneslam.bus.judging.wheel_scale import WheelScale
from sceneslam.bus.session import ModuleSession
from sceneslam.executors import InStep
from sceneslam.storage.events import EventLog, log_uncertainty
from sceneslam.types import se3
from sceneslam.types.errors import ModuleError
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.rig import Wheels
from sceneslam.types.run import SessionStart

S = 10**9


def test_constant_velocity_ends_at_its_horizon_and_keeps_the_twist():
    def at(stamp_ns):
        return replace(observation(0, has_odometry=False), stamp_ns=stamp_ns)

    T_step = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.2]))
    bridge = Bridge(is_active=True)
    bridge.update(at(S), se3.identity())
    bridge.update(at(S + S // 5), T_step)
    end_ns = S + S // 5 + S // 2
    for stamp_ns, steps in ((S + 2 * S // 5, 2.0), (end_ns, 3.5)):
        expected = se3.exp(steps * se3.log(T_step))
        np.testing.assert_allclose(bridge.predict(at(stamp_ns), by_velocity=True), expected)
    assert bridge.copy().predict(at(end_ns + 1), by_velocity=True) is None
    assert bridge.predict(at(end_ns), by_velocity=False) is not None  # it is known by now


@pytest.mark.parametrize("kept", [4, 5])
def test_the_median_is_that_of_the_newest_values(kept):
    rng, median, given = np.random.default_rng(0), RecentMedian(kept, width=2), []
    for count in range(1, 14):
        given.append(rng.normal(size=2))
        median.add(given[-1])
        assert len(median) == min(count, kept)
        np.testing.assert_allclose(median.median, np.median(given[-kept:], axis=0))


def test_events_are_the_same_whether_they_are_packed_or_new():
    log, count = EventLog(), 2000
    for index in range(count):
        log.add("vote", index, value=float("nan") if index % 2 else 1.0)
        if index % 100 == 0:
            log.flush()
    stamps = [event["stamp_ns"] for event in log.events]
    assert stamps == list(range(count)) and log.events[1]["value"] is None
    for first in (0, 1, 511, 512, 513, 1023, 1024, 1025, 1536, 1999, 2000):
        assert [event["stamp_ns"] for event in log.since(first)] == stamps[first:]


def test_standard_deviations_of_a_handover_are_those_of_position_and_rotation():
    log, covariances = EventLog(), np.zeros((3, 6, 6))
    covariances[2] = np.diag([1.0, 4.0, 4.0, 0.04, 0.04, 0.01])
    log_uncertainty(log, [SessionStart(stamp_ns=5, session=1, module="b", row=2)], covariances)
    (event,) = log.events
    assert event["deviation_m"] == pytest.approx(3.0)
    assert event["deviation_rad"] == pytest.approx(0.3)


SIGMAS, WHEELS = 3.0, Wheels(drift_ratio=0.02, drift_rad_per_m=0.01)


def judged(T_local_base, T_odom_base, *, after_ns=S // 2, wheels=WHEELS):
    """Return the judgement of one motion, from the identity to the poses given."""
    gate = Gate(GateSettings(sigmas=SIGMAS), wheels)
    gate.update(0, T_local_base=np.eye(4), T_odom_base=np.eye(4))
    return gate.update(after_ns, T_local_base=T_local_base, T_odom_base=T_odom_base)


@pytest.mark.parametrize(("share", "is_wrong"), [(0.999, False), (1.001, True)])
@pytest.mark.parametrize("way_m", [0.0, 1.0, 4.0])
def test_the_bound_of_a_distance_grows_with_the_distance(way_m, share, is_wrong):
    apart_m = share * SIGMAS * (0.03 + 0.02 * way_m)
    told = se3.from_xy_yaw(way_m, 0.0, 0.0)
    found = judged(se3.from_xy_yaw(way_m + apart_m, 0.0, 0.0), told)
    assert found.is_wrong is is_wrong
    # No wrong scale explains half of the distance: then the turn is wrong, too.
    apart_m = share * (SIGMAS * 0.03 + 0.5 * way_m)
    found = judged(se3.from_xy_yaw(way_m + apart_m, 0.0, 0.0), told)
    assert found.turn_agrees is not is_wrong


@pytest.mark.parametrize(("share", "is_wrong"), [(0.999, False), (1.001, True)])
@pytest.mark.parametrize(("way_m", "turn_rad"), [(0.0, 0.0), (0.0, 0.5), (2.0, 0.5)])
def test_the_bound_of_a_turn_grows_with_turn_and_distance(way_m, turn_rad, share, is_wrong):
    apart_rad = share * SIGMAS * (0.0175 + 0.02 * turn_rad + 0.01 * way_m)
    found = judged(
        se3.from_xy_yaw(way_m, 0.0, turn_rad + apart_rad), se3.from_xy_yaw(way_m, 0.0, turn_rad)
    )
    assert found.is_wrong is is_wrong and found.turn_agrees is not is_wrong


def test_probation_ends_after_one_second():
    for after_ns, is_trusted in ((S - 1, False), (S, True)):
        found = judged(np.eye(4), np.eye(4), after_ns=after_ns)
        assert found.is_trusted is is_trusted and found.turn_agrees and not found.is_wrong


@pytest.mark.parametrize(("after_ns", "is_trusted"), [(S, False), (S + 1, True)])
def test_a_motion_that_nothing_has_checked_for_a_second_is_trusted(after_ns, is_trusted):
    assert judged(np.eye(4), None, after_ns=after_ns) == Judgement(is_trusted=is_trusted)


class Seen:
    """A module that tracks whatever holds an image, in place of a runner."""

    def can_use(self, observation):
        return observation.image_bgr is not None

    def skip(self, observation):
        assert not self.can_use(observation)

    def track(self, observation):
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=np.eye(4),
            status=TrackingStatus.TRACKING,
        )


def test_a_sensor_is_silent_after_two_of_its_periods():
    def asked(*seen_ns, silent_ns):
        hold = Hold(patience_ns=3 * S, gate=None)
        for stamp_ns in seen_ns:
            hold.ask(Seen(), replace(observation(0), stamp_ns=stamp_ns), NOBODY)
        hold.ask(Seen(), replace(observation(0), image_bgr=None, stamp_ns=silent_ns), NOBODY)
        return hold

    held = asked(0, S // 10, silent_ns=3 * S // 10)
    assert held.health is Health.HELD and held.is_held and held.unheld_since_ns is None
    silent = asked(0, S // 10, silent_ns=3 * S // 10 + 1)
    assert silent.health is Health.SILENT and not silent.is_held
    assert (silent.unheld_since_ns, silent.held_ns) == (3 * S // 10 + 1, S // 10)
    assert asked(0, silent_ns=6 * S).is_held and not asked(0, silent_ns=6 * S + 1).is_held
    after_a_gap = 0, S // 10, 2 * S
    assert asked(*after_a_gap, silent_ns=22 * S // 10).is_held
    assert not asked(*after_a_gap, silent_ns=22 * S // 10 + 1).is_held
    assert asked(*after_a_gap, 4 * S, silent_ns=7 * S).is_held  # it is that slow
    after_a_burst = 0, S // 10, 2 * S // 10, 2 * S // 10 + 1
    assert asked(*after_a_burst, silent_ns=4 * S // 10 + 1).is_held
    assert asked(silent_ns=5).unheld_since_ns == 5  # it never delivered anything


@pytest.mark.parametrize("method", ["set_pose", "set_scene", "track"])
def test_a_failed_module_has_answered_no_later_observation(method):
    module, hold = ExactModule(), Hold(patience_ns=S, gate=None)
    runner = Runner("bright", module, InStep())
    runner.start(RIG, "Bright")
    setattr(module, method, lambda _: hostile.throw("Exception"))
    session = ModuleSession(runner, hold, Bridge(is_active=True))
    session.advance(observation(0), by_velocity=True, witness=NOBODY)
    if method == "set_scene":
        with pytest.raises(ModuleError):
            runner.set_scene("Dark")
    assert session.health is Health.FAILED
    hold.ask = lambda *_: pytest.fail("it was asked")
    session.advance(observation(1), by_velocity=True, witness=NOBODY)
    assert session.tracking is None and hold.tracking is None
    assert hold.answer is None and not hold.is_trusted


def test_a_module_that_changes_the_matrix_it_is_given_does_not_move_its_frame():
    module = ExactModule()
    runner = Runner("bright", module, InStep())
    runner.start(RIG, "Bright")
    module.set_pose = lambda T_map_local: T_map_local.fill(7.0)
    runner.place(se3.identity())
    np.testing.assert_array_equal(runner.T_map_local, np.eye(4))


@pytest.mark.parametrize("row", [0, 2, 3, 5])
def test_a_pose_is_unusually_uncertain_from_twice_the_median_deviation_on(row):
    for factor, is_usual in ((1.999, True), (2.001, False)):
        monitor = CovarianceMonitor()
        usual = np.zeros((6, 6))
        usual[row, row] = 1e-4
        for _ in range(9):
            monitor.is_usual(usual)
        assert monitor.is_usual(factor**2 * usual) == is_usual
    assert CovarianceMonitor().is_usual(None)


def test_a_change_that_leaves_no_module_that_failed_does_not_change_the_wait():
    candidates = Candidates({"Bright": ["a", "b"]}, {}, 1.5, waits=True)
    candidates.postpone(0, is_in_vain=True)
    candidates.postpone(7 * S, is_in_vain=None)
    assert candidates.retry_ns == round((7 + 3.0) * 1e9)


def test_the_wait_for_the_first_choice_doubles_three_times():
    candidates = Candidates({"Bright": ["a", "b"]}, {}, 1.5, waits=True)
    for seconds in (3.0, 6.0, 12.0, 12.0):
        candidates.postpone(7 * S, is_in_vain=True)
        assert candidates.retry_ns == round((7 + seconds) * 1e9)
    candidates.postpone(7 * S, is_in_vain=False)
    assert candidates.retry_ns == round(8.5 * 1e9)


@pytest.mark.parametrize(("along_m", "is_learnt"), [(0.003, True), (0.5, False)])
def test_only_the_uncertainty_along_the_motion_hides_the_scale_of_wheels(along_m, is_learnt):
    """The robot moves at 30 degrees to its x axis, and is uncertain along this or across it."""
    across_m = 0.503 - along_m
    R = se3.from_xy_yaw(0.0, 0.0, np.pi / 6)[:3, :3]
    covariance = np.eye(6) * 1e-6
    covariance[:3, :3] = R @ np.diag([along_m**2, across_m**2, across_m**2]) @ R.T
    scale, hold = (
        WheelScale(deviation=0.02, limit=0.03),
        SimpleNamespace(is_trusted=True, held_since_ns=0),
    )
    known = {"status": TrackingStatus.TRACKING, "covariance": covariance, "inliers": 100}
    for index in range(161):
        ahead = R @ [0.05 * index, 0.0, 0.0]
        T_local_base = se3.from_xy_yaw(*ahead[:2], 0.0)
        hold.tracking = Tracking(stamp_ns=index, T_local_base=T_local_base, **known)
        scale.learn(hold, se3.from_xy_yaw(*(1.02 * ahead[:2]), 0.0), 0.0)
    expected = 1 / 1.02 if is_learnt else 1.0
    assert scale.scale == pytest.approx(expected, abs=0.004)


def test_every_change_of_status_is_logged_once():
    _, _, log, _ = drive({"bright": ExactModule(lost={50, 51}), "dark": ExactModule()})
    told = [(event["stamp_ns"] // PERIOD_NS, event["status"]) for event in events(log, "tracking")]
    assert told == [(0, "tracking"), (50, "lost"), (52, "tracking")]


def test_a_module_that_leaves_nothing_is_named_once():
    leaves = hostile.Leaves(layers="text", trajectory="a list")
    _, _, log, _ = drive({"bright": leaves, "dark": ExactModule()}, scene_at=dark_from(20))
    (fault,) = events(log, "fault")
    assert "get_map" in fault["what"] and "could not give its map" in fault["what"]


class Clock:
    """Time that passes only where the test says so."""

    def __init__(self):
        self.ns = 0

    def __call__(self):
        return self.ns

    def spend(self, ms):
        self.ns += round(ms * 1e6)


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    for module in ("bus", "handover", "judging.runner", "scene.watch"):
        monkeypatch.setattr(f"sceneslam.bus.{module}.perf_counter_ns", clock)
    return clock


class Costly(ExactModule):
    """A start takes 40 ms, an observation 5 ms, the end 70 ms."""

    def __init__(self, clock):
        super().__init__()
        self._clock = clock

    def activate(self, rig):
        self._clock.spend(40)
        super().activate(rig)

    def track(self, observation):
        self._clock.spend(5)
        return super().track(observation)

    def shutdown(self):
        self._clock.spend(70)
        super().shutdown()


def test_the_time_of_the_bus_is_without_that_of_modules_and_detector(clock):
    def scene_at(index):
        clock.spend(3)
        return "Dark" if index >= 20 else "Bright"

    modules = {key: Costly(clock) for key in ("bright", "dark")}
    clock.spend(1000)
    bus, _, log, _ = drive(
        modules, steps=50, scene_at=scene_at, handover="rewind", confirm_window_s=1.0
    )
    assert list(bus.detector_us) == [3000.0] * 50
    assert list(bus.bus_us) == [0.0] * 50
    # The first module is started at 0; the second at 30, where the scene since 20 is confirmed.
    bright, dark = bus.runners["bright"], bus.runners["dark"]
    assert list(bright.track_ms) == [5.0] * 31 and list(dark.track_ms) == [5.0] * (11 + 19)
    assert bright.start_ns == dark.start_ns == 40_000_000
    assert bright.spent_ns == 40_000_000 + 31 * 5_000_000 + 70_000_000
    first, second = events(log, "cost")
    assert (first["handover_ms"], first["first_pose_ms"], first["catch_up_s"]) == (45, 45, 0)
    assert second["handover_ms"] == 40 + 11 * 5 and second["first_pose_ms"] == 40 + 5
    assert second["catch_up_s"] == 10 * PERIOD_NS / 1e9
