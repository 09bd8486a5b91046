"""The rgbd map's history: which keyframes are connected, and how certain their edges are."""

from types import SimpleNamespace

import numpy as np
import pytest
from rgbd_features import empty_map, settings_with
from test_rgbd_map import CAMERA, keyframe_at

from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.modules.slam.rgbd.locate.localizer import VisualLocalizer
from sceneslam.modules.slam.rgbd.locate.pose_solver import PoseSolver
from sceneslam.modules.slam.rgbd.loops.loop_detection import LoopClosure, LoopDetector
from sceneslam.modules.slam.rgbd.map.map_history import MapHistory
from sceneslam.modules.slam.rgbd.see.rectifying_extractor import RectifyingExtractor
from sceneslam.types import se3


@pytest.fixture
def history():
    visual_map = empty_map(CAMERA, keyframe_limit=99)
    solver = PoseSolver(CAMERA, seed=0)
    settings = settings_with(degraded_inliers=20)
    localizer = VisualLocalizer(visual_map, solver, settings=settings)
    eye = RectifyingExtractor(visual_map, localizer, None)
    made = MapHistory(visual_map, localizer, eye, settings=settings)
    yield made
    made.shutdown()


def insert(history, x_m, *, guessed_s=None):
    history._map.insert(keyframe_at(x_m), deep_rows=np.zeros(0, np.int64))
    history.insert(None, None, guessed_s=guessed_s)


def test_segment_that_a_loop_joins_where_it_is_needs_no_guess_any_more(history, monkeypatch):
    insert(history, 0.0)
    insert(history, 1.0, guessed_s=2.0)
    edge = Edge(
        first=0,
        second=1,
        T_first_second=se3.from_xy_yaw(1.0, 0.0, 0.0),
        covariance=1e-4 * np.eye(6),
        kind=EdgeKind.LOOP,
    )
    loop = LoopClosure(edge=edge, T_local_base=edge.T_first_second)
    monkeypatch.setattr(
        LoopDetector, "candidate", lambda _, query: 0 if query.keyframe_id else None
    )
    monkeypatch.setattr(LoopDetector, "check", lambda *_: [loop])
    assert history.segments.are_many
    for _ in range(3):  # the first keyframe is queried; the second one is, and is checked
        assert history.step() is None
    assert history.pose_graph().is_loop.tolist() == [True]
    assert not history.segments.are_many


@pytest.mark.parametrize(
    ("counts", "connected"), [([4, 4, 4], [0, 1, 2]), ([6, 7] + 10 * [6], [1]), ([19, 1], [0])]
)
def test_keyframe_is_connected_to_most_owners_of_its_landmarks(history, counts, connected):
    """To each with more than a tenth of them, or to the one with most of many."""
    for owner in range(len(counts)):
        insert(history, 0.1 * owner)
    owned = history._map.keyframes.owned_landmarks()
    shown = np.concatenate([owned[k][:count] for k, count in enumerate(counts)])
    estimate = SimpleNamespace(covariance=1e-4 * np.eye(6))
    newest = keyframe_at(0.1 * len(counts), shown, count=80)
    history._map.insert(newest, deep_rows=np.zeros(0, np.int64))
    history.insert(SimpleNamespace(landmark_ids=shown, estimate=estimate), None, guessed_s=None)
    assert history._graph.neighbours(len(counts)) == connected
