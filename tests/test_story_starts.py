"""Starts at random instants of a story, in the map of another: found there, or not at all."""

from dataclasses import replace

import numpy as np
from test_atlas_maps import S, map_of
from test_seen_views import RIG, landmarks_of, seen
from test_views import ASIDE, ELSEWHERE, HERE, MOUNT

from sceneslam.atlas.places.floor_plan import join
from sceneslam.experiments.one_map.relocalization import Starts, StoryStarts, together
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory
from sceneslam.views.view import PlacedView

STAMPS_NS = np.arange(100) * S // 10
BLACK = np.zeros((480, 640, 3), np.uint8)


def standing(due, *, count):
    """Starts of a robot that stands, in a map of one view; `due`: where it is in truth."""
    kept = PlacedView(stamp_ns=0, T_submap_cam=ASIDE @ MOUNT, landmarks=landmarks_of(seen()))
    saved = map_of(join([]), nodes=[[2.0, 1.0, 0.4]])
    saved = replace(saved, submaps=(replace(saved.submaps[0], views=(kept,)),))
    online = Trajectory(stamps_ns=STAMPS_NS, T_world_base=np.tile(ELSEWHERE, (100, 1, 1)))
    return StoryStarts(saved, RIG, online, due, count=count, within_s=2.0, seed=0)


def test_starts_in_a_story_are_found_in_the_map_of_another():
    def started(off, drive):
        starts = standing(lambda _: HERE @ ASIDE @ off, count=20)
        for observation in drive:
            starts.observe(observation)
        return starts

    # Lit for 4 s: later starts are in the dark, and never found.
    lit, dark = seen(), seen(BLACK)
    drive = [replace(lit if ns < 4 * S else dark, stamp_ns=int(ns)) for ns in STAMPS_NS]
    starts = started(se3.identity(), drive)
    bright, unlit = (starts.found(is_lit=is_lit, is_shared=True) for is_lit in (True, False))
    assert bright.count + unlit.count == 20 and unlit.count > 5 and unlit.found == 0
    assert bright.found_ratio > 0.8 and bright.wrong == 0 and bright.worst_m < 0.001
    assert starts.found(is_lit=True, is_shared=False).count == 0
    # In truth elsewhere: half a metre away it would see what the map shows.
    aside = started(se3.from_xy_yaw(1.0, 0.0, 0.0), drive)
    assert aside.found(is_lit=True, is_shared=True).count == 0
    wrong = aside.found(is_lit=True, is_shared=False)
    assert wrong.wrong == wrong.found == bright.found and wrong.found_ratio == 0.0
    both = together([bright, unlit])
    assert (both.count, both.found) == (20, bright.found)


def test_starts_share_geometry_that_come_to_where_a_view_of_the_map_was_near():
    def due(stamp_ns):
        return HERE @ ASIDE @ se3.from_xy_yaw(0.4 if stamp_ns >= 5 * S else 0.6, 0.0, 0.0)

    starts = standing(due, count=50)
    for ns in STAMPS_NS:
        starts.observe(replace(seen(BLACK), stamp_ns=int(ns)))
    shared, others = (starts.found(is_lit=False, is_shared=one) for one in (True, False))
    drawn_ns = np.random.default_rng(0).choice(STAMPS_NS[STAMPS_NS <= 7.9 * S], 50)
    assert shared.count == (drawn_ns >= 3 * S).sum() and shared.count + others.count == 50
    assert others.found == 0
    assert Starts(count=0, found=0, wrong=0, worst_m=0.0, worst_rad=0.0).found_ratio == 1.0
