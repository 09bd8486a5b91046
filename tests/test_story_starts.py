"""Starts at random instants of a story, in the map of another: found there, or not at all."""

from dataclasses import replace

import numpy as np
from test_atlas_maps import S, map_of
from test_seen_views import RIG, seen
from test_views import ASIDE, CAMERA, ELSEWHERE, HERE

from sceneslam.atlas.places.floor_plan import join
from sceneslam.experiments.one_map.relocalization import StoryStarts, together
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory
from sceneslam.views.view import LandmarkViewer, PlacedView


def test_starts_in_a_story_are_found_in_the_map_of_another():
    view = LandmarkViewer(CAMERA).look(seen())
    kept = PlacedView(stamp_ns=0, T_submap_base=ASIDE, landmarks=view.landmarks)
    saved = map_of(join([]), nodes=[[2.0, 1.0, 0.4]])
    saved = replace(saved, submaps=(replace(saved.submaps[0], views=(kept,)),))
    stamps_ns = np.arange(100) * S // 10
    online = Trajectory(stamps_ns=stamps_ns, T_world_base=np.tile(ELSEWHERE, (100, 1, 1)))

    def started(off, drive):
        starts = StoryStarts(
            saved, RIG, online, lambda _: HERE @ ASIDE @ off, count=20, within_s=2.0, seed=0
        )
        for observation in drive:
            starts.observe(observation)
        return starts

    # Lit for 4 s: later starts are in the dark, and never found.
    lit, dark = seen(), seen(np.zeros((480, 640, 3), np.uint8))
    drive = [replace(lit if ns < 4 * S else dark, stamp_ns=int(ns)) for ns in stamps_ns]
    starts = started(se3.identity(), drive)
    bright, unlit = (starts.found(is_lit=is_lit) for is_lit in (True, False))
    assert bright.count + unlit.count == 20 and unlit.count > 5 and unlit.found == 0
    assert bright.found_ratio > 0.8 and bright.wrong == 0 and bright.worst_m < 0.001
    wrong = started(se3.from_xy_yaw(1.0, 0.0, 0.0), drive).found(is_lit=True)
    assert wrong.wrong == wrong.found == bright.found and wrong.found_ratio == 0.0
    both = together([bright, unlit])
    assert (both.count, both.found) == (20, bright.found)
