"""The rgbd module looks for a camera until it is found clearly."""

from types import SimpleNamespace

import numpy as np
import pytest

from sceneslam.modules.slam.rgbd.locate.localizer import VisualFix
from sceneslam.modules.slam.rgbd.locate.search import Search

EXPECTED = 500


def fix_of(count):
    rows = np.arange(count)
    return VisualFix(
        estimate=None,
        landmark_ids=rows,
        feature_rows=rows,
        deep_rows=rows,
        expected_ids=np.arange(EXPECTED),
    )


def found(*, near, around, is_lost):
    """Return how many landmarks hold what is found, of what three ways find; None is not asked."""
    view = SimpleNamespace(features=range(1000), T_predicted=np.eye(4), depth_m=None)
    localizer = SimpleNamespace(
        near=lambda *_: near and fix_of(near), around=lambda *_: fix_of(around)
    )
    relocalizer = SimpleNamespace(find=lambda *_: fix_of(33))
    fix = Search(localizer, relocalizer).find(view, np.arange(5), is_lost=is_lost)
    return len(fix.landmark_ids)


@pytest.mark.parametrize("is_lost", [False, True])
def test_pose_that_few_of_the_expected_hold_gives_way_to_one_that_more_do(is_lost):
    assert found(near=60, around=300, is_lost=is_lost) == 300
    assert found(near=60, around=50, is_lost=is_lost) == 60


def test_clear_pose_is_believed_at_once():
    assert found(near=120, around=300, is_lost=False) == 120


def test_lost_camera_is_looked_for_elsewhere():
    assert found(near=None, around=300, is_lost=True) == 33
    assert found(near=None, around=300, is_lost=False) == 300
