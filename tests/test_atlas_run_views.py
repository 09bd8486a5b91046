"""What a camera sees during a run: kept with its submaps, and recognized when it comes back."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_maps import WALL, edge, map_of
from test_atlas_submaps import at
from test_atlas_view_loops import viewed
from test_rgbd import make
from test_view_merge import seen_from

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.places.view_taker import ViewTaker
from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.graph import on_floor
from sceneslam.atlas.submaps.plan_loops import PlanLoops
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.testing.room import RIG, observation_at
from sceneslam.types import se3
from sceneslam.types.maps import GridLayer, MapLayers
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import BRIDGED
from sceneslam.types.trajectory import Trajectory

# Views of submaps that a hand-over replaces.

STEP = at(0.6, 0.1, 0.2)  # from submap to submap: far enough that each view is compared
T_WORLD_PLACE = [at(), at(0.3, -0.4, 1.0), at(-0.2, 0.5, -1.0)]


def chain_of(*places):
    """A chain of submaps each of which sees one of the places, None: nothing; they drift widely."""
    chain, T_world_node = Chain(), at()
    submaps = map_of(*[WALL] * len(places), runs=[0] * len(places)).submaps
    for node, number in enumerate(places):
        seen = []
        if number is not None:
            T_place_view = se3.inverse(T_WORLD_PLACE[number]) @ T_world_node
            seen = [(at(), seen_from(T_place_view, number))]
        motion = replace(
            edge(node - 1, node), T_first_second=STEP, covariance=on_floor(np.diag([0.3**2] * 3))
        )
        chain.append(viewed(submaps[node], *seen), T_world_node, motion if node else None)
        T_world_node = T_world_node @ STEP
    return chain


def loops_of(found):
    return sorted((one.first, one.second) for one in found.loops)


def test_after_a_rewind_views_are_compared_with_those_that_are_left_and_those_that_came():
    graph = RunGraph(empty_map(), lambda session: False)
    before = graph.extend(chain_of(0, 1, 2, 0, 1, 2), is_level=False)
    assert loops_of(before) == [(0, 3), (1, 4), (2, 5)]
    graph.forget(2)
    after = graph.extend(chain_of(0, 1, None, 1, 0, 2), is_level=False)
    assert loops_of(after) == [(0, 4), (1, 3)]  # nothing but what is gone showed place 2
    for one in after.loops:
        expected = np.linalg.matrix_power(STEP, one.second - one.first)
        np.testing.assert_allclose(one.T_first_second, expected, atol=1e-5)


def test_views_of_a_search_that_was_interrupted_are_kept(monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    graph, places = RunGraph(empty_map(), lambda session: False), (0, 1, 2, 0)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(PlanLoops, "loops_to", stopped)
        graph.extend(chain_of(*places), is_level=True)
    chain, whole = chain_of(*places), chain_of(*places)
    graph.extend(chain, is_level=False)
    RunGraph(empty_map(), lambda session: False).extend(whole, is_level=False)
    for one, other in zip(chain.submaps, whole.submaps, strict=True):
        assert len(one.views) == len(other.views)


def test_neighbouring_submaps_get_no_loop_even_across_a_handover():
    graph = RunGraph(empty_map(), lambda session: False)
    chain = chain_of(None, 0, 0, 1, 1)
    assert [one.session for one in chain.submaps] == [0, 0, 1, 1, 2]
    assert loops_of(graph.extend(chain, is_level=False)) == []


# A robot that comes back.

LAP, STEP_NS, START_NS = 95, 160_000_000, 10**9  # one step: 0.06 m
T_DRIFT = se3.from_xy_yaw(0.12, -0.05, 0.06)  # of what led from the first session to the second
SEEING = Rig(sensors=frozenset({Sensor.IMAGE, Sensor.DEPTH, Sensor.ODOMETRY}), camera=RIG.camera)


def room_at(index):
    """The pose in the room on a circle of 0.9 m, which takes a lap."""
    return se3.from_xy_yaw(0.3, 0.0, 2 * np.pi * index / LAP) @ se3.from_xy_yaw(0.0, -0.9, 0.0)


def true_pose(index):
    return se3.inverse(room_at(0)) @ room_at(index)


def look(index):
    one = observation_at(room_at(index), 0.0)
    return replace(
        one, stamp_ns=START_NS + index * STEP_NS, scan=None, points_lidar=None, T_odom_base=None
    )


class Lapping:
    """An atlas that follows a robot on its circle."""

    def __init__(self, **settings):
        self.atlas, self.loops = Atlas(voxel_m=0.05, save=settings.pop("save", None)), []
        self.atlas.open(SEEING, self._note, **settings)

    def _note(self, event, stamp_ns, **fields):
        if event == "loop":
            self.loops.append((stamp_ns, fields))

    def see(self, module, indices, T_map_local):
        """One session of a module at T_map_local; a module that is given tracks the images."""
        own = make(rig=SEEING) if module == "rgbd" else None
        first, session = indices[0], self.atlas.begin_session(module, T_map_local)
        for index in indices:
            observation = look(index)
            T_local_base = se3.inverse(true_pose(first)) @ true_pose(index)
            if own is not None:
                T_local_base = own.track(observation).T_local_base
            self._add(observation, T_map_local @ T_local_base, module, T_local_base)
        layers = MapLayers() if own is None else own.get_map()
        revised = Trajectory.empty() if own is None else own.get_trajectory()
        self.atlas.close_session(session, layers, revised)
        if own is not None:
            own.shutdown()

    def bridge(self, indices):
        """Dead reckoning through the dark, which drifts by T_DRIFT."""
        for index in indices:
            share = (index - indices[0] + 1) / len(indices)
            T_map_base = se3.exp(share * se3.log(T_DRIFT)) @ true_pose(index)
            dark = replace(look(index), image_bgr=None, depth_m=None)
            self._add(dark, T_map_base, BRIDGED)

    def _add(self, observation, T_map_base, module, T_local_base=None):
        if T_local_base is not None:
            self.atlas.add_local(observation.stamp_ns, T_local_base)
        self.atlas.add(observation.stamp_ns, T_map_base, module)
        self.atlas.observe(observation, None)

    def errors_m(self, trajectory):
        """How far poses are from the true ones in `map`."""
        index = (trajectory.stamps_ns - START_NS) // STEP_NS
        due = np.stack([true_pose(one) for one in index.tolist()])
        return np.linalg.norm(trajectory.positions_m - due[:, :3, 3], axis=1)


@pytest.fixture(scope="module")
def returned():
    """Lap with rgbd, in the dark, and with rgbd again; only views close loops."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PlanLoops, "loops_to", lambda *_: [])
        drive = Lapping(closing=["rgbd"])
        drive.see("rgbd", range(LAP), se3.identity())
        drive.bridge(range(LAP, 2 * LAP))
        drive.see("rgbd", range(2 * LAP, 3 * LAP), T_DRIFT @ true_pose(2 * LAP))
        before = len(drive.loops)
        assert drive.atlas.finish() == []
    return drive, before


def test_second_session_of_rgbd_gets_loops_to_its_first_one_and_no_session_to_itself(returned):
    drive, _ = returned
    assert len(drive.loops) >= 2
    for stamp_ns, fields in drive.loops:
        assert (fields["module"], fields["to_module"]) == ("rgbd", "rgbd")
        first, second = ((ns - START_NS) // STEP_NS for ns in (fields["to_ns"], stamp_ns))
        assert first < LAP and second >= 2 * LAP


def test_poses_come_back_to_the_map_while_the_second_session_goes_on(returned):
    drive, before = returned
    again = drive.errors_m(drive.atlas.online)[2 * LAP :]
    assert before >= 2
    assert again.max() > 0.12 and (again[-4:] < 0.05).all()
    assert (drive.errors_m(drive.atlas.trajectory) < 0.05).all()


def test_the_second_lap_adds_no_views_of_what_the_first_one_saw(returned):
    drive, _ = returned
    views = [
        (view.stamp_ns - START_NS) // STEP_NS
        for one in drive.atlas._mapper.saved().submaps
        for view in one.views
    ]
    assert sum(index < LAP for index in views) > 15
    assert sum(index >= 2 * LAP for index in views) <= 2


@pytest.mark.parametrize(
    ("settings", "is_kept"),
    [({"is_looking": False}, False), ({"is_looking": True}, True), ({}, True)],
)
@pytest.mark.parametrize("is_saved", [False, True])
def test_views_are_kept_to_recognize_places_and_in_a_map_that_is_saved(
    tmp_path, settings, is_kept, is_saved
):
    drive = Lapping(**settings, save=str(tmp_path / "map") if is_saved else None)
    drive.see("a", range(0, LAP // 2, 3), se3.identity())
    assert drive.atlas.finish() == []
    views = [view for one in drive.atlas._mapper.saved().submaps for view in one.views]
    assert (len(views) > 5) if is_kept or is_saved else views == []


# A robot whose camera measures no depth.


def true_path(stamp_ns):
    return true_pose((stamp_ns - START_NS) // STEP_NS)


def lapped(indices, *, loaded=None, note=lambda *_, **__: None):
    """A mapper that saw a part of the circle."""
    mapper = Mapper(
        replace(SEEING, sensors=frozenset({Sensor.IMAGE, Sensor.ODOMETRY})),
        known=lambda ns: Known(T_map_base=true_path(ns), session=0, module="a", covariance=None),
        note=note,
        loaded=loaded,
        keeps_views=True,
    )
    for index in indices:
        mapper.observe(replace(look(index), depth_m=None), None)
    return mapper


def test_a_camera_without_depth_finds_itself_in_a_map_of_its_own():
    mapped = lapped(range(LAP))
    mapped.finish(true_path, [])
    saved, events = mapped.saved(), []
    views = [view for submap in saved.submaps for view in submap.views]
    assert len(views) > 5
    assert all((view.landmarks.deviation_m > 0.0).all() for view in views)
    found = lapped(range(40, 60), loaded=saved, note=lambda event, *_, **__: events.append(event))
    assert events[0] == "relocalized"
    off = found.T_map_run  # the run's poses are those of the map
    assert np.linalg.norm(off[:3, 3]) < 0.03 and se3.rotation_angle_rad(off) < 0.017


@pytest.mark.parametrize(("jump_m", "is_located"), [(0.0, True), (0.2, False)])
def test_no_corner_is_located_across_a_jump_of_the_path(jump_m, is_located):
    """The path goes on 0.2 m ahead: as if the views were farther apart."""
    taker = ViewTaker(replace(SEEING, sensors=frozenset({Sensor.IMAGE})), is_keeping=True)
    for index in range(7):
        T_run_base = true_pose(index) @ se3.from_xy_yaw(jump_m * (index == 6), 0.0, 0.0)
        taker.move(START_NS + index * STEP_NS, T_run_base)
        if index % 2 == 0:
            view = taker.take(replace(look(index), depth_m=None))
            found = taker.locate(view, START_NS + index * STEP_NS, T_run_base)
    assert (found is not None) == is_located


def seen_by_camera(indices, grid=None, **options):
    """Return an atlas of a run whose camera has no depth; its module gives a grid."""
    atlas = Atlas(voxel_m=0.05, **options)
    sensors = frozenset({Sensor.IMAGE, Sensor.ODOMETRY})
    atlas.open(replace(SEEING, sensors=sensors), lambda *_, **__: None)
    atlas.begin_session("camera", np.eye(4))
    for index in indices:
        T = se3.inverse(true_pose(indices[0])) @ true_pose(index)
        seen = replace(look(index), depth_m=None)
        atlas.add_local(seen.stamp_ns, T)
        atlas.add(seen.stamp_ns, T, "camera", np.eye(6) * 1e-6)
        atlas.observe(seen, None)
    atlas.close_session(0, MapLayers(grid=grid), Trajectory.empty())
    assert not atlas.finish()
    return atlas


def test_a_run_that_is_found_by_views_alone_keeps_its_grid(tmp_path):
    seen_by_camera(range(LAP), save=str(tmp_path / "map"))
    own = GridLayer(log_odds=np.ones((8, 9), np.float32), resolution_m=0.05, origin_xy_m=(-2, -2))
    for grid in (own, None):
        atlas = seen_by_camera(range(40, 80), grid, load=str(tmp_path / "map"), mode="localize")
        fused = atlas.fuse_maps().grid
        assert atlas._mapper.is_placed and (fused is None) == (grid is None)
        assert fused is None or fused.log_odds.any()


def blind_taker():
    return ViewTaker(replace(SEEING, sensors=frozenset({Sensor.IMAGE})), is_keeping=True)


def followed(taker, path, indices):
    """Submaps of a path, by stamp, that sees the room from every second of its poses."""

    def known(stamp_ns):
        return Known(T_map_base=path(stamp_ns), session=0, module="a", covariance=None)

    own = Collector(SEEING, known, 0, taker.locate)
    for index in indices:
        stamp_ns = START_NS + index * STEP_NS
        taker.move(stamp_ns, path(stamp_ns))
        view = taker.take(replace(look(index), depth_m=None)) if index % 2 == 0 else None
        own.add(stamp_ns, None, None, view)
    return own


def landmarks_in(own):
    own.finish()
    return {view.stamp_ns: view.landmarks for submap in own.chain.submaps for view in submap.views}


@pytest.mark.parametrize("since", [4, 30])
def test_corners_are_located_anew_when_other_poses_replace_those_they_were_seen_from(since):
    """The motion between the views was a tenth too long."""
    scale, count, taker = [1.1], 40, blind_taker()

    def path(stamp_ns):
        T = true_path(stamp_ns).copy()
        T[:3, 3] *= scale[0] if stamp_ns >= START_NS + since * STEP_NS else 1.0
        return T

    own = followed(taker, path, range(count))
    scale[0] = 1.0
    own.rewind(START_NS + since * STEP_NS)
    taker.rewind(START_NS + since * STEP_NS)
    found, due = landmarks_in(own), landmarks_in(followed(blind_taker(), true_path, range(count)))
    assert found.keys() == due.keys() and len(due) > 10
    for stamp_ns, landmarks in due.items():
        np.testing.assert_array_equal(found[stamp_ns].points_cam, landmarks.points_cam)


@pytest.mark.parametrize("is_rewound", [False, True])
def test_no_corner_is_located_across_a_jump_also_after_a_rewind(is_rewound):
    jump = 20

    def path(stamp_ns):
        is_after = stamp_ns >= START_NS + jump * STEP_NS
        return se3.from_xy_yaw(0.3 * is_after, 0.0, 0.0) @ true_path(stamp_ns)

    taker = blind_taker()
    own = followed(taker, path, range(40))
    if is_rewound:
        own.rewind(START_NS + 10 * STEP_NS)
        taker.rewind(START_NS + 10 * STEP_NS)
    stamps = (np.array(sorted(landmarks_in(own))) - START_NS) // STEP_NS
    assert (stamps < jump).any() and (stamps > jump + 8).any()
    assert not ((stamps >= jump) & (stamps <= jump + 2)).any()  # too near to the first after it


def test_a_robot_whose_camera_is_mounted_elsewhere_finds_itself_in_the_map():
    """It looks at the same wall over its left shoulder, from 0.3 m above and 0.1 m behind."""
    mapped = lapped(range(LAP))
    mapped.finish(true_path, [])
    T_base_other = se3.from_xy_yaw(-0.1, 0.0, 2.0)  # where the first robot's base is, in the other
    T_base_other[2, 3] = 0.3
    mounted = replace(SEEING.camera, T_base_cam=T_base_other @ SEEING.camera.T_base_cam)
    other = Mapper(
        replace(SEEING, camera=mounted, sensors=frozenset({Sensor.IMAGE, Sensor.ODOMETRY})),
        known=lambda ns: Known(
            T_map_base=true_path(ns) @ se3.inverse(T_base_other),
            session=0,
            module="a",
            covariance=None,
        ),
        note=lambda *_, **__: None,
        loaded=mapped.saved(),
        keeps_views=True,
    )
    for index in range(40, 60):
        other.observe(replace(look(index), depth_m=None), None)
    off = other.T_map_run
    assert other.is_placed
    assert np.linalg.norm(off[:3, 3]) < 0.03 and se3.rotation_angle_rad(off) < 0.017


def test_an_image_without_depth_is_not_kept_where_others_have_it():
    taker = ViewTaker(SEEING, is_keeping=True)
    assert taker.is_kept(look(0), true_pose(0))
    assert not taker.is_kept(replace(look(0), depth_m=None), true_pose(0))
