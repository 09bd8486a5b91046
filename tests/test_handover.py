"""Hand-overs: in the past, after a slow start, on trial; and what they leave alone."""

from dataclasses import replace

import numpy as np
import pytest
from driving import assert_exact, dark_from, drive, events, policy
from fakes import PERIOD_NS, DepthModule, ExactModule, observation, true_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneslam.decisions import decide_again
from sceneslam.types import se3
from sceneslam.types.rig import Sensor
from sceneslam.types.run import BRIDGED

SLIP = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.01]))


def slipping(index):
    """Odometry that is off by some centimetres from step to step."""
    T_odom_base = true_pose(index * PERIOD_NS)
    for _ in range(index):
        T_odom_base = T_odom_base @ SLIP
    return replace(observation(index), T_odom_base=T_odom_base)


def errors_m(trajectory):
    T_first = true_pose(int(trajectory.stamps_ns[0]))
    true = np.stack([se3.inverse(T_first) @ true_pose(ns) for ns in trajectory.stamps_ns.tolist()])
    return np.linalg.norm(true[:, :3, 3] - trajectory.positions_m, axis=1)


class Astray(ExactModule):
    """Keeps saying that it tracks, but is off by more and more from an index on."""

    def __init__(self, since):
        super().__init__()
        self.since = since

    def track(self, observation):
        tracking = super().track(observation)
        off = max(0, observation.stamp_ns // PERIOD_NS - self.since)
        shift = se3.from_xy_yaw(0.05 * off, 0.0, 0.0)
        return replace(tracking, T_local_base=tracking.T_local_base @ shift)


def test_rewind_replaces_what_was_bridged_since_the_last_trusted_pose():
    bright = ExactModule(lost=range(50, 200))
    _, atlas, log, _ = drive(
        {"bright": bright, "dark": ExactModule()}, feed=slipping, handover="rewind"
    )
    assert_exact(atlas)
    assert BRIDGED not in atlas.pose_modules and len(atlas.trajectory) == 100
    online_m = errors_m(atlas.online)
    assert online_m[50:53].max() > 0.02  # told at the time, and said to be revised
    assert online_m[53] < 1e-9  # the new module's, as it was published
    revised = events(log, "revised")[-1]
    T_odom_last, T_odom_now = (slipping(index).T_odom_base for index in (49, 53))
    T_true_last, T_true_now = (true_pose(index * PERIOD_NS) for index in (49, 53))
    T_true_bridged = se3.inverse(T_true_now) @ T_true_last @ se3.inverse(T_odom_last) @ T_odom_now
    jump_m = np.linalg.norm(T_true_bridged[:3, 3])
    assert events(log, "handover")[1]["jump_m"] == pytest.approx(jump_m)
    assert revised["from_ns"] == 50 * PERIOD_NS and revised["poses"] == 4
    assert events(log, "handover")[1]["gap_s"] == 0.0


def test_rewind_begins_where_the_new_scene_did():
    """The old module goes astray when the scene changes, two seconds before that is confirmed."""
    _, atlas, log, _ = drive(
        {"bright": Astray(40), "dark": ExactModule()}, scene_at=dark_from(40), handover="rewind"
    )
    assert_exact(atlas)
    assert atlas.pose_modules[40:42] == ("bright", "dark")
    assert events(log, "decision")[1]["stamp_ns"] == 60 * PERIOD_NS


def test_online_trajectory_is_what_was_known_at_the_time():
    modules = {"bright": Astray(40), "dark": ExactModule()}
    _, atlas, _, _ = drive(modules, scene_at=dark_from(40), handover="rewind")
    expected = 0.05 * np.arange(20)
    np.testing.assert_allclose(errors_m(atlas.online)[40:60], expected, atol=1e-9)
    assert errors_m(atlas.online)[60:].max() < 1e-9  # the hand-over's own pose too


@pytest.mark.parametrize("lost_s", [0, 1, 2])
@pytest.mark.parametrize("startup_s", [0.0, 1.0, 8.0])
def test_rewind_has_no_gap_however_long_the_start_takes(startup_s, lost_s):
    bright = ExactModule(lost=range(60 - 10 * lost_s, 500)) if lost_s else ExactModule()
    _, atlas, log, _ = drive(
        {"bright": bright, "dark": ExactModule()},
        steps=200,
        scene_at=dark_from(40),
        feed=slipping,
        handover="rewind",
        lost_patience_s=100.0,
        startup_s={"dark": startup_s},
    )
    assert len(atlas.trajectory) == 200
    assert_exact(atlas)
    decision = events(log, "decision")[1]
    assert decision["stamp_ns"] - decision["decided_ns"] == startup_s * 1e9


def test_cold_loses_the_motion_of_the_start():
    _, atlas, log, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule()},
        scene_at=dark_from(10),
        handover="cold",
        startup_s={"dark": 2.0},
    )
    gap = np.diff(atlas.trajectory.stamps_ns).argmax()
    assert np.diff(atlas.trajectory.stamps_ns)[gap] == 2e9
    np.testing.assert_allclose(*atlas.trajectory.T_world_base[[gap, gap + 1]], atol=1e-12)
    assert events(log, "handover")[1]["gap_s"] == 2.0
    assert events(log, "decision")[1]["from"] == "bright"


def test_cold_hands_over_the_last_pose_of_a_lost_module():
    bright = ExactModule(lost=range(50, 200))
    _, atlas, _, _ = drive({"bright": bright, "dark": ExactModule()}, handover="cold")
    assert BRIDGED not in atlas.pose_modules
    after = list(atlas.pose_modules).index("dark")
    np.testing.assert_allclose(*atlas.trajectory.T_world_base[[after - 1, after]], atol=1e-12)


def test_warm_waits_for_a_module_that_is_still_loading():
    _, atlas, log, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule()},
        scene_at=dark_from(10),
        handover="warm",
        startup_s={"dark": 5.0},
    )
    assert events(log, "decision")[1]["stamp_ns"] == 50 * PERIOD_NS
    assert atlas.pose_modules[49:52] == ("bright", "bright", "dark")
    assert_exact(atlas)


def test_catching_up_bit_by_bit_gives_the_same_trajectory():
    def run(steps):
        modules = {"bright": Astray(40), "dark": ExactModule()}
        options = {"scene_at": dark_from(40), "handover": "rewind", "catch_up_steps": steps}
        return drive(modules, **options)[1:3]

    (atlas, log), (slow, slow_log) = run(None), run(3)
    np.testing.assert_array_equal(atlas.trajectory.T_world_base, slow.trajectory.T_world_base)
    assert atlas.pose_modules == slow.pose_modules
    late_ns = events(slow_log, "decision")[1]["stamp_ns"] - events(log, "decision")[1]["stamp_ns"]
    assert late_ns == 9 * PERIOD_NS  # 21 moments, three at a time, while one more comes each time


def test_a_pause_while_a_module_catches_up_costs_no_pose():
    """It is longer than observations are remembered."""

    def feed(index):
        return observation(index if index < 63 else index + 100)

    modules = {"bright": ExactModule(), "dark": ExactModule()}
    options = {"scene_at": dark_from(40), "handover": "rewind", "buffer_s": 5.0, "feed": feed}
    _, atlas, log, _ = drive(modules, catch_up_steps=3, **options)
    assert events(log, "decision")[1]["stamp_ns"] > 163 * PERIOD_NS
    assert len(atlas.trajectory) == 100 and atlas.pose_modules[-1] == "dark"
    assert_exact(atlas)


def test_module_that_is_lost_does_not_replace_one_that_holds():
    modules = {"bright": ExactModule(), "dark": ExactModule(lost=range(1000))}
    _, atlas, log, _ = drive(modules, scene_at=dark_from(40), handover="rewind")
    assert set(atlas.pose_modules) == {"bright"}
    assert events(log, "refused")[0]["why"] == "lost"
    assert_exact(atlas)


def test_module_without_data_does_not_replace_one_that_holds():
    modules = {"bright": ExactModule(), "dark": DepthModule()}
    _, atlas, log, _ = drive(modules, scene_at=dark_from(40), handover="rewind")
    assert set(atlas.pose_modules) == {"bright"} and modules["bright"].activations == 1
    assert events(log, "refused")[0]["why"] == "silent"


def test_module_that_is_lost_replaces_one_that_failed():
    modules = {"bright": ExactModule(raises={50}), "dark": ExactModule(lost={70})}
    _, atlas, log, _ = drive(modules, handover="rewind", startup_s={"dark": 2.0})
    assert not events(log, "refused") and modules["dark"].activations == 1
    (failed,) = (each for each in events(log, "situation") if each["health"] == "failed")
    assert failed["held_ns"] == failed["unheld_since_ns"] == 50 * PERIOD_NS
    assert_exact(atlas)


def test_poses_told_at_the_time_are_kept_where_nothing_better_is_known():
    """The new module is lost for a second in the past; there is no odometry, the old one held."""
    modules = {"bright": ExactModule(), "dark": ExactModule(lost=range(45, 58))}
    options = {"scene_at": dark_from(40), "handover": "rewind", "has_odometry": False}
    _, atlas, _, _ = drive(modules, **options)
    assert len(atlas.trajectory) == 100
    assert atlas.pose_modules[44:46] == ("dark", BRIDGED)
    assert_exact(atlas)


def test_poses_that_the_module_was_unusually_unsure_of_are_not_handed_over():
    class Fading(ExactModule):
        """Errs, and says so, for the last 10 images before it is lost."""

        def track(self, observation):
            tracking = super().track(observation)
            off = max(0, observation.stamp_ns // PERIOD_NS - 40)
            shift = se3.from_xy_yaw(0.02 * off, 0.0, 0.0)
            T_local_base = tracking.T_local_base @ shift
            covariance = (0.01 + 0.1 * off) ** 2 * np.eye(6)
            return replace(tracking, T_local_base=T_local_base, covariance=covariance)

    modules = {"bright": Fading(lost=range(50, 200)), "dark": ExactModule()}
    _, atlas, _, _ = drive(modules, handover="rewind", has_odometry=False)
    assert_exact(atlas)
    assert atlas.pose_modules[40:42] == ("bright", "dark")


def test_first_choice_comes_back_when_it_holds_beside_the_fallback():
    bright = ExactModule(lost=range(50, 70))
    _, atlas, log, _ = drive(
        {"bright": bright, "dark": ExactModule()}, handover="rewind", retry_s=2.0
    )
    back = events(log, "decision")[2]
    assert (back["to"], back["reason"]) == ("bright", "return")
    assert back["stamp_ns"] == (53 + 20 + 10) * PERIOD_NS
    assert atlas.pose_modules[82:85] == ("dark", "dark", "bright")
    assert_exact(atlas)


@pytest.mark.parametrize(("patience_s", "reason"), [(0.3, "lost"), (2.0, "return")])
def test_first_choice_takes_over_from_its_trial_where_the_fallback_is_lost(patience_s, reason):
    """It tracks from 73 on, so that it passes at 83; the fallback is lost at 78."""
    bright, dark = ExactModule(lost=range(30, 73)), ExactModule(lost=range(78, 200))
    options = {"handover": "rewind", "retry_s": 2.0, "lost_patience_s": patience_s}
    _, atlas, log, _ = drive({"bright": bright, "dark": dark}, **options)
    back = events(log, "decision")[2]
    assert (back["to"], back["reason"]) == ("bright", reason)
    assert back["stamp_ns"] == (81 if reason == "lost" else 83) * PERIOD_NS
    assert bright.activations == 2 and len(atlas.trajectory) == 100
    assert_exact(atlas)


def test_motion_that_nobody_knew_is_counted_where_a_trial_ends_it():
    """Without wheels a velocity is kept for 0.5 s; the fallback is lost for 0.9 s."""
    bright, dark = ExactModule(lost=range(30, 85)), ExactModule(lost=range(86, 200))
    modules = {"bright": bright, "dark": dark}  # a tenth of the patience without wheels: until 60
    options = {"handover": "rewind", "retry_s": 2.0, "lost_patience_s": 30.0, "steps": 120}
    _, atlas, log, _ = drive(modules, has_odometry=False, **options)
    assert events(log, "decision")[-1]["reason"] == "return"
    row = atlas.session_starts()[2].row
    gap_s = np.diff(atlas.trajectory.stamps_ns).max() / 1e9
    assert gap_s > 0.3
    sigmas = np.sqrt(np.diagonal(atlas.covariances(None), axis1=1, axis2=2))
    assert sigmas[row - 1].max() < 0.5 and (sigmas[row:, :3] > 0.9 * gap_s).all()


def test_a_trial_that_a_new_scene_cuts_short_was_not_in_vain():
    """It begins at 53; at 60 the new scene is confirmed."""
    modules = {"bright": ExactModule(lost=range(30, 200)), "dark": ExactModule()}
    modules["third"] = ExactModule()
    table = {"Bright": ["bright", "dark"], "Dark": ["third"]}
    options = {"scene_at": dark_from(40), "handover": "rewind", "retry_s": 2.0}
    _, _, log, _ = drive(modules, table=table, **options)
    assert [one["stamp_ns"] // PERIOD_NS for one in events(log, "decision")] == [0, 33, 60]
    tried = [one for one in events(log, "situation") if one["trial"] == "running"]
    assert tried and events(log, "situation")[-1]["retry_ns"] == 80 * PERIOD_NS


def test_first_choice_that_cannot_be_placed_after_its_trial_is_refused():
    class Unplaceable(ExactModule):
        """Can be placed at its start and for its trial, and not when it returns."""

        def __init__(self, **options):
            super().__init__(**options)
            self._places_left = 2

        def set_pose(self, T_map_local):
            if not self._places_left:
                raise RuntimeError("no map")
            self._places_left -= 1

    modules = {"bright": Unplaceable(lost=range(50, 70)), "dark": ExactModule()}
    _, atlas, log, _ = drive(modules, handover="rewind", retry_s=2.0)
    (fault,), (refused,) = events(log, "fault"), events(log, "refused")
    assert fault["what"] == "slam.bright could not be placed: RuntimeError: no map"
    assert (refused["to"], refused["reason"], refused["why"]) == ("bright", "return", "failed")
    assert fault["stamp_ns"] == refused["stamp_ns"] == 83 * PERIOD_NS
    assert set(atlas.pose_modules[53:]) == {"dark"} and len(atlas.trajectory) == 100
    assert_exact(atlas)


@pytest.mark.parametrize("slow", ["bright", "dark"])
def test_first_choice_comes_back_without_a_gap_or_a_jump_where_a_sensor_is_slow(slow):
    class Slow(ExactModule):
        requires = (frozenset({Sensor.POINTS}),)

    def feed(index):
        points = None if index % 3 else np.zeros((1, 3), np.float32)
        return replace(observation(index), points_lidar=points)

    kinds = {"bright": ExactModule, "dark": ExactModule} | {slow: Slow}
    modules = {"bright": kinds["bright"](lost=range(50, 70)), "dark": kinds["dark"]()}
    _, atlas, log, _ = drive(modules, feed=feed, steps=150, handover="rewind", retry_s=2.0)
    assert [event["reason"] for event in events(log, "decision")] == ["first", "lost", "return"]
    assert len(atlas.trajectory) == 150
    assert_exact(atlas)


def test_vain_trials_become_rare():
    bright = ExactModule(lost=range(50, 5000))
    _, _, log, _ = drive(
        {"bright": bright, "dark": ExactModule()}, steps=1000, handover="rewind", retry_s=1.0
    )
    assert len(events(log, "decision")) == 2
    assert bright.activations <= 14  # 1 + after 1, 2, 4, and then every 8 s, each given 1 s


def test_modules_that_are_all_lost_are_tried_at_a_steady_pace_in_the_end():
    lost = range(50, 5000)
    modules = {"bright": ExactModule(lost=lost), "dark": ExactModule(lost=lost)}
    options = {"handover": "rewind", "confirm_window_s": 0.5, "retry_s": 1.0, "buffer_s": 3.0}
    _, _, log, _ = drive(modules, steps=600, **options)
    waits_s = np.diff([one["stamp_ns"] / 1e9 for one in events(log, "decision")[1:]])
    np.testing.assert_allclose(waits_s, [0.5, 1.0, 2.0, *[4.0] * (len(waits_s) - 3)])
    assert len(waits_s) > 10


def test_trial_ends_where_the_fallback_becomes_the_first_choice():
    modules = {"bright": ExactModule(lost=range(30, 60)), "dark": ExactModule()}
    table = {"Bright": ["bright", "dark"], "Dark": ["dark"]}
    options = {"scene_at": dark_from(50), "handover": "rewind", "retry_s": 2.0}
    bus, _, _, _ = drive(modules, table=table, **options)
    # It is on trial from 53 on, 2 s after it was replaced; at 70 the new scene is confirmed.
    assert len(bus.runners["bright"].track_ms) == len(range(34)) + len(range(53, 71))
    assert modules["dark"].scenes == ["Bright", "Dark"]


def test_flapping_first_choice_is_given_more_and_more_time():
    lost = [index for index in range(50, 3000) if index % 30 > 12]
    _, atlas, log, _ = drive(
        {"bright": ExactModule(lost=lost), "dark": ExactModule()},
        steps=1200,
        handover="rewind",
        retry_s=1.0,
    )
    assert len(events(log, "decision")) < 16
    assert_exact(atlas)


@settings(max_examples=40, deadline=None)
@given(
    lost=st.sets(st.integers(0, 119), max_size=60),
    dark_lost=st.sets(st.integers(0, 119), max_size=60),
    raises=st.sets(st.integers(0, 119), max_size=2),
    flips=st.lists(st.integers(1, 119), max_size=4),
    handover=st.sampled_from(["cold", "warm", "rewind"]),
    startup_s=st.sampled_from([0.0, 1.5]),
)
def test_decisions_follow_from_the_log_alone(lost, dark_lost, raises, flips, handover, startup_s):
    options = {"handover": handover, "confirm_window_s": 0.5, "retry_s": 1.0}
    options["startup_s"] = {"dark": startup_s}
    _, atlas, log, _ = drive(
        {"bright": ExactModule(lost=lost, raises=raises), "dark": ExactModule(lost=dark_lost)},
        steps=120,
        scene_at=lambda i: "Dark" if sum(flip <= i for flip in flips) % 2 else "Bright",
        **options,
    )
    assert decide_again(log.events, policy(**options)) == []
    if handover == "rewind" and len(atlas.trajectory):
        assert_exact(atlas)
        first_ns = atlas.trajectory.stamps_ns[0]
        stamps_ns = [e["stamp_ns"] for e in events(log, "vote") if e["stamp_ns"] >= first_ns]
        assert len(atlas.trajectory) == len(stamps_ns)


def test_a_decision_that_the_log_does_not_lead_to_is_found():
    modules = {"bright": ExactModule(lost=range(50, 200)), "dark": ExactModule()}
    _, _, log, _ = drive(modules)
    assert decide_again(log.events, policy()) == []
    assert decide_again(log.events, policy(lost_patience_s=0.2))
