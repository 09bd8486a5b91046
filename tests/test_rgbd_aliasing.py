"""Places that look the same are not taken for one another."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_rgbd import make

from sceneslam.modules.slam.rgbd.loops import loop_detection
from sceneslam.testing import room as scenery
from sceneslam.testing.room import observation_at
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

PERIOD_M = 5.0  # after which the corridor's walls repeat
TEXELS_PER_M = 40
STEP_M = 0.15
STEPS = int(1.3 * PERIOD_M / STEP_M)


def seen_from(T_room_base, index):
    observation = observation_at(T_room_base, index / 30.0)
    return replace(observation, scan=None, points_lidar=None, T_odom_base=None, gyro_base=None)


@pytest.fixture
def endless_corridor(monkeypatch):
    """Let the room have no ends, and walls that repeat."""
    rows = np.arange(400) % int(PERIOD_M * TEXELS_PER_M)
    repeated = scenery._texture()[:, rows]
    monkeypatch.setattr(scenery, "_texture", lambda: repeated)
    monkeypatch.setattr(scenery, "HALF_X_M", 1000.0)


@cache
def corridor(index):
    """The view after so many steps, of the corridor's left wall for the most part."""
    return seen_from(se3.from_xy_yaw(STEP_M * index, 0.0, 0.6), index)


def drive_on(module):
    """Drive one and a third periods along the corridor; return the share of it that was told."""
    for index in range(STEPS):
        answer = module.track(corridor(index))
        assert answer.status is not TrackingStatus.LOST
    return np.linalg.norm(answer.T_local_base[:2, 3]) / (STEP_M * index)


def test_second_stretch_of_a_corridor_that_repeats_is_not_the_first(endless_corridor):
    pytest.importorskip("gtsam")
    module = make()
    assert drive_on(module) == pytest.approx(1.0, rel=0.03)
    assert not module.get_map().pose_graph.is_loop.any()
    module.shutdown()


def test_corridor_that_repeats_would_be_closed_if_any_drift_were_believed(
    endless_corridor, monkeypatch
):
    pytest.importorskip("gtsam")
    monkeypatch.setattr(loop_detection, "_DRIFT_RATIO", 10.0)
    module = make()
    drive_on(module)
    assert module.get_map().pose_graph.is_loop.any()
    module.shutdown()


def test_lost_camera_does_not_choose_between_two_places_that_look_the_same(endless_corridor):
    module = make()
    drive_on(module)
    module.track(replace(corridor(STEPS), T_odom_base=se3.identity()))
    black = np.zeros((240, 320, 3), np.uint8)
    for metre in range(1, 31):  # to where no landmark is near, say the wheels
        gone = se3.from_xy_yaw(float(metre), 0.0, 0.0)
        stamp_ns = corridor(STEPS).stamp_ns + metre * 400_000_000
        dark = replace(corridor(STEPS), stamp_ns=stamp_ns, image_bgr=black, T_odom_base=gone)
        module.track(dark)
    ambiguous, clear = (
        replace(corridor(index), stamp_ns=stamp_ns + later_ns, T_odom_base=gone)
        for index, later_ns in ((2, 33_000_000), (STEPS // 2, 66_000_000))
    )
    answer = module.track(ambiguous)
    assert answer.status is TrackingStatus.LOST
    answer = module.track(clear)
    assert answer.status is not TrackingStatus.LOST
    travelled_m = np.linalg.norm(answer.T_local_base[:2, 3])
    assert travelled_m == pytest.approx(STEP_M * (STEPS // 2), abs=0.1)
    module.shutdown()
