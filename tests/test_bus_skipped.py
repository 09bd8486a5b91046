"""What the bus keeps of observations that a module is not given, and of modules on trial."""

from dataclasses import replace

import numpy as np
import pytest
from driving import drive
from fakes import PERIOD_NS, ExactModule, observation

from sceneslam.bus.changeover import Changeover
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.rig import Rig, Sensor

RIG = Rig(sensors=frozenset({Sensor.ODOMETRY, Sensor.IMAGE, Sensor.GYRO}))
TIMES_S = np.linspace(-0.09, 0.0, 10)  # between two observations
GYRO = np.column_stack([TIMES_S, np.tile([0.0, 0.0, 0.3], (10, 1))])


class Turning(ExactModule):
    """Notes the turn between its observations by the gyro."""

    def activate(self, rig):
        super().activate(rig)
        self.turns_rad, self._last_ns = [], None

    def track(self, observation):
        if self._last_ns is not None:
            turn = observation.turn_by_gyro((observation.stamp_ns - self._last_ns) / 1e9)
            self.turns_rad.append(None if turn is None else float(turn[2]))
        self._last_ns = observation.stamp_ns
        return super().track(observation)


class Beside(Turning):
    """Works in a process of its own, as it were."""

    def submit(self, observation):
        self._submitted = observation

    def collect(self):
        return self.track(self._submitted)


class ByWheels(ExactModule):
    requires = (frozenset({Sensor.ODOMETRY}),)


def images_at(every):
    def feed(index):
        seen = replace(observation(index), gyro_base=GYRO)
        return seen if index % every == 0 else replace(seen, image_bgr=None)

    return feed


@pytest.mark.parametrize("kind", [Turning, Beside])
@pytest.mark.parametrize("lost", [range(0), range(20, 50)])
def test_a_module_gets_the_gyro_of_observations_that_it_is_not_given(kind, lost):
    """As of a laser at 10 Hz beside images at 30 Hz; and where it works on trial."""
    module = kind(lost=lost)
    modules = {"bright": module, "dark": ByWheels()}
    options = {"handover": "rewind", "retry_s": 2.0, "lost_patience_s": 0.7}
    drive(modules, steps=150, feed=images_at(3), rig=RIG, **options)
    assert len(module.turns_rad) > 10 and None not in module.turns_rad
    np.testing.assert_allclose(module.turns_rad, 0.09, rtol=0.05)  # less the bias that wheels show


def trials(modules, feed):
    """Return how much each trial kept at its observations."""
    kept, try_on = [], Changeover.try_on

    def spy(changeover):
        try_on(changeover)
        trial = changeover._trial
        if trial is not None and trial.handover is not None:
            kept.append(len(trial.handover.trail) + len(trial.handover.tracked))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Changeover, "try_on", spy)
        drive(modules, steps=400, feed=feed, rig=RIG, handover="rewind", retry_s=2.0)
    return kept


class Degraded(ExactModule):
    """Tracks badly once it was lost."""

    def track(self, observation):
        tracking = super().track(observation)
        if observation.stamp_ns < 60 * PERIOD_NS or tracking.status is TrackingStatus.LOST:
            return tracking
        return replace(tracking, status=TrackingStatus.DEGRADED)


def test_a_long_trial_keeps_no_observations():
    kept = trials({"bright": Degraded(lost=range(20, 60)), "dark": ByWheels()}, images_at(1))
    assert len(kept) > 200 and max(kept) == 0


def test_a_trial_without_data_ends():
    def feed(index):
        return images_at(1 if index < 20 else 10**6)(index)

    kept = trials({"bright": ExactModule(), "dark": ByWheels()}, feed)
    assert 0 < len(kept) < 250  # of 370 observations: the waits between trials grow
