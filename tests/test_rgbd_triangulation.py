"""Which landmarks the rgbd module makes of two images without depth."""

import numpy as np
import pytest
from rgbd_features import AT_REST, empty_map, features_at, random_descriptors

from sceneslam.modules.slam.rgbd.adjust.triangulation import triangulate
from sceneslam.modules.slam.rgbd.map.keyframes import NO_LANDMARK, DepthView, Keyframe
from sceneslam.types import se3
from sceneslam.types.rig import Camera

CAMERA = Camera(size_wh=(640, 480), fx=525.0, fy=520.0, cx=319.0, cy=241.0)
NEAR, FAR = [0.4, 0.05, 0.02], [2.5, -0.3, 0.2]  # [m], in local: no depth shows them
KNOWN = 40


def keyframe_at(y_m, points_local, descriptors, *, landmark_ids, depth_m):
    T_local_base = se3.from_xy_yaw(0.0, y_m, 0.0)
    x, y, z = se3.apply(se3.inverse(T_local_base @ CAMERA.T_base_cam), points_local).T
    uv_px = np.column_stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy])
    nothing = np.zeros((0, 3))
    return Keyframe(
        stamp_ns=0,
        T_local_base=T_local_base,
        features=features_at(uv_px, descriptors, depth_m=np.where(depth_m, z, 0.0)),
        landmark_ids=landmark_ids.copy(),
        view=DepthView(
            points_base=nothing.astype(np.float32),
            colors_bgr=nothing.astype(np.uint8),
            pixels=0,
            scan=None,
        ),
        turning=AT_REST,
        is_monocular=True,
    )


def triangulated(known_m):
    """Return the points (N, 3) [m] made of two keyframes that show both, and known ones there."""
    rng, visual_map = np.random.default_rng(0), empty_map(CAMERA)
    known = np.column_stack([np.full(KNOWN, known_m), rng.uniform(-0.2, 0.2, (KNOWN, 2)) * known_m])
    points, is_known = np.concatenate([known, [NEAR, FAR]]), np.arange(KNOWN + 2) < KNOWN
    descriptors, none = random_descriptors(rng, KNOWN + 2), np.full(KNOWN + 2, NO_LANDMARK)
    first = keyframe_at(0.0, points, descriptors, landmark_ids=none, depth_m=is_known)
    visual_map.insert(first, deep_rows=none[:0])
    ids = np.where(is_known, first.landmark_ids, NO_LANDMARK)
    second = keyframe_at(0.1, points, descriptors, landmark_ids=ids, depth_m=is_known & False)
    new_id = visual_map.insert(second, deep_rows=none[:0])
    triangulate(visual_map, new_id)
    made = second.landmark_ids[~is_known]
    return visual_map.landmarks.points_local[made[made != NO_LANDMARK]]


def test_point_much_nearer_than_all_that_is_known_there_is_a_wrong_match():
    assert triangulated(3.0) == pytest.approx(np.array([FAR]), abs=1e-6)


def test_point_is_believed_as_near_as_what_is_known_there():
    assert triangulated(0.6) == pytest.approx(np.array([NEAR, FAR]), abs=1e-6)
