"""Depth goes missing when it is told to, and nothing else does."""

import pytest
from test_effects import DEPTH, film

from sceneslam.sources.depth_gap import DepthGap
from sceneslam.types.errors import ConfigError


def test_depth_shows_nothing_within_a_gap_and_is_untouched_outside():
    source = film()
    found = list(DepthGap(source, [[1.0, 2.0], [9.5, 20.0]]))
    empty = [index for index, one in enumerate(found) if not one.depth_m.any()]
    assert empty == [*range(10, 20), *range(95, 101)]
    assert all(one.depth_m.shape == DEPTH.shape for one in found)
    assert not found[10].depth_m.flags.writeable
    for one, other in zip(found, source, strict=True):
        assert one.image_bgr is other.image_bgr and one.stamp_ns == other.stamp_ns
        assert one is other or not one.depth_m.any()
    assert DepthGap(source, []).ground_truth().scenes == source.ground_truth().scenes


@pytest.mark.parametrize("gap_s", [[2.0, 1.0], [1.0], [-1.0, 2.0]])
def test_gap_that_is_none_is_named(gap_s):
    with pytest.raises(ConfigError, match="gaps_s"):
        DepthGap(film(), [gap_s])
