"""What a run keeps while it goes on for hours: little per pose, and no more points than allowed."""

import json

import numpy as np
import pytest

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.budget import Budget, thin
from sceneslam.atlas.pose_path import OpenSession
from sceneslam.engine.slowest import Slowest
from sceneslam.storage.events import EventLog
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import LandmarkLayer, MapLayers, PointLayer, ScanLayer
from sceneslam.types.rows import Rows
from sceneslam.types.run import SlowPose
from sceneslam.types.trajectory import Trajectory


def test_rows_are_what_was_added_and_not_cut():
    rng = np.random.default_rng(0)
    given = rng.normal(size=(700, 2, 3))
    rows = Rows(2, 3)
    for row in given:
        rows.append(row)
    rows.cut(300)
    for row in given[600:]:
        rows.append(row)
    expected = np.concatenate([given[:300], given[600:]])
    np.testing.assert_array_equal(np.asarray(rows), expected)
    np.testing.assert_array_equal(np.stack(list(rows)), expected)
    np.testing.assert_array_equal(rows[-1], expected[-1])
    with pytest.raises(IndexError):
        _ = rows[400]


def test_empty_rows_keep_their_shape():
    assert np.asarray(Rows(4, 4)).shape == (0, 4, 4)


def test_covariances_come_back_as_they_were_given():
    atlas, told = Atlas(voxel_m=0.05), np.diag(np.arange(1.0, 7.0))
    told[0, 5] = told[5, 0] = 0.25
    atlas.begin_session("laser", se3.identity())
    atlas.add(1, se3.identity(), "laser", told)
    np.testing.assert_array_equal(atlas.last_covariance, told)
    atlas.add(2, se3.identity(), "laser", None)
    assert atlas.last_covariance is None


def test_events_that_are_packed_come_back_and_are_in_the_file_once(tmp_path):
    log = EventLog(tmp_path / "events.jsonl")
    for stamp_ns in range(3000):
        log.add("vote", stamp_ns, scene="Dark", value=0.1 + stamp_ns)
        log.flush()
    log.close()
    assert [one["stamp_ns"] for one in log.events] == list(range(3000))
    assert log.events[0] == {"event": "vote", "stamp_ns": 0, "scene": "Dark", "value": 0.1}
    assert log.since(10) == list(log.events[10:]) and len(log.since(2990)) == 10
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == list(log.events)


def cloud(shift_m=0.0):
    """Return a square metre of points 1 cm apart, and as many landmarks."""
    x, y = np.meshgrid(np.arange(0, 1, 0.01), np.arange(0, 1, 0.01))
    points = np.stack([x.ravel() + 0.005 + shift_m, y.ravel() + 0.005, 0 * x.ravel()], axis=1)
    points = points.astype(np.float32)
    count = len(points)
    return MapLayers(
        points=PointLayer(points=points, colors_bgr=np.zeros((count, 3), np.uint8)),
        landmarks=LandmarkLayer(
            points=points,
            first_stamps_ns=np.arange(count),
            sightings=np.ones(count, np.int64),
        ),
    )


def drive(atlas, clouds, *, is_live=False):
    atlas._budget.open(is_live=is_live)
    for layers in clouds:
        session = atlas.begin_session("rgbd", se3.identity())
        atlas.close_session(session, layers, Trajectory.empty())
    atlas.finish()
    return atlas.fuse_maps()


@pytest.mark.parametrize("is_live", [False, True])
def test_what_was_seen_before_is_not_kept_again_beyond_the_limit(is_live):
    atlas = Atlas(voxel_m=0.01, budget_mb=1.0)
    fused = drive(atlas, [cloud()] * 9, is_live=is_live)
    assert len(fused.points.points) == 10_000
    held = sum(len(session.layers.points.points) for session in atlas._sessions)
    assert len(atlas._sessions[0].layers.points.points) == 10_000
    if not is_live:  # in another thread it may be done a session later
        assert held * (15 + 28) <= 1e6  # with as many landmarks


def test_new_ground_beyond_the_limit_is_kept_more_coarsely():
    atlas = Atlas(voxel_m=0.01, budget_mb=1.0)
    fused = drive(atlas, [cloud(shift_m) for shift_m in range(9)])
    seen_m = np.unique(np.floor(fused.points.points[:, 0]))
    assert len(fused.points.points) * (15 + 28) <= 1e6 and list(seen_m) == list(range(9))
    assert len(fused.points.colors_bgr) == len(fused.points.points)
    assert len(fused.landmarks.sightings) == len(fused.landmarks.points)


def layers(*x_m, stamp_ns=0):
    points = np.array([[x, 0.0, 0.0] for x in x_m], np.float32)
    count = len(points)
    return MapLayers(
        points=PointLayer(points=points, colors_bgr=np.full((count, 3), stamp_ns, np.uint8)),
        landmarks=LandmarkLayer(
            points=points,
            first_stamps_ns=stamp_ns + np.arange(count),
            sightings=stamp_ns + np.arange(count),
        ),
    )


def test_thinning_keeps_the_first_point_per_module_and_voxel_of_the_map():
    own = Budget(limit_mb=301e-6, voxel_m=0.1)
    placed = [("a", 0.0), ("b", 0.0), ("a", 5.0)]
    given = [layers(0.01, 0.06, 0.31), layers(0.01), layers(-5.0, -4.5, -3.0, stamp_ns=7)]
    sessions = [
        OpenSession(module, se3.from_xy_yaw(x_m, 0.0, 0.0), layers=one)
        for (module, x_m), one in zip(placed, given, strict=True)
    ]
    sessions.append(OpenSession("c", se3.identity()))
    own.open(is_live=False)
    own.keep(sessions)
    # 7 points of 15 bytes each and 7 landmarks of 28
    assert [session.layers for session in sessions[:3]] == given
    sessions[3].layers = MapLayers(points=layers(9.0, 9.01).points)
    own.keep(sessions)
    kept = [session.layers for session in sessions]
    found = [np.rint(100 * one.points.points[:, 0]).tolist() for one in kept]
    assert found == [[1], [1], [-300], [900]]  # in voxels of 0.8 m: half of the limit
    assert kept[2].points.colors_bgr.tolist() == [[7] * 3]
    seen = kept[2].landmarks
    assert (seen.first_stamps_ns.tolist(), seen.sightings.tolist()) == ([9], [9])
    assert seen.points[:, 0].tolist() == [-3.0]
    own.close()


def test_a_budget_that_holds_nothing_leaves_a_few_points():
    fused = drive(Atlas(voxel_m=0.01, budget_mb=1e-9), [cloud(shift_m) for shift_m in range(9)])
    assert 0 < len(fused.points.points) <= 8 * 9


@pytest.mark.parametrize("is_live", [False, True])
def test_maps_that_cannot_be_thinned_stay_and_the_run_ends_well(monkeypatch, is_live):
    monkeypatch.setattr("sceneslam.atlas.budget.one_per_voxel", lambda *_: 1 / 0)
    atlas = Atlas(voxel_m=0.01, budget_mb=1e-3)
    assert len(drive(atlas, [cloud()], is_live=is_live).points.points) == 10_000
    assert atlas.finish()[0] == "the maps could not be thinned: ZeroDivisionError: division by zero"


def test_scans_beyond_the_limit_are_thinned_to_every_second_one():
    scans = ScanLayer(
        stamps_ns=np.arange(64),
        T_world_laser=np.tile(np.eye(4), (64, 1, 1)),
        ranges_m=np.ones((64, 100), np.float32),
        angle_min_rad=np.zeros(64),
        angle_step_rad=np.full(64, 0.01),
        cell_m=0.05,
    )
    session = OpenSession("a", np.eye(4), layers=MapLayers(scans=scans))
    thin([session], 0.1, 64 * 600)  # half of that is for 35 scans
    assert session.layers.scans.stamps_ns.tolist() == list(range(0, 64, 2))
    assert session.layers.scans.ranges_m.shape == (32, 100)
    assert not np.shares_memory(session.layers.scans.ranges_m, scans.ranges_m)  # those are freed
    thin([session], 0.1, 1.0)
    assert session.layers.scans.stamps_ns.tolist() == [0]


def test_the_budget_is_checked():
    with pytest.raises(ConfigError, match="budget_mb"):
        Atlas(voxel_m=0.01, budget_mb=0.0)


def test_ten_slowest_poses_are_kept_the_slowest_first():
    slowest = Slowest()
    for latency_ms in [5.0, 50.0, 1.0, *range(10, 30)]:
        if slowest.has_room(latency_ms):
            slowest.add(
                SlowPose(stamp_ns=0, latency_ms=latency_ms, parts_ms={}, cpu_ms=0.0, beside=())
            )
    assert [pose.latency_ms for pose in slowest.poses] == [50.0, *range(29, 20, -1)]
