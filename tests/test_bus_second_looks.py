"""The bus: what was known a moment ago is not forgotten, and what is over is not carried out."""

from dataclasses import replace

import numpy as np
import pytest
from driving import GATE, TABLE, assert_exact, dark_from, drive, events, policy
from fakes import (
    PERIOD_NS,
    RIG,
    DepthModule,
    ExactModule,
    ScriptedDetector,
    observation,
    true_pose,
)
from test_acquittal import OPTIONS, Uncertain, frozen

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.bus import Bus
from sceneslam.bus.scene.scene_filter import WindowFilter
from sceneslam.storage.events import EventLog
from sceneslam.types import se3
from sceneslam.types.observation import SceneVote, TrackingStatus
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory

ALONE = {"Bright": ["bright"], "Dark": ["bright"]}


def decisions(log):
    return [
        (each["stamp_ns"] // PERIOD_NS, each["to"], each["reason"])
        for each in events(log, "decision")
    ]


class Certain(ExactModule):
    """Knows its motion; its covariance is `known`."""

    known = 1e-6 * np.eye(6)

    def track(self, observation):
        tracking = super().track(observation)
        if tracking.status is TrackingStatus.LOST:
            return tracking
        return replace(tracking, covariance=self.known, inliers=10)


class Jumping(Certain):
    """Corrects its past at 50; from 55 on it is 2 m off, without a word."""

    def track(self, observation):
        tracking, index = super().track(observation), observation.stamp_ns // PERIOD_NS
        off = se3.from_xy_yaw(2.0 if index >= 55 else 0.0, 0.0, 0.0)
        T_local_base = off @ tracking.T_local_base
        return replace(tracking, T_local_base=T_local_base, revision=int(index >= 50))


def test_a_covariance_that_is_not_positive_ends_no_run():
    module = Certain()
    module.known = 1e-3 * np.eye(6)
    module.known[0, 1] = module.known[1, 0] = -0.01
    _, atlas, _, _ = drive({"bright": module}, steps=60, table=ALONE, gate=GATE)
    assert len(atlas.trajectory) == 60


@pytest.mark.parametrize("is_lost", [True, False])
def test_an_earlier_correction_hides_no_later_jump(is_lost):
    """Between them it is lost, or has no image."""

    def feed(index):
        given = observation(index)
        return replace(given, image_bgr=None) if 51 <= index < 55 and not is_lost else given

    module = Jumping(lost=range(51, 55) if is_lost else ())
    options = {"handover": "rewind", "lost_patience_s": 1.0, "feed": feed}
    _, atlas, log, _ = drive({"bright": module}, table=ALONE, gate=GATE, **options)
    assert events(log, "suspect")[0]["stamp_ns"] // PERIOD_NS == 55
    off_m = atlas.trajectory.T_world_base[-1, :3, 3] - true_pose(99 * PERIOD_NS)[:3, 3]
    np.testing.assert_allclose(off_m, 0.0, atol=0.05)


def test_wheels_that_lie_do_not_place_a_fallback():
    """The wheels spin from 40 on; the module is lost from 60 on, its fallback tracks from 66 on."""

    def feed(index):
        spun = se3.from_xy_yaw(0.1 * max(index - 40, 0), 0.0, 0.0)
        return replace(observation(index), T_odom_base=spun @ true_pose(index * PERIOD_NS))

    modules = {"bright": Certain(lost=range(60, 1000)), "dark": Certain(lost=range(66))}
    _, atlas, log, _ = drive(
        modules, steps=110, gate=GATE, feed=feed, handover="rewind", lost_patience_s=1.0
    )
    believed = [each["stamp_ns"] // PERIOD_NS for each in events(log, "odometry")]
    assert 40 < believed[0] < 45 and min(believed[1:], default=66) >= 66
    off_m = atlas.trajectory.T_world_base[-1, :3, 3] - true_pose(109 * PERIOD_NS)[:3, 3]
    assert np.linalg.norm(off_m) < 0.2


def test_a_scene_that_is_over_changes_no_module():
    """Dark lasts for 3 s, and its module takes 6 s to start."""
    modules = {"bright": ExactModule(), "dark": ExactModule()}
    _, atlas, log, _ = drive(
        modules,
        steps=250,
        scene_at=lambda index: "Dark" if 40 <= index < 70 else "Bright",
        handover="rewind",
        startup_s={"dark": 6.0},
    )
    assert [to for _, to, _ in decisions(log)] == ["bright"]
    assert [(each["to"], each["why"]) for each in events(log, "refused")] == [
        ("dark", "the scene is over")
    ]
    assert modules["bright"].activations == 1 and set(atlas.pose_modules) == {"bright"}


def test_another_scene_with_the_same_module_does_not_stop_its_start(monkeypatch):
    monkeypatch.setattr(ScriptedDetector, "scenes", ("Bright", "Dark", "Dim"))
    modules = {"bright": ExactModule(), "dark": ExactModule()}
    _, _, log, _ = drive(
        modules,
        steps=150,
        table=TABLE | {"Dim": ["dark", "bright"]},
        scene_at=lambda index: "Bright" if index < 40 else ("Dark", "Dim")[index // 15 % 2],
        handover="rewind",
        confirm_window_s=1.0,
        startup_s={"dark": 3.0},
    )
    assert [to for _, to, _ in decisions(log)] == ["bright", "dark"]
    assert not events(log, "refused") and modules["dark"].activations == 1


@pytest.mark.parametrize("lost", [range(40, 55), range(40, 68)])
def test_a_loss_that_is_over_changes_no_module(lost):
    """The other module takes 4 s to start; the first one tracks again for 2.5 s, or 1.2 s, then."""
    modules = {"bright": ExactModule(lost=lost), "dark": ExactModule()}
    options = {"lost_patience_s": 1.0, "startup_s": {"dark": 3.0}}
    _, _, log, _ = drive(modules, steps=200, handover="rewind", **options)
    assert [to for _, to, _ in decisions(log)] == ["bright"]
    assert [each["why"] for each in events(log, "refused")] == ["the module tracks again"]
    assert modules["bright"].activations == 1


def test_a_module_that_the_new_scene_does_not_want_is_not_waited_for():
    """The first one is lost, its fallback takes 8 s to start, and it becomes dark."""
    modules = {"b": ExactModule(lost=range(40, 999)), "f": ExactModule(), "d": ExactModule()}
    _, _, log, _ = drive(
        modules,
        table={"Bright": ["b", "f"], "Dark": ["d"]},
        scene_at=lambda index: "Dark" if index >= 45 else "Bright",
        handover="rewind",
        startup_s={"f": 8.0},
        lost_patience_s=1.0,
    )
    (_, first, _), (at, second, why) = decisions(log)
    assert (first, second, why) == ("b", "d", "scene") and 65 <= at <= 67
    assert modules["f"].activations == 0


def test_the_first_module_is_that_of_the_scene_that_has_become():
    modules = {"b": ExactModule(), "d": ExactModule()}
    _, atlas, log, _ = drive(
        modules,
        table={"Bright": ["b"], "Dark": ["d"]},
        scene_at=lambda index: "Dark" if index >= 5 else "Bright",
        handover="rewind",
        startup_s={"b": 8.0},
    )
    assert [to for _, to, _ in decisions(log)] == ["d"]
    assert modules["b"].activations == 0 and "d" in atlas.pose_modules


@pytest.mark.parametrize(("handover", "window_s"), [("warm", 2.0), ("rewind", 0.5)])
def test_a_module_without_data_is_waited_for_beside_one_that_tracks(handover, window_s):
    modules = {"bright": ExactModule(), "dark": DepthModule()}
    _, _, log, _ = drive(
        modules,
        scene_at=lambda index: "Dark" if index >= 40 else "Bright",
        handover=handover,
        confirm_window_s=window_s,
        lost_patience_s=1.0,
    )
    assert [to for _, to, _ in decisions(log)] == ["bright"]
    assert [each["why"] for each in events(log, "refused")] == ["silent"]
    assert modules["bright"].activations == 1


class Revised(ExactModule):
    """It reports the path again at its end."""

    def __init__(self):
        super().__init__()
        self.said = []

    def track(self, observation):
        told = super().track(observation)
        self.said.append((observation.stamp_ns, told.T_local_base))
        return told

    def get_trajectory(self):
        stamps_ns, poses = zip(*self.said, strict=True)
        return Trajectory(stamps_ns=np.array(stamps_ns), T_world_base=np.stack(poses))


class Closing(Revised):
    """It drifts by 0.5 m in 12 s, and closes a loop at 150; it may tell the path at the end."""

    def __init__(self, *, tells):
        super().__init__()
        self.tells = tells

    def track(self, observation):
        told, index = super().track(observation), observation.stamp_ns // PERIOD_NS
        aside = se3.from_xy_yaw(0.0, min(index / 240, 0.5) if index < 150 else 0.0, 0.0)
        T_local_base = aside @ told.T_local_base
        return replace(told, T_local_base=T_local_base, revision=int(index >= 150))

    def get_trajectory(self):
        return super().get_trajectory() if self.tells else Trajectory.empty()


@pytest.mark.parametrize("tells", [True, False])
@pytest.mark.parametrize(("startup_s", "catch_up_steps"), [(0.0, None), (0.0, 2), (4.0, None)])
def test_a_loop_closed_after_the_scene_changed_is_kept_at_the_hand_over(
    tells, startup_s, catch_up_steps
):
    """Dark is confirmed at 158, or at 148, so that the loop is closed during the catch-up."""
    dark_at = 138 if catch_up_steps is None else 128
    _, atlas, log, _ = drive(
        {"bright": Closing(tells=tells), "dark": ExactModule()},
        scene_at=lambda index: "Dark" if index >= dark_at else "Bright",
        handover="rewind",
        steps=230,
        gate=GATE,
        startup_s={"dark": startup_s},
        catch_up_steps=catch_up_steps,
    )
    assert [to for _, to, _ in decisions(log)] == ["bright", "dark"]
    for path in (atlas.online, atlas.trajectory):
        off_m = path.T_world_base[-1, :3, 3] - true_pose(229 * PERIOD_NS)[:3, 3]
        assert np.linalg.norm(off_m) < 1e-6


def test_what_a_hand_over_reports_is_corrected_once(monkeypatch):
    """The loop is closed while dark catches up; a third module begins at one of dark's poses."""
    monkeypatch.setattr(ScriptedDetector, "scenes", ("Bright", "Dark", "Dim"))
    modules = {"bright": Closing(tells=True), "dark": Revised(), "third": ExactModule()}
    _, atlas, log, _ = drive(
        modules,
        table={"Bright": ["bright"], "Dark": ["dark"], "Dim": ["third"]},
        scene_at=lambda index: "Bright" if index < 132 else "Dark" if index < 143 else "Dim",
        handover="rewind",
        steps=180,
        catch_up_steps=2,
        confirm_window_s=1.0,
    )
    assert [to for _, to, _ in decisions(log)] == ["bright", "dark", "third"]
    assert_exact(atlas)


class JumpingLater(Closing):
    """It is 1 m off for 1.5 s soon after its loop."""

    def __init__(self, jumps_at):
        super().__init__(tells=True)
        self.jumps_at = jumps_at

    def track(self, observation):
        told, index = super().track(observation), observation.stamp_ns // PERIOD_NS
        aside = se3.from_xy_yaw(0.0, float(0 <= index - self.jumps_at < 15), 0.0)
        T_local_base = aside @ told.T_local_base
        return replace(told, T_local_base=T_local_base, covariance=1e-6 * np.eye(6))


@pytest.mark.parametrize("jumps_at", [150, 152, 155, 158])
def test_a_loop_closed_just_before_a_suspicion_is_applied_once(jumps_at):
    """Its poses are bridged from before the loop."""
    modules = {"bright": JumpingLater(jumps_at)}
    options = {"handover": "rewind", "gate": GATE, "table": ALONE, "lost_patience_s": 1.0}
    _, atlas, log, _ = drive(modules, steps=240, **options)
    assert len(events(log, "suspect")) == 1 and len(atlas.sessions) == 2
    assert_exact(atlas)


@pytest.mark.parametrize("dark_at", range(143, 147))
def test_a_hand_over_begins_at_a_pose_that_a_suspicion_replaces_meanwhile(dark_at):
    modules = {"bright": JumpingLater(152), "dark": ExactModule()}
    options = {"gate": GATE, "catch_up_steps": 2, "confirm_window_s": 0.5, "handover": "rewind"}
    _, atlas, log, _ = drive(modules, steps=180, scene_at=dark_from(dark_at), **options)
    assert len(events(log, "suspect")) == 1
    assert [to for _, to, _ in decisions(log)] == ["bright", "dark"]
    assert_exact(atlas)


def test_what_a_module_revises_of_replaced_poses_moves_no_other():
    """From where it becomes dark, the module errs by 25 cm/s; at the end it repairs that."""

    class Erring(Closing):
        def track(self, observation):
            told, index = super().track(observation), observation.stamp_ns // PERIOD_NS
            aside = se3.from_xy_yaw(0.0, 0.025 * max(index - 110, 0), 0.0)
            return replace(told, T_local_base=aside @ self.said[-1][1], revision=0)

    modules = {"bright": Erring(tells=True), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, steps=160, scene_at=dark_from(110), handover="rewind")
    assert [to for _, to, _ in decisions(log)] == ["bright", "dark"]
    assert_exact(atlas)


class Revising(ExactModule):
    """It says that it corrected its past: after a loss from 50 to 75, or at every observation."""

    def __init__(self, *, is_lost):
        super().__init__(lost=range(50, 75) if is_lost else ())
        self.is_lost = is_lost

    def track(self, observation):
        index = observation.stamp_ns // PERIOD_NS
        return replace(super().track(observation), revision=index // 60 if self.is_lost else index)


@pytest.mark.parametrize("is_lost", [True, False])
def test_a_motion_that_nothing_bridges_is_no_correction(is_lost):
    """Dark is confirmed at 76, but its module begins where it became dark."""
    _, atlas, log, _ = drive(
        {"bright": Revising(is_lost=is_lost), "dark": ExactModule()},
        scene_at=dark_from(56),
        rig=Rig(sensors=frozenset({Sensor.IMAGE})),
        handover="rewind",
        has_odometry=False,
        lost_patience_s=60.0,
    )
    assert [(at, to) for at, to, _ in decisions(log)] == [(0, "bright"), (76, "dark")]
    assert_exact(atlas)


def test_a_late_first_pose_without_odometry_continues_the_motion_that_was_known():
    modules = {"bright": ExactModule(), "dark": ExactModule(lost=range(56))}
    _, atlas, _, _ = drive(
        modules,
        scene_at=lambda index: "Dark" if index >= 40 else "Bright",
        handover="rewind",
        has_odometry=False,
    )
    off_m = atlas.trajectory.T_world_base[-1, :3, 3] - true_pose(99 * PERIOD_NS)[:3, 3]
    assert np.linalg.norm(off_m) < 1e-6
    assert np.sqrt(atlas.covariances(None)[-1][:3, :3].trace()) < 0.1


def test_a_gap_is_counted_from_the_first_pose_not_from_the_first_answer():
    modules = {"bright": ExactModule(lost=range(41, 999)), "dark": ExactModule(lost=range(56))}
    _, atlas, log, _ = drive(
        modules,
        scene_at=lambda index: "Dark" if index >= 40 else "Bright",
        handover="rewind",
        lost_patience_s=5.0,
    )
    assert np.diff(atlas.trajectory.stamps_ns).max() == PERIOD_NS
    assert events(log, "handover")[-1]["gap_s"] == pytest.approx(PERIOD_NS * 1e-9)


def test_wheels_that_slip_slowly_are_not_cleared_by_one_step():
    """They slip by 4 cm per step from 40 on; the second module tracks twice and is lost."""

    def feed(index):
        spun = se3.from_xy_yaw(0.04 * max(index - 40, 0), 0.0, 0.0)
        return replace(observation(index), T_odom_base=spun @ true_pose(index * PERIOD_NS))

    modules = {
        "bright": Certain(lost=range(60, 1000)),
        "dark": Certain(lost=[*range(61), *range(63, 80)]),
    }
    _, atlas, log, _ = drive(
        modules, steps=110, gate=GATE, feed=feed, handover="rewind", lost_patience_s=1.0
    )
    assert events(log, "odometry")[-1]["is_believed"] is False
    posed = (atlas.trajectory.stamps_ns // PERIOD_NS).tolist()
    assert posed[-1] == 109 and not {68, 79} & {*posed}
    assert_exact(atlas)


def test_one_observation_without_odometry_leaves_the_patience_as_it_is():
    modules = {"bright": ExactModule(lost=range(50, 55)), "dark": ExactModule()}

    def feed(index):
        return observation(index, has_odometry=index != 52)

    options = {"handover": "rewind", "lost_patience_s": 1.5}
    _, _, log, _ = drive(modules, feed=feed, **options)
    assert [to for _, to, _ in decisions(log)] == ["bright"]


def test_votes_rarer_than_the_window_confirm_a_scene():
    window = WindowFilter(window_s=1.0, first_window_s=0.0)
    scenes = ["Indoor"] * 6 + ["Outdoor"] * 4
    votes = [SceneVote(stamp_ns=k * 1_033_000_000, scene=one) for k, one in enumerate(scenes)]
    confirmed = [(k, found.scene) for k, vote in enumerate(votes) if (found := window.update(vote))]
    assert confirmed == [(0, "Indoor"), (7, "Outdoor")]


def test_acquitted_poses_do_not_carry_the_drift_of_before_the_module_was_placed():
    class Drifting(Uncertain):
        def track(self, observation):
            tracking = super().track(observation)
            is_lost = tracking.status is TrackingStatus.LOST
            return tracking if is_lost else replace(tracking, map_covariance=0.5 * np.eye(6))

    _, atlas, log, _ = drive({"bright": Drifting()}, feed=frozen(40), **OPTIONS)
    assert events(log, "suspect")
    assert atlas._path.of_maps()[:, 0, 0].max() < 0.1


def test_a_catch_up_holds_no_more_images_than_the_buffer():
    """Of two observations per new one, through 10 s that were buffered."""

    def images_mb(bus):
        held = [each.observation for each in bus._estimator._memory.after(-1)]
        handovers = [one.handover for one in bus._changeover._attempts if one.handover]
        held += [each.observation for handover in handovers for each in handover.trail]
        images = {id(each.image_bgr): each.image_bgr for each in held}
        return sum(image.nbytes for image in images.values() if image is not None) / 1e6

    peaks_mb = []

    class Detector(ScriptedDetector):
        def get_scene(self, observation):
            peaks_mb.append(images_mb(bus))
            return super().get_scene(observation)

    bus = Bus(
        detector=Detector(lambda index: "Dark" if index >= 150 else "Bright"),
        modules={"bright": ExactModule(), "dark": ExactModule()},
        scenes=TABLE,
        policy=policy(handover="rewind", buffer_mb=1.0, startup_s={"dark": 8.0}),
        rig=RIG,
        back_end=Atlas(voxel_m=0.05),
        log=EventLog(),
        catch_up_steps=2,
    )
    for index in range(400):
        image_bgr = np.zeros((100, 100, 3), np.uint8)
        bus.step(replace(observation(index), image_bgr=image_bgr))
    assert bus.active == "dark"
    assert 0.9 < max(peaks_mb) <= 1.0 + 0.03
