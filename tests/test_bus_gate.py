"""A module that moves otherwise than the robot does no harm, and is taken back when it agrees."""

from dataclasses import replace

import numpy as np
import pytest
from driving import GATE, dark_from, drive, events, policy
from fakes import PERIOD_NS, RIG, TWIST, ExactModule, observation, true_pose

from sceneslam.bus.decision import Action, Situation, StandbyTrial, decide
from sceneslam.bus.judging.hold import Health
from sceneslam.types import se3
from sceneslam.types.rig import Sensor
from sceneslam.types.run import BRIDGED

ONE = {"Bright": ["bright"], "Dark": ["bright"]}


class Sliding(ExactModule):
    """Says that it tracks, but slides sideways at 1 m/s from one index to another."""

    def __init__(self, first, last):
        super().__init__()
        self.first, self.last = first, last

    def track(self, observation):
        tracking = super().track(observation)
        index = observation.stamp_ns // PERIOD_NS
        slid_m = 0.1 * (min(max(index, self.first), self.last) - self.first)
        shift = se3.from_xy_yaw(0.0, slid_m, 0.0)
        return replace(tracking, T_local_base=shift @ tracking.T_local_base)


def errors_m(trajectory):
    T_first = true_pose(int(trajectory.stamps_ns[0]))
    true = np.stack([se3.inverse(T_first) @ true_pose(ns) for ns in trajectory.stamps_ns.tolist()])
    return np.linalg.norm(true[:, :3, 3] - trajectory.positions_m, axis=1)


def test_sliding_module_is_bridged_from_before_it_slid_and_chained_when_it_agrees():
    modules = {"bright": Sliding(40, 60)}
    _, atlas, log, _ = drive(modules, steps=150, table=ONE, gate=GATE, handover="rewind")
    assert errors_m(atlas.trajectory).max() < 1e-9  # odometry is exact here
    assert 0.05 < errors_m(atlas.online).max() < 0.5  # what was told until it was noticed
    assert len(events(log, "suspect")) == 1
    assert set(atlas.pose_modules[40:70]) == {BRIDGED} and atlas.pose_modules[-1] == "bright"
    assert [session.module for session in atlas.sessions] == ["bright", "bright"]


@pytest.mark.parametrize("index", [39, 41])
def test_suspicion_costs_no_pose_where_odometry_is_missing(index):
    def feed(i):
        return observation(i, has_odometry=i != index)

    modules = {"bright": Sliding(40, 60)}
    options = {"steps": 150, "table": ONE, "gate": GATE, "handover": "rewind", "feed": feed}
    _, atlas, log, _ = drive(modules, **options)
    assert len(events(log, "suspect")) == 1 and atlas.pose_modules[index] == BRIDGED
    assert len(atlas.trajectory) == 150 and errors_m(atlas.trajectory).max() < 1e-9


def test_a_module_that_slides_in_what_it_catches_up_on_is_bridged_from_before_it_slid():
    """It starts for six seconds, and slides in what it gets after that."""
    modules = {"bright": ExactModule(lost=range(30, 1000)), "dark": Sliding(50, 70)}
    options = {"steps": 200, "gate": GATE, "handover": "rewind", "startup_s": {"dark": 6.0}}
    _, atlas, log, _ = drive(modules, **options)
    assert events(log, "handover")[-1]["stamp_ns"] > 80 * PERIOD_NS
    assert atlas.pose_modules[-1] == "dark" and BRIDGED in atlas.pose_modules[45:75]
    assert len(atlas.trajectory) == 200 and errors_m(atlas.trajectory).max() < 1e-9


def test_sliding_module_without_the_gate_does_harm():
    _, atlas, _, _ = drive({"bright": Sliding(40, 60)}, steps=150, table=ONE)
    assert errors_m(atlas.trajectory).max() > 1.9


def test_module_that_keeps_sliding_is_replaced():
    modules = {"bright": Sliding(40, 1000), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, gate=GATE, handover="rewind")
    decision = events(log, "decision")[1]
    assert (decision["to"], decision["reason"]) == ("dark", "suspect")
    assert errors_m(atlas.trajectory).max() < 1e-9 and atlas.pose_modules[-1] == "dark"


@pytest.mark.parametrize("after", ["tracks", "lost", "silent", "raises"])
def test_suspicion_is_logged_once_whatever_the_module_does_next(after):
    class Jumping(ExactModule):
        """Is off by a metre at index 40 alone."""

        def track(self, observation):
            tracking = super().track(observation)
            shift = se3.from_xy_yaw(float(observation.stamp_ns == 40 * PERIOD_NS), 0.0, 0.0)
            return replace(tracking, T_local_base=shift @ tracking.T_local_base)

    def feed(index):
        is_blind = after == "silent" and 40 < index < 45
        return replace(observation(index), image_bgr=None) if is_blind else observation(index)

    modules = {
        "bright": Jumping(**{after: range(41, 45)} if after in ("lost", "raises") else {}),
        "dark": ExactModule(),
    }
    startup_s = {"dark": 2.0}  # the failed module stays for so long
    _, atlas, log, _ = drive(modules, gate=GATE, feed=feed, handover="rewind", startup_s=startup_s)
    assert [event["stamp_ns"] for event in events(log, "suspect")] == [40 * PERIOD_NS]
    assert len(atlas.trajectory) == 100 and errors_m(atlas.trajectory).max() < 1e-9


def test_candidate_that_slides_is_refused_while_the_old_module_holds():
    modules = {"bright": ExactModule(), "dark": Sliding(10, 1000)}
    _, atlas, log, _ = drive(
        modules,
        gate=GATE,
        handover="rewind",
        scene_at=lambda index: "Dark" if index >= 40 else "Bright",
    )
    assert events(log, "refused")[0]["to"] == "dark"
    assert set(atlas.pose_modules) == {"bright"}


class Certain(ExactModule):
    """States that it is certain, and moves so many times as far as the robot does."""

    def __init__(self, ratio, requires=ExactModule.requires):
        super().__init__()
        self.ratio, self.requires = ratio, requires

    def track(self, observation):
        tracking = super().track(observation)
        T_local_base = tracking.T_local_base.copy()
        T_local_base[:3, 3] *= self.ratio
        return replace(tracking, T_local_base=T_local_base, covariance=1e-6 * np.eye(6))


BY_WHEELS = (frozenset({Sensor.ODOMETRY}),)
SCALED = (frozenset({Sensor.IMAGE, Sensor.DEPTH}), frozenset({Sensor.IMAGE, Sensor.ODOMETRY}))


@pytest.mark.parametrize(
    ("requires", "is_refused"), [(ExactModule.requires, True), (BY_WHEELS, False), (SCALED, False)]
)
def test_a_certain_candidate_is_refused_where_wheels_and_the_old_module_agree(requires, is_refused):
    """A module that needs wheels, here where there is no depth, is no witness for them."""
    modules = {"bright": Certain(1.0, requires), "dark": Certain(1.5)}
    dark = dark_from(40)
    _, atlas, log, _ = drive(modules, steps=65, gate=GATE, handover="rewind", scene_at=dark)
    assert bool(events(log, "refused")) is is_refused
    assert (atlas.pose_modules[-1] == "bright") is is_refused


@pytest.mark.parametrize("lost", [range(0), range(50, 51), range(48, 53)])
def test_jump_that_the_module_announces_is_a_correction_and_not_a_motion(lost):
    class Closing(ExactModule):
        def track(self, observation):
            tracking = super().track(observation)
            if observation.stamp_ns < 50 * PERIOD_NS:
                return tracking
            shift = se3.from_xy_yaw(0.5, 0.0, 0.0)
            return replace(tracking, T_local_base=shift @ tracking.T_local_base, revision=1)

    modules = {"bright": Closing(lost=lost)}
    _, atlas, log, _ = drive(modules, table=ONE, gate=GATE, handover="rewind")
    assert not events(log, "suspect") and atlas.pose_modules.count(BRIDGED) == len(lost)
    np.testing.assert_allclose(errors_m(atlas.trajectory)[53:], 0.5, atol=1e-9)


def test_map_begins_with_the_odometry_where_the_module_holds_its_pose_later():
    bright = ExactModule(lost=range(30))
    _, atlas, _, _ = drive({"bright": bright}, table=ONE, gate=GATE, handover="rewind")
    assert len(atlas.trajectory) == 100 and errors_m(atlas.trajectory).max() < 1e-9
    assert atlas.pose_modules[0] == BRIDGED and atlas.pose_modules[-1] == "bright"


def slipping(has_gyro):
    """The robot, one of whose wheels slips from index 50 to 54; the gyro does not turn with it."""
    times_s = np.linspace(-PERIOD_NS / 1e9 + 0.01, 0.0, 10)
    gyro = np.column_stack([times_s, np.tile(TWIST[3:], (10, 1))]) if has_gyro else None
    T_odom_base = se3.identity()
    for index in range(100):
        yield replace(observation(index), T_odom_base=T_odom_base, gyro_base=gyro)
        slip = se3.from_xy_yaw(0.0, 0.0, 0.03 if 50 <= index < 55 else 0.0)
        T_odom_base = T_odom_base @ true_pose(PERIOD_NS) @ slip


@pytest.mark.parametrize("has_gyro", [True, False])
def test_a_wheel_that_slips_is_not_believed_against_gyro_and_module(has_gyro):
    sensors = RIG.sensors | {Sensor.GYRO} if has_gyro else RIG.sensors
    feed = list(slipping(has_gyro))
    _, atlas, log, _ = drive(
        {"bright": ExactModule()},
        table=ONE,
        gate=GATE,
        handover="rewind",
        rig=replace(RIG, sensors=sensors),
        feed=lambda index: feed[index],
    )
    assert bool(events(log, "suspect")) == (not has_gyro)  # without, wheels are the only witness
    assert (BRIDGED in atlas.pose_modules) == (not has_gyro)


def test_two_that_the_wheels_contradict_do_not_take_turns():
    def suspect(**more):
        return Situation(
            stamp_ns=20 * 10**9,
            scene="Bright",
            served_scene="Bright",
            active="dark",
            health=Health.SUSPECT,
            unheld_since_ns=10 * 10**9,
            held_ns=9 * 10**9,
            is_blind=False,
            choices=("bright", "dark"),
            served_choices=("bright", "dark"),
            tried=frozenset({"bright"}),
            rounds=0,
            trial=StandbyTrial.NONE,
            may_return=True,
            **more,
        )

    assert decide(policy(), suspect(retry_ns=21 * 10**9)).action is Action.GO_ON
    assert decide(policy(), suspect(retry_ns=19 * 10**9)).to == ("bright",)
