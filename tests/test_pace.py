"""What a module that catches up is spared, and what comes of the poses in between."""

from dataclasses import replace

import pytest
from driving import assert_exact, dark_from, drive, events
from fakes import PERIOD_NS, ExactModule, observation
from test_handover import errors_m, slipping

from sceneslam.bus.pace import Pace, PaceSettings
from sceneslam.types.errors import ConfigError
from sceneslam.types.run import BRIDGED

EVERY_THIRD = PaceSettings(period_s=0.3, step_m=10.0)
SWITCHED = {"scene_at": dark_from(40), "handover": "rewind"}  # confirmed at 60


class Asked(ExactModule):
    """Remembers what it was given."""

    def __init__(self, **options):
        super().__init__(**options)
        self.given = []

    def track(self, observation):
        self.given.append(observation)
        return super().track(observation)

    @property
    def indices(self):
        return [given.stamp_ns // PERIOD_NS for given in self.given]


def test_module_that_catches_up_is_given_every_third_observation_and_the_newest():
    dark = Asked()
    _, atlas, _, _ = drive(
        {"bright": ExactModule(), "dark": dark}, catch_up=EVERY_THIRD, **SWITCHED
    )
    assert dark.indices[:9] == [40, 43, 46, 49, 52, 55, 58, 60, 61]
    assert_exact(atlas)


def test_poses_in_between_are_the_modules_where_odometry_slips():
    _, atlas, _, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule()},
        feed=slipping,
        catch_up=EVERY_THIRD,
        **SWITCHED,
    )
    assert BRIDGED not in atlas.pose_modules and len(atlas.trajectory) == 100
    assert atlas.pose_modules[40:62] == ("bright", *["dark"] * 21)
    errors = errors_m(atlas.trajectory)
    assert errors[60] < 1e-9
    slip_m = 0.02  # of every step; without what the module says at the third, they would add up
    assert errors[41] < slip_m / 2 and errors.max() < slip_m


def test_poses_in_between_are_the_modules_where_one_observation_has_nothing_for_it():
    """The image of 43 is missing, so that the module is given nothing between 40 and 44."""

    def feed(index):
        return replace(slipping(index), image_bgr=None) if index == 43 else slipping(index)

    _, atlas, _, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule()},
        feed=feed,
        catch_up=EVERY_THIRD,
        **SWITCHED,
    )
    assert atlas.pose_modules[40:62] == ("bright", *["dark"] * 21)
    assert errors_m(atlas.trajectory)[41:44].max() < 0.01


def test_poses_where_the_module_was_lost_stay_bridged():
    """It is asked at 46, and at every observation until it tracks again at 56."""
    _, atlas, _, _ = drive(
        {"bright": ExactModule(), "dark": ExactModule(lost=range(44, 56))},
        feed=slipping,
        catch_up=EVERY_THIRD,
        **SWITCHED,
    )
    keys = atlas.pose_modules
    assert keys[41:46] == ("dark",) * 5 and keys[46:56] == (BRIDGED,) * 10
    assert keys[56:62] == ("dark",) * 6 and errors_m(atlas.trajectory)[41:56].max() < 0.1


@pytest.mark.parametrize("limit", [2, 5])
def test_spared_observations_do_not_count_in_live_mode(limit):
    """21 observations wait for the new module, of which it is given 7."""
    dark = Asked()
    _, atlas, log, _ = drive(
        {"bright": ExactModule(), "dark": dark},
        catch_up=EVERY_THIRD,
        catch_up_steps=limit,
        **SWITCHED,
    )
    assert_exact(atlas)
    took = events(log, "decision")[1]["stamp_ns"] // PERIOD_NS - 60
    assert took == {2: 4, 5: 1}[limit]


def test_nothing_is_spared_to_a_module_that_is_lost():
    dark = Asked(lost=range(43, 50))
    drive({"bright": ExactModule(), "dark": dark}, catch_up=EVERY_THIRD, **SWITCHED)
    assert dark.indices[:4] == [40, 43, 44, 45]


@pytest.mark.parametrize("change", [{"step_m": 0.01}, {"period_s": 0.1}])
def test_observation_after_more_time_or_motion_is_not_spared(change):
    pace = Pace(replace(EVERY_THIRD, **change))
    pace.last = observation(0)
    assert not pace.spares(observation(1))
    assert Pace(EVERY_THIRD).spares(observation(1)) is False  # nothing was given yet
    pace = Pace(EVERY_THIRD)
    pace.last = observation(0)
    assert pace.spares(observation(1)) and not pace.spares(observation(3))


def test_nothing_is_spared_without_odometry():
    pace = Pace(EVERY_THIRD)
    pace.last = observation(0, has_odometry=False)
    assert not pace.spares(observation(1, has_odometry=False))


@pytest.mark.parametrize("name", ["period_s", "step_m"])
def test_impossible_paces_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        replace(EVERY_THIRD, **{name: -1.0})
