"""What the bus accepts of a module's answers, up to the limits."""

from dataclasses import replace
from unittest.mock import Mock

import hostile
import numpy as np
import pytest
from fakes import ExactModule, observation

from sceneslam.answers import checked_layers, checked_tracking, checked_trajectory
from sceneslam.atlas.fusion import Placed, fuse
from sceneslam.atlas.save import save_points
from sceneslam.storage.journal import Journal, JournalHeader, read_journal
from sceneslam.types import se3
from sceneslam.types.maps import (
    LAYER_TYPES,
    GridLayer,
    LandmarkLayer,
    MapLayers,
    PointLayer,
    PoseGraphLayer,
    ScanLayer,
)
from sceneslam.types.trajectory import Trajectory

USABLE = {"covariance huge", "a complex pose"}  # odd, but every number that is used is finite
USABLE_MAPS = {"a cloud beyond all measure"}
USABLE_TRAJECTORIES = {"stamps of another time"}


def tracked():
    module = ExactModule()
    module.activate(None)
    return module.track(observation(7))


STAMP_NS = observation(7).stamp_ns


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", sorted(set(hostile.ANSWERS) - USABLE))
def test_an_invalid_answer_is_refused(name):
    with pytest.raises((TypeError, ValueError)):
        checked_tracking(hostile.ANSWERS[name](tracked()), STAMP_NS)


@pytest.mark.parametrize("name", sorted(set(hostile.MAPS) - USABLE_MAPS))
def test_an_invalid_map_is_refused(name):
    with pytest.raises((TypeError, ValueError)):
        checked_layers(hostile.MAPS[name])


@pytest.mark.parametrize("name", sorted(set(hostile.TRAJECTORIES) - USABLE_TRAJECTORIES))
def test_an_invalid_trajectory_is_refused(name):
    with pytest.raises((TypeError, ValueError)):
        checked_trajectory(hostile.TRAJECTORIES[name])


def with_pose(x_m=0.0, scale=1.0):
    T_local_base = se3.from_xy_yaw(x_m, 0.0, 0.3)
    T_local_base[:3, :3] *= scale
    return {"T_local_base": T_local_base}


@pytest.mark.parametrize(
    ("good", "bad"),
    [
        ({"quality_ratio": 0.0}, {"quality_ratio": -0.01}),
        ({"quality_ratio": 1.0}, {"quality_ratio": 1.01}),
        ({"inliers": 0}, {"inliers": -1}),
        ({"covariance": np.zeros((6, 6))}, {"covariance": np.diag([1.0] * 5 + [-1e-9])}),
        (with_pose(x_m=0.99e8), with_pose(x_m=1.01e8)),
        (with_pose(x_m=-0.99e8), with_pose(x_m=-1.01e8)),
        (with_pose(scale=1.00049), with_pose(scale=1.00051)),
        (with_pose(scale=0.99951), with_pose(scale=0.99949)),
    ],
)
def test_an_answer_is_accepted_up_to_the_limits(good, bad):
    assert checked_tracking(replace(tracked(), **good), STAMP_NS).stamp_ns == STAMP_NS
    with pytest.raises(ValueError, match="expected"):
        checked_tracking(replace(tracked(), **bad), STAMP_NS)


@pytest.mark.parametrize("name", ["T_local_base", "covariance"])
def test_a_checked_array_is_a_copy_that_nobody_changes(name):
    given = replace(tracked(), covariance=np.eye(6))
    checked = getattr(checked_tracking(given, STAMP_NS), name)
    assert not checked.flags.writeable and not np.shares_memory(checked, getattr(given, name))


def test_stamps_of_a_trajectory_increase():
    poses = np.tile(np.eye(4), (3, 1, 1))
    assert len(checked_trajectory(Trajectory.empty())) == 0
    assert len(checked_trajectory(Trajectory(stamps_ns=np.arange(3), T_world_base=poses))) == 3
    with pytest.raises(ValueError, match="rising"):
        checked_trajectory(Trajectory(stamps_ns=np.array([1, 2, 2]), T_world_base=poses))


def test_covariances_of_a_trajectory_are_numbers_or_missing():
    poses, known = np.tile(np.eye(4), (2, 1, 1)), np.tile(np.eye(6), (2, 1, 1))
    given = Trajectory(stamps_ns=np.arange(2), T_world_base=poses, covariances=known)
    known[0] = np.nan
    np.testing.assert_array_equal(checked_trajectory(given).covariances, known)
    with pytest.raises(ValueError, match="covariances"):
        checked_trajectory(replace(given, covariances=known[:1]))
    known[1, 2, 3] = np.inf
    with pytest.raises(ValueError, match="covariances"):
        checked_trajectory(given)


def test_a_trajectory_of_narrow_numbers_is_kept_as_the_journal_is_read(tmp_path):
    poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    given = Trajectory(stamps_ns=np.arange(3, dtype=np.int32), T_world_base=poses)
    head = JournalHeader(title="", value_label="", wheels=None, began_in="/")
    journal = Journal(tmp_path / "journal.bin", head)
    journal.add_end(0, checked_trajectory(given))
    journal.close()
    log = Mock()
    read_journal(tmp_path / "journal.bin", log)
    revised = log.add_end.call_args.args[1]
    np.testing.assert_array_equal(revised.stamps_ns, given.stamps_ns)
    np.testing.assert_array_equal(revised.T_world_base, given.T_world_base)


POSES = np.tile(np.eye(4), (2, 1, 1))
LAYERS = {
    "points": PointLayer(points=np.ones((5, 3), np.float32), colors_bgr=np.ones((5, 3), np.uint8)),
    "grid": GridLayer(
        log_odds=np.ones((4, 7), np.float32), resolution_m=0.05, origin_xy_m=(1.0, 2.0)
    ),
    "scans": ScanLayer(
        stamps_ns=np.arange(2),
        T_world_laser=POSES,
        ranges_m=np.ones((2, 7), np.float32),
        angle_min_rad=np.zeros(2),
        angle_step_rad=np.ones(2),
        cell_m=0.05,
    ),
    "pose_graph": PoseGraphLayer(
        stamps_ns=np.arange(3),
        T_world_base=np.tile(np.eye(4), (3, 1, 1)),
        edges=np.array([[0, 1], [1, 2]]),
        T_from_to=POSES,
        information=np.ones((2, 6, 6)),
        is_loop=np.zeros(2, bool),
    ),
    "landmarks": LandmarkLayer(
        points=np.ones((5, 3), np.float32),
        first_stamps_ns=np.arange(5),
        sightings=np.ones(5, np.int32),
    ),
}
ARRAYS = [
    (name, field)
    for name, layer in LAYERS.items()
    for field in layer.__dataclass_fields__
    if isinstance(getattr(layer, field), np.ndarray)
]


@pytest.mark.parametrize("name", LAYERS)
def test_a_valid_layer_is_accepted(name):
    layers = MapLayers(**{name: LAYERS[name]})
    assert checked_layers(layers) is layers


@pytest.mark.parametrize(("name", "field"), ARRAYS)
def test_an_array_of_a_wrong_shape_is_refused_with_its_name(name, field):
    array = getattr(LAYERS[name], field)
    if (name, field) in (("grid", "log_odds"), ("scans", "ranges_m")):  # of any number of columns
        wrong = [array[0], array[None]]
    else:
        wrong = [array[..., None], *(np.delete(array, 0, axis) for axis in range(1, array.ndim))]
    for one in wrong:
        with pytest.raises(ValueError, match=rf"^{name}\.{field}: expected"):
            checked_layers(MapLayers(**{name: replace(LAYERS[name], **{field: one})}))


@pytest.mark.parametrize(("name", "field"), [one for one in ARRAYS if one[0] != "grid"])
def test_arrays_of_one_layer_have_one_length(name, field):
    layer = LAYERS[name]
    short = replace(layer, **{field: getattr(layer, field)[:-1]})
    with pytest.raises(ValueError, match=rf"^{name}\."):
        checked_layers(MapLayers(**{name: short}))


@pytest.mark.parametrize("kind", [bool, complex, object])
@pytest.mark.parametrize(("name", "field"), [one for one in ARRAYS if one[1] != "is_loop"])
def test_an_array_of_another_type_is_refused_with_its_name(name, field, kind):
    odd = getattr(LAYERS[name], field).astype(kind)
    with pytest.raises(ValueError, match=rf"^{name}\.{field}: expected numbers, got {odd.dtype}"):
        checked_layers(MapLayers(**{name: replace(LAYERS[name], **{field: odd})}))


@pytest.mark.parametrize("odd", [None, 1.0, "ab", (1.0, 2.0, 0.0), (np.nan, 0.0), (0.0, 1e9)])
def test_a_grid_has_a_corner_of_two_numbers(odd):
    grid = replace(LAYERS["grid"], origin_xy_m=odd)
    with pytest.raises(ValueError, match=r"^grid\.origin_xy_m: expected \(x, y\)"):
        checked_layers(MapLayers(grid=grid))


@pytest.mark.parametrize("value", [-1, 256, 0.5])
def test_colours_that_are_no_bytes_are_refused(value):
    points = replace(LAYERS["points"], colors_bgr=np.full((5, 3), value))
    with pytest.raises(ValueError, match=r"^points\.colors_bgr: expected 0 to 255, got"):
        checked_layers(MapLayers(points=points))


@pytest.mark.parametrize("kind", [np.uint16, np.int64])
def test_colours_of_wider_integers_are_saved_as_bytes(tmp_path, kind):
    points = replace(LAYERS["points"], colors_bgr=np.full((5, 3), 200, kind))
    layers = checked_layers(MapLayers(points=points))
    placed = Placed(module="a", T_map_local=np.eye(4), layers=layers)
    save_points(fuse([placed], voxel_m=0.05), tmp_path / "points.ply")
    assert b"property uchar red" in (tmp_path / "points.ply").read_bytes()


@pytest.mark.parametrize("kind", [np.float16, np.float64, np.longdouble, np.int8])
def test_a_grid_of_any_numbers_is_fused(kind):
    grid = replace(LAYERS["grid"], log_odds=LAYERS["grid"].log_odds.astype(kind))
    layers = checked_layers(MapLayers(grid=grid))
    placed = Placed(module="a", T_map_local=np.eye(4), layers=layers)
    fused = fuse([placed], voxel_m=0.05).grid
    assert fused.log_odds.dtype == np.float32 and (fused.log_odds == 1.0).sum() == 28


@pytest.mark.parametrize(("name", "field"), [("grid", "resolution_m"), ("scans", "cell_m")])
def test_a_grid_has_cells_of_some_size(name, field):
    for size_m in (0.0, -0.05, np.nan):
        layer = replace(LAYERS[name], **{field: size_m})
        with pytest.raises(ValueError, match=rf"^{name}\.{field}: expected"):
            checked_layers(MapLayers(**{name: layer}))


@pytest.mark.parametrize("edges", [[[0, 1], [1, 3]], [[-1, 1], [1, 2]], [[0.0, 1.0], [1.0, 2.0]]])
def test_edges_lead_between_nodes_of_the_graph(edges):
    graph = replace(LAYERS["pose_graph"], edges=np.array(edges))
    with pytest.raises(ValueError, match=r"^pose_graph\.edges: expected int64, from 0 to 2"):
        checked_layers(MapLayers(pose_graph=graph))


def test_every_type_of_layer_is_checked():
    assert set(LAYERS) == set(LAYER_TYPES)
