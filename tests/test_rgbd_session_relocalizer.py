"""A module that is started anew knows the places of its earlier session again."""

from dataclasses import replace

import numpy as np
import pytest
from test_rgbd import make

from sceneslam.testing.room import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

IMAGES, PAUSE_NS = 36, 10 * 10**9
T_DRIFT = se3.from_xy_yaw(0.12, -0.05, 0.06)  # of what led from the first session to the second


def seen(index, *, late):
    """The drive through the room, again after a pause where it is late."""
    one = room_observation(index)
    stamp_ns = one.stamp_ns + late * (PAUSE_NS + room_observation(IMAGES).stamp_ns)
    return replace(one, stamp_ns=stamp_ns, scan=None, points_lidar=None, T_odom_base=None)


def true_pose(index):
    return se3.inverse(room_observation(0).T_odom_base) @ room_observation(index).T_odom_base


def errors_m(T_map_base):
    """How far the poses of the second session, image by image, are from the true ones in map."""
    true = np.stack([true_pose(index) for index in range(IMAGES)])
    return np.linalg.norm((se3.inverse(true) @ T_map_base)[:, :3, 3], axis=1)


def drive(module, T_map_local, *, late):
    module.activate(RIG)
    answers = [module.track(seen(0, late=late))]
    if T_map_local is not None:
        module.set_pose(T_map_local)
    answers += [module.track(seen(index, late=late)) for index in range(1, IMAGES)]
    assert all(answer.status is TrackingStatus.TRACKING for answer in answers)
    return answers, module.get_trajectory()


@pytest.fixture(scope="module")
def returned():
    """Drive through the room twice; the second time the module is placed where it is not."""
    module = make()
    drive(module, se3.identity(), late=False)
    module.shutdown()
    module.shutdown()
    answers, revised = drive(module, T_DRIFT, late=True)
    loops = module.get_map().loops
    module.shutdown()
    return answers, revised, loops


def test_second_session_finds_its_place_in_the_map_and_says_that_it_jumps(returned):
    answers, revised, _ = returned
    told = T_DRIFT @ np.stack([answer.T_local_base for answer in answers])
    jump = next(i for i, answer in enumerate(answers) if answer.revision)
    assert (errors_m(told)[:jump] > 0.1).all() and (errors_m(told)[jump:] < 0.03).all()
    assert answers[-1].revision == 1 and 15 < jump < 35
    assert (errors_m(T_DRIFT @ revised.T_world_base) < 0.03).all()


def test_loops_to_the_earlier_session_are_reported_as_measured(returned):
    _, _, loops = returned
    assert len(loops.stamps_ns) >= 2
    index_of = {seen(i, late=late).stamp_ns: i for i in range(IMAGES) for late in (False, True)}
    for (from_ns, to_ns), T_from_to, information in zip(
        loops.stamps_ns.tolist(), loops.T_from_to, loops.information, strict=True
    ):
        T_true = se3.inverse(true_pose(index_of[from_ns])) @ true_pose(index_of[to_ns])
        off = se3.log(se3.inverse(T_true) @ T_from_to)
        assert from_ns < PAUSE_NS < to_ns
        assert off @ information @ off < 22.5  # chi-square, 6 degrees of freedom, 0.1 %


def test_session_that_was_never_placed_stays_by_itself():
    module = make()
    first, _ = drive(module, None, late=False)
    module.shutdown()
    again, _ = drive(module, None, late=True)
    module.shutdown()
    assert again[-1].revision == 0
    np.testing.assert_array_equal(first[-1].T_local_base, again[-1].T_local_base)


def test_place_that_no_drift_explains_is_another():
    module = make()
    drive(module, se3.identity(), late=False)
    module.shutdown()
    answers, _ = drive(module, se3.from_xy_yaw(4.0, 0.0, 0.0), late=True)
    module.shutdown()
    assert answers[-1].revision == 0


def test_image_in_which_a_depth_camera_sees_nothing_near_is_not_searched():
    module = make()
    drive(module, se3.identity(), late=False)
    module.shutdown()
    module.activate(RIG)
    module.track(seen(0, late=True))
    module.set_pose(T_DRIFT)
    for index in range(1, IMAGES):
        one = seen(index, late=True)
        answer = module.track(replace(one, depth_m=np.zeros_like(one.depth_m)))
    module.shutdown()
    assert answer.revision == 0 and module.get_map().loops is None
