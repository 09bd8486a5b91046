"""The map during a run, where loops and a loaded map have moved it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_one_map import atlas, world

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting.map_files import load_map_files
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.experiments.one_map.drive import RIG, Drive, Odometry
from sceneslam.modules.maps import live_map
from sceneslam.modules.maps.live_map import GridAndPoints
from sceneslam.scans.occupancy_grid import OccupancyGrid
from sceneslam.testing.floor_plans import FLAT_TOUR, Scanner, World, box, flat, through
from sceneslam.types import se3
from sceneslam.types.grid_frames import resampled
from sceneslam.types.maps import GridLayer, MovedMap
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor

S = 1_000_000_000


class Shown:
    """An atlas whose map is shown as a sink does it."""

    def __init__(self, shown):
        self._atlas = shown
        self.mapper = GridAndPoints(resolution_m=0.05, voxel_m=0.05, depth_stride_px=8)
        self.mapper.open(RIG)

    def __getattr__(self, name):
        return getattr(self._atlas, name)

    def observe(self, observation, up_base):
        self._atlas.observe(observation, up_base)
        moved = self._atlas.take_moved()
        if moved is not None:
            self.mapper.move(moved)
        T_map_base = self._atlas.pose_at(observation.stamp_ns)
        self.mapper.add(observation, T_map_base, T_map_base)


def shares(shown, final):
    """Return the share of the walls shown that the final grid has, and the other way round."""
    size = final.log_odds.shape[::-1]
    grid = shown.mapper.map().grid
    seen = resampled(se3.identity(), grid, final.origin_xy_m, final.resolution_m, size) > 0
    due = final.log_odds > 0
    near = [cv2.dilate(walls.astype(np.uint8), np.ones((3, 3))) > 0 for walls in (due, seen)]
    return np.mean(near[0][seen]), np.mean(near[1][due])


def test_a_run_that_is_found_shows_the_loaded_map_around_it(tmp_path):
    made = Drive(atlas(save=str(tmp_path / "map"))).go(world(flat()), through(FLAT_TOUR))
    assert made.faults == []
    shown = Shown(atlas(load=str(tmp_path / "map")))
    true = through([(7.3, 0.9), (9.2, 1.0), (9.3, 2.0), (5.2, 2.0)])
    assert Drive(shown).go(world(flat(), 5), true).of_kind("relocalized")
    right, found = shares(shown, shown.fuse_maps().grid)
    assert right > 0.99 and found > 0.95  # as reported then, without the loaded map: 0.81, 0.81


def test_loops_move_the_walls_that_are_shown(tmp_path):
    shown = Shown(atlas(save=str(tmp_path / "map")))
    true = np.concatenate([through(FLAT_TOUR), through(FLAT_TOUR)])
    odometry = Odometry(scale=0.03, turn_rad_per_m=0.006)
    drive = Drive(shown, turn_deviation=0.006).go(world(flat()), true, odometry=odometry)
    assert drive.of_kind("loop")
    right, _ = shares(shown, grid_of(load_map_files(tmp_path / "map").plan()))
    assert right > 0.99  # as reported then: 0.94


@pytest.mark.parametrize(("count", "share"), [(30, 0.99), (300, 0.7)])
def test_far_walls_and_free_space_do_not_vanish(count, share, monkeypatch):
    """Of many scans some are left out, and with them walls that one beam alone has met."""
    monkeypatch.setattr(live_map, "_SCANS", 100)
    mapper = GridAndPoints(resolution_m=0.05, voxel_m=0.05, depth_stride_px=8)
    mapper.open(RIG)
    scanner = Scanner(beams=360, field_rad=2 * np.pi, range_m=60.0, noise_m=0.0)
    hall = World(box(-20.0, -15.0, 40.0, 15.0), np.random.default_rng(0), scanner)
    for index in range(count):
        x_m = 10.0 * index / count
        seen = Observation(stamp_ns=index, scan=hall.scan(np.array([x_m, 0.0, 0.0]), index))
        mapper.add(seen, *[se3.from_xy_yaw(x_m, 0.0, 0.0)] * 2)
    before = mapper.map().grid
    mapper.move(MovedMap(loaded=None, moved=lambda _, T: se3.from_xy_yaw(1.0, 0.0, 0.0) @ T))
    after = mapper.map().grid
    for is_shown in (lambda grid: grid.log_odds < -1.0, lambda grid: grid.log_odds > 0.5):
        assert is_shown(after).sum() > share * is_shown(before).sum()


def test_scans_that_are_kept_are_spread_over_all_of_the_path(monkeypatch):
    monkeypatch.setattr(live_map, "_SCANS", 100)
    mapper, moved = GridAndPoints(resolution_m=0.05, voxel_m=0.05, depth_stride_px=8), []
    mapper.open(RIG)
    scan = world(flat()).scan(np.array([1.0, 1.0, 0.0]), 0)
    for index in range(1000):
        seen = Observation(stamp_ns=index, scan=replace(scan, stamp_ns=index))
        mapper.add(seen, np.eye(4), np.eye(4))
    mapper.move(MovedMap(loaded=None, moved=lambda ns, T: moved.extend(ns.tolist()) or T))
    assert moved == list(range(0, 1000, 16))


def test_points_move_with_the_poses_that_they_were_seen_from():
    mapper = GridAndPoints(resolution_m=0.05, voxel_m=0.05, depth_stride_px=1)
    camera = Camera(fx=10.0, fy=10.0, cx=1.0, cy=1.0, size_wh=(3, 3))
    mapper.open(Rig(sensors=frozenset({Sensor.DEPTH}), camera=camera))
    poses = [se3.from_xy_yaw(x_m, 0.0, 0.0) for x_m in (0.0, 10.0)]
    for stamp_ns, pose in enumerate(poses):
        mapper.add(Observation(stamp_ns=stamp_ns, depth_m=np.ones((3, 3), np.float32)), pose, pose)
    before = mapper.map().points.points
    T_new_old = np.array([np.eye(4), se3.from_xy_yaw(0.0, 3.0, 0.0)])

    def moved(stamps_ns, T_map_base):
        return T_new_old[stamps_ns] @ T_map_base

    for _ in range(2):  # the second time, it starts from where they are
        mapper.move(MovedMap(loaded=None, moved=moved))
    after = mapper.map().points.points
    is_second = before[:, 0] > 5.0
    expected = before + np.where(is_second, 6.0, 0.0)[:, None] * [0.0, 1.0, 0.0]
    order, due = np.lexsort(after.T), np.lexsort(expected.T)
    np.testing.assert_allclose(after[order], expected[due], atol=1e-5)


def test_points_that_loops_move_together_are_one():
    """It drives along a wall again and again; each time, a loop takes the drift out."""
    mapper = GridAndPoints(resolution_m=0.05, voxel_m=0.05, depth_stride_px=4)
    camera = Camera(fx=70.0, fy=70.0, cx=39.5, cy=29.5, size_wh=(80, 60))
    mapper.open(Rig(sensors=frozenset({Sensor.DEPTH}), camera=camera))
    counts, depth_m = [], np.full((60, 80), 2.0, np.float32)
    for lap in range(4):
        for index in range(20):
            pose = se3.from_xy_yaw(0.2 * index, 0.015 * index if lap else 0.0, np.pi / 2)
            seen = Observation(stamp_ns=100 * lap + index, depth_m=depth_m)
            mapper.add(seen, pose, pose)

        def moved(stamps_ns, T_map_base, lap=lap):
            T_new_base = T_map_base.copy()
            T_new_base[stamps_ns >= 100 * lap, 1, 3] = 0.0
            return T_new_base

        mapper.move(MovedMap(loaded=None, moved=moved))
        counts.append(len(mapper.map().points.points))
    assert max(counts) < 1.4 * counts[0] and len(mapper._poses) <= 2 * 20


class Placed:
    """What of a run's map counts here: whether the robot was found in the loaded one."""

    is_placed = False

    def rewind(self, stamp_ns):
        pass

    def loaded_grid(self):
        return None

    def close(self):
        pass


class Drawn:
    """An atlas, and its poses as a sink has them; it drives along x, 1 m per second."""

    def __init__(self):
        self.atlas, self.mapper, self.poses = Atlas(voxel_m=0.05), Placed(), {}
        self.atlas._mapper = self.mapper
        self.atlas.begin_session("only", se3.identity())

    def go(self, *seconds):
        for at in seconds:
            self.atlas.add(at * S, se3.from_xy_yaw(at, 0.0, 0.0), "only")
            moved = self.atlas.take_moved()
            for key in self.poses if moved is not None else ():
                (self.poses[key],) = moved.moved(np.array([key * S]), self.poses[key][None])
            self.poses[at] = self.atlas.pose_at(at * S)
        return self

    def correct(self, nodes):
        stamps_ns = np.array(list(nodes)) * S
        T_new_old = np.array([se3.from_xy_yaw(*moved, 0.0) for moved in nodes.values()])
        self.atlas.correct(Correction(stamps_ns=stamps_ns, T_new_old=T_new_old))


def test_what_is_drawn_after_a_rewind_is_moved_from_where_it_is():
    drawn = Drawn().go(*range(21))
    drawn.correct({0: (0.0, 0.0), 15: (0.0, 0.0), 20: (0.0, 1.0)})
    drawn.go(21).atlas.rewind(17 * S, se3.identity())
    drawn.go(*range(17, 30)).correct({20: (0.0, 0.0), 25: (0.0, 0.0), 29: (0.0, 0.06)})
    drawn.go(30)
    np.testing.assert_allclose(drawn.poses[25][:2, 3], [25.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(drawn.poses[30][:2, 3], [30.0, 0.06], atol=1e-9)


@pytest.mark.parametrize("is_placed", [True, False])
def test_what_is_drawn_follows_a_run_that_goes_on_without_its_map(is_placed):
    drawn = Drawn().go(*range(10))
    drawn.mapper.is_placed = is_placed
    drawn.correct({0: (10.0, 5.0)})
    drawn.go(10).atlas._give_up(RuntimeError("no space left"))
    drawn.go(11)
    for at in (5, 10, 11):
        np.testing.assert_allclose(drawn.poses[at][:2, 3], [at, 0.0], atol=1e-9)


def test_what_is_moved_to_and_fro_stays_where_it_was():
    turned = [se3.from_xy_yaw(0.0, 0.0, 0.02 * node) for node in range(10)]
    stamps_ns, at_ns = np.arange(10) * S, np.arange(9) * S + S // 2
    one = Correction(stamps_ns=stamps_ns, T_new_old=np.array(turned))
    other = Correction(stamps_ns=stamps_ns, T_new_old=se3.from_xy_yaw(0.0, 0.06, 0.0) @ turned)
    poses = before = np.tile(se3.from_xy_yaw(60.0, 60.0, 0.0), (9, 1, 1))
    for _ in range(50):
        poses = one.moved(other, at_ns, other.moved(one, at_ns, poses))
    np.testing.assert_allclose(poses, before, atol=1e-9)


@pytest.mark.parametrize("cell_m", [0.05, 0.02, 0.1, 0.2])
def test_a_wall_stays_in_a_grid_with_cells_of_another_size(cell_m):
    log_odds = np.full((40, 40), -3.0, np.float32)
    log_odds[11] = 3.0
    layer = GridLayer(log_odds=log_odds, resolution_m=0.05, origin_xy_m=(-1.0, 2.0))
    grid = OccupancyGrid.of(layer, cell_m).layer()
    row = int(np.floor((2.0 + 11.5 * 0.05 - grid.origin_xy_m[1]) / cell_m + 1e-9))
    assert (grid.log_odds[row, : int(2.0 / cell_m)] > 2.9).all()
    assert (grid.log_odds < -2.9).sum() > 0.7 * grid.log_odds.size
