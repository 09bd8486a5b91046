"""The rgbd module makes its map anew when colours turn out to be of another camera than depth."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from test_rgbd import camera_only, drive, make, true_pose

from sceneslam.modules.slam.rgbd.adjust.renewal import NEWEST, LocatedView, seen_by
from sceneslam.modules.slam.rgbd.map.keyframes import KeyframeStore
from sceneslam.modules.slam.rgbd.see.alignment import Alignment
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

IMAGES = 24


def renewed():
    """Return a module that made its map anew at the last image, of colours that are registered."""
    module = make()
    drive(module, [camera_only(index) for index in range(IMAGES - 1)])
    assert len(module._parts.mapping.beginning) > 1
    module._parts.mapping.alignment = Alignment()
    answers = drive(module, [camera_only(IMAGES - 1)])
    return module, answers[0]


def test_places_from_before_the_cameras_were_known_are_found_again():
    module, answer = renewed()
    later_ns = answer.stamp_ns + 3_000_000_000
    lost, found = drive(
        module,
        [
            replace(camera_only(2), stamp_ns=later_ns, image_bgr=None),
            replace(camera_only(2), stamp_ns=later_ns + 33_000_000),
        ],
    )
    module.shutdown()
    assert lost.status is TrackingStatus.LOST
    assert found.status is TrackingStatus.TRACKING
    T_error = se3.inverse(true_pose(2)) @ found.T_local_base
    assert np.linalg.norm(T_error[:3, 3]) < 0.02


def test_past_is_told_by_the_new_map_and_the_jump_as_a_revision():
    module, answer = renewed()
    assert answer.revision == 0
    assert module.track(camera_only(IMAGES)).revision == 1
    told = module.get_trajectory()
    module.shutdown()
    assert len(told) == IMAGES + 1
    errors = se3.inverse(np.stack([true_pose(i) for i in range(len(told))])) @ told.T_world_base
    assert np.linalg.norm(errors[:, :3, 3], axis=1).max() < 0.03


def test_views_of_other_segments_and_of_the_same_image_are_left_out():
    keyframes, views = KeyframeStore(), {}
    for stamp_ns in (0, 10, 20, 30):
        keyframe = SimpleNamespace(
            stamp_ns=stamp_ns, T_local_base=np.eye(4), landmark_ids=np.zeros(0, int)
        )
        views[keyframes.insert(keyframe)] = None
    view = SimpleNamespace(observation=SimpleNamespace(stamp_ns=30))
    newest = LocatedView(view=view, T_local_base=np.eye(4))
    assert list(seen_by(keyframes, views, None, newest)) == [0, 1, 2, NEWEST]
    assert list(seen_by(keyframes, views, {1, 3}, newest)) == [1, NEWEST]
    del views[0]
    assert list(seen_by(keyframes, views, None, newest)) == [1, 2, NEWEST]
