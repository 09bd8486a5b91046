"""Without depth, wheels tell how far keyframes are apart; landmarks alone lose the scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_rgbd_bundle import CAMERA, exact_bundle, keyframe_at, true_poses

from sceneslam.modules.slam.rgbd.bundle import adjust
from sceneslam.modules.slam.rgbd.keyframes import Reckoned
from sceneslam.modules.slam.rgbd.reckoning import reckoned_ties
from sceneslam.modules.slam.rgbd.ties import Ties
from sceneslam.types import se3


def keyframes(*, is_monocular=True, stretches=(0, 0, 0, 0)):
    """Return keyframes on a line, half a metre apart, as odometry alone has them."""
    made = {}
    for k, stretch in enumerate(stretches):
        one = keyframe_at(
            np.eye(4), np.zeros((0, 3)), np.zeros((0, 32), np.uint8), np.zeros(0, int)
        )
        one.is_monocular = is_monocular
        one.reckoned = Reckoned(T_reckoned_base=se3.from_xy_yaw(0.5 * k, 0.1, 0.2), stretch=stretch)
        made[k] = one
    return made


def test_odometry_ties_keyframes_that_follow_each_other_without_depth():
    ties = reckoned_ties(keyframes(), CAMERA.T_base_cam)
    assert list(ties) == [(0, 1), (1, 2), (2, 3)]
    T_base = CAMERA.T_base_cam @ ties[1, 2].T_one_other @ se3.inverse(CAMERA.T_base_cam)
    assert np.linalg.norm(T_base[:3, 3]) == pytest.approx(0.5)


def test_odometry_ties_nothing_that_has_depth_or_lies_beyond_a_gap():
    assert not reckoned_ties(keyframes(is_monocular=False), CAMERA.T_base_cam)
    assert list(reckoned_ties(keyframes(stretches=(0, 0, 1, 1)), CAMERA.T_base_cam)) == [
        (0, 1),
        (2, 3),
    ]


def test_ties_bring_back_a_scale_that_images_alone_cannot_tell():
    bundle = exact_bundle(np.random.default_rng(0))
    poses, count = true_poses(), len(bundle.T_local_cam)
    keys = dict(enumerate(keyframes(stretches=(0,) * count).values()))
    for key, T_local_cam in zip(keys.values(), poses, strict=True):
        T_local_base = T_local_cam @ se3.inverse(CAMERA.T_base_cam)
        key.reckoned = Reckoned(T_reckoned_base=T_local_base, stretch=0)
    shrunk = bundle.T_local_cam.copy()
    first_m = shrunk[0, :3, 3]
    shrunk[:, :3, 3] = first_m + 0.8 * (shrunk[:, :3, 3] - first_m)
    points = first_m + 0.8 * (bundle.points_local - first_m)
    no_depth = replace(bundle.seen, depth_m=np.zeros_like(bundle.seen.depth_m))
    is_free = np.arange(count) > 0
    wrong = replace(bundle, T_local_cam=shrunk, points_local=points, seen=no_depth, is_free=is_free)

    def length_m(adjusted):
        T_local_cam = adjusted.bundle.T_local_cam
        return np.linalg.norm(T_local_cam[-1, :3, 3] - T_local_cam[0, :3, 3])

    true_m = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert length_m(adjust(CAMERA, wrong)) == pytest.approx(0.8 * true_m, rel=0.05)
    ties = Ties.of(reckoned_ties(keys, CAMERA.T_base_cam))
    assert length_m(adjust(CAMERA, replace(wrong, ties=ties))) == pytest.approx(true_m, rel=0.05)
