"""Files of saved maps: what they hold, whose they are, and when they are written."""

import hashlib
import io
import zipfile
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest
import yaml
from test_atlas_maps import WALL, S, edge, map_of
from test_atlas_places import CELL, plan_of
from test_views import place

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting import lasting_map
from sceneslam.atlas.lasting.lasting_map import LastingMap
from sceneslam.atlas.lasting.map_files import (
    HEAD,
    OLD,
    VERSION,
    SavedFiles,
    load_map_files,
    save_map_files,
)
from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.config.component import ComponentBuilder
from sceneslam.graphs.edge import EdgeKind
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.files import MARK, owned
from sceneslam.types.rig import optical_to_rep103
from sceneslam.views.view import PlacedView

ATLAS = "sceneslam.atlas.atlas.Atlas"


def whole_map():
    nodes = [[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]]
    plans = plan_of("#..", " .#"), plan_of("#")
    saved = map_of(*plans, nodes=nodes, pieces=[0, 2], runs=[0, 1], edges=[edge(0, 1)])
    first, second = saved.submaps
    landmarks = replace(place(1, 5), deviation_m=np.array([0.01, 0.3, 0.02, 1.0, 0.1], np.float32))
    seen = PlacedView(stamp_ns=S, T_submap_cam=optical_to_rep103(), landmarks=landmarks)
    first = replace(first, up=np.array([0.0, 0.6, 0.8]), views=(seen,))
    return replace(saved, submaps=(first, second))


def test_a_map_is_loaded_as_it_was_saved(tmp_path):
    saved = whole_map()
    save_map_files(saved, tmp_path)
    found = load_map_files(tmp_path)
    head = yaml.safe_load((tmp_path / HEAD).read_text())
    assert [head[key] for key in ("submaps", "edges", "runs", "pieces")] == [2, 1, 2, 2]
    assert head["modules"] == ["a", "b"] and head["cell_m"] == CELL
    with zipfile.ZipFile(tmp_path / head["arrays"]) as file:  # its bytes hold no time
        assert {entry.date_time for entry in file.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    for one, other in zip(found.submaps, saved.submaps, strict=True):
        assert (one.run, one.session, one.module) == (other.run, other.session, other.module)
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_array_equal(one.T_submap_base, other.T_submap_base)
        np.testing.assert_array_equal(one.up, other.up)
        for view, seen in zip(one.views, other.views, strict=True):
            for name in ("points_cam", "deviation_m", "descriptors"):
                kept, was = (getattr(each.landmarks, name) for each in (view, seen))
                np.testing.assert_array_equal(kept, was)
        for name in ("points", "normals", "free", "origin_xy_m"):
            np.testing.assert_array_equal(getattr(one.plan, name), getattr(other.plan, name))
    np.testing.assert_array_equal(found.T_map_node, saved.T_map_node)
    np.testing.assert_array_equal(found.pieces, [0, 2])
    (one,) = found.edges
    assert (one.first, one.second, one.kind) == (0, 1, EdgeKind.MOTION)
    np.testing.assert_array_equal(one.covariance, saved.edges[0].covariance)
    save_map_files(empty_map(), tmp_path, known=head["sha256"])
    assert load_map_files(tmp_path).submaps == () and len(list(tmp_path.iterdir())) == 2


def with_arrays(folder, harm):
    """Save a map whose arrays are harmed, under a right checksum."""
    save_map_files(whole_map(), folder)
    head = yaml.safe_load((folder / HEAD).read_text())
    path = folder / head["arrays"]
    arrays = dict(np.load(path))
    harm(arrays)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    path.write_bytes(buffer.getvalue())
    head["sha256"] = hashlib.sha256(buffer.getvalue()).hexdigest()
    (folder / HEAD).write_text(yaml.safe_dump(head))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("point", None, "point: missing among the map's arrays"),
        ("node_run", np.zeros(2), r"node_run: expected <i8 of shape \(N, \), got <f8 \(2,\)"),
        ("node_run", np.int64(0), r"node_run: expected <i8 .*, got <i8 \(\)"),
        ("node_pose", np.zeros((2, 3)), r"node_pose: expected <f8 of shape \(N, 4, 4\), got"),
        ("node_pose", np.zeros((2, 4, 4)), "node_pose: expected rotations and translations"),
        ("node_pose", np.full((2, 4, 4), np.nan), "node_pose: expected finite numbers"),
        ("node_piece", np.zeros(3, np.int64), "node_piece: expected 2 rows, got 3"),
        ("node_scans", np.array([2, 3]), "the submaps' scans do not add up to 4"),
        ("node_points", np.array([4, -1]), "the submaps' points do not add up to 3"),
        ("node_grid_shape", np.array([[9, 3], [1, 1]]), "the submaps' bytes do not add up to 2"),
        ("edge_nodes", np.array([[0, 2]]), "edge_nodes: expected 0 to 1"),
        ("edge_nodes", np.array([[-1, 1]]), "edge_nodes: expected 0 to 1"),
        ("edge_kind", np.array([4]), "edge_kind: expected 0 to 3"),
        ("node_module", np.array([0, 2]), "modules: expected the names that the submaps refer to"),
        ("node_up", np.full((2, 3), 0.1), "node_up: expected directions of length 1, or 0"),
        ("node_up", None, "node_up: missing among the map's arrays"),
    ],
)
def test_arrays_that_do_not_fit_together_are_named(tmp_path, name, value, said):
    def harm(arrays):
        arrays.pop(name)
        if value is not None:
            arrays[name] = value

    with_arrays(tmp_path, harm)
    with pytest.raises(InputError, match=said):
        load_map_files(tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("version", 4, "a map of version 4, only version 5 is read"),
        ("version", "3", "a map of version '3', only version 5 is read"),
        ("version", 6, "a map of version 6, a newer SceneSLAM wrote it"),
        ("sha256", None, "sha256: missing, the map's map.yaml is not complete"),
        ("cell_m", 0.1, "cell_m: got 0.1, allowed: 0.05"),
        ("modules", "ab", "modules: expected the names"),
        ("arrays", "../arrays-0.npz", "is not complete, ../arrays-0.npz is missing"),
    ],
)
def test_a_head_that_does_not_fit_is_named(tmp_path, key, value, said):
    save_map_files(whole_map(), tmp_path / "map")
    path = tmp_path / "map" / HEAD
    head = yaml.safe_load(path.read_text())
    (tmp_path / "arrays-0.npz").write_bytes((path.parent / head["arrays"]).read_bytes())
    path.write_text(yaml.safe_dump(head | {key: value}))
    with pytest.raises(InputError, match=said):
        load_map_files(path.parent)
    with pytest.raises(InputError, match="there is no map, the folder is missing"):
        load_map_files(tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("node_module", [-1, 0]),
        ("node_run", [-1, 0]),
        ("node_piece", [1, 2]),
        ("node_scans", [0, 4]),
        ("point", 1e9),
        ("edge_covariance", 0.0),
        ("landmark_deviation", 0.0),
    ],
)
def test_numbers_that_no_map_has_are_named(tmp_path, name, value):
    def harm(arrays):
        arrays[name] = np.broadcast_to(np.array(value, arrays[name].dtype), arrays[name].shape)

    with_arrays(tmp_path, harm)
    with pytest.raises(InputError, match=f"{name}: expected"):
        load_map_files(tmp_path)


def test_what_wheels_mapped_before_the_first_session_is_loaded_again(tmp_path):
    saved, path = whole_map(), tmp_path / "map"
    first, second = saved.submaps
    before = replace(first, session=-1, module="")
    save_map_files(replace(saved, submaps=(before, second)), path)
    assert [submap.session for submap in load_map_files(path).submaps] == [-1, 0]


def test_rotations_that_a_module_rounded_are_saved_as_rotations(tmp_path):
    saved = whole_map()
    rounded = np.round(saved.T_map_node, 4)
    motion = replace(saved.edges[0], T_first_second=np.round(rounded[1], 3))
    save_map_files(replace(saved, T_map_node=rounded, edges=(motion,)), tmp_path)
    found = load_map_files(tmp_path)
    np.testing.assert_allclose(found.T_map_node, saved.T_map_node, atol=1e-4)
    np.testing.assert_allclose(found.edges[0].T_first_second, saved.T_map_node[1], atol=1e-3)


@pytest.mark.parametrize("text", ["[" * 20_000, "image: office.pgm\n", ""])
def test_a_head_of_another_program_is_no_map_and_is_not_replaced(tmp_path, text):
    (tmp_path / HEAD).write_text(text)
    with pytest.raises(InputError, match=HEAD):
        load_map_files(tmp_path)
    with pytest.raises(InputError, match=f"{HEAD} is in"):
        save_map_files(whole_map(), tmp_path)
    with pytest.raises(ConfigError, match="save"):
        LastingMap(load=None, save=str(tmp_path), mode="extend", save_every_s=1.0)
    assert (tmp_path / HEAD).read_text() == text


@pytest.mark.parametrize("x_m", [2e5, np.nan])
def test_a_map_that_could_not_be_loaded_again_replaces_none(tmp_path, x_m):
    save_map_files(whole_map(), tmp_path)
    with pytest.raises(InputError, match="node_pose: expected"):
        save_map_files(map_of(WALL, nodes=[[x_m, 0.0, 0.0]]), tmp_path)
    assert len(load_map_files(tmp_path).submaps) == 2


def test_what_a_killed_writer_left_is_no_obstacle(tmp_path):
    (tmp_path / "arrays-0123.npz").write_bytes(b"")
    (tmp_path / f"{HEAD}.part").write_text("format:")
    save_map_files(whole_map(), tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("path", ["file", "file/below", "x" * 300])
def test_a_place_where_no_map_can_be_is_named_before_the_run(tmp_path, path):
    (tmp_path / "file").write_text("")
    for key in ("save", "load"):
        given = {"save": None, "load": None, key: str(tmp_path / path)}
        with pytest.raises(ConfigError, match=key):
            LastingMap(**given, mode="extend", save_every_s=1.0)


@pytest.mark.parametrize("version", [VERSION, VERSION + 1])
def test_a_map_that_another_run_saved_is_kept(tmp_path, version):
    old, new = whole_map(), map_of(WALL)
    first = save_map_files(old, tmp_path)
    head = (tmp_path / HEAD).read_text()
    (tmp_path / HEAD).write_text(head.replace(f"version: {VERSION}", f"version: {version}"))
    assert save_map_files(new, tmp_path).displaced == first.seal
    assert first.displaced is None and f"version: {version}" in (tmp_path / OLD).read_text()
    (tmp_path / OLD).write_text(head)
    assert len(load_map_files(tmp_path).submaps) == 1
    (tmp_path / OLD).replace(tmp_path / HEAD)
    assert len(load_map_files(tmp_path).submaps) == len(old.submaps)


def test_a_map_in_the_folder_of_a_run_is_not_the_runs(tmp_path):
    """The next run there removes what the one before wrote, but no map."""
    (tmp_path / MARK).write_text("{}\n")
    save_map_files(whole_map(), tmp_path / "world")
    assert owned(tmp_path) == []


# When a run is saved.


class Mapped:
    """A run with one submap."""

    is_found = was_found = has_submaps = True

    def saved(self):
        return map_of(WALL, edges=[edge(0, 0, kind=EdgeKind.LOOP), edge(0, 0)])


def lasting(tmp_path, monkeypatch, *, every_s=2.0):
    """A map that is saved at intervals, and the times at which it was."""
    written, own = [], LastingMap(
        load=None, save=str(tmp_path / "map"), mode="extend", save_every_s=every_s
    )  # fmt: skip

    def save(saved, folder, *, known):
        written.append(saved)
        return SavedFiles(seal="seal", displaced=None)

    monkeypatch.setattr(lasting_map, "save_map_files", save)
    own.open(is_live=False)
    return own, written


def test_a_run_without_a_submap_replaces_no_map(tmp_path):
    class Begun(Mapped):
        has_submaps = False

        def saved(self):
            return empty_map()

    save_map_files(whole_map(), tmp_path / "map")
    own = LastingMap(load=None, save=str(tmp_path / "map"), mode="extend", save_every_s=1.0)
    own.open(is_live=False)
    for second in range(5):
        own.keep(second * S, Begun())
    own.finish(Begun(), 5 * S, lambda *_, **__: None)
    assert len(load_map_files(tmp_path / "map").submaps) == 2
    assert own.faults == [f"the run has nothing to save, the map that was in {tmp_path}/map stays"]


def test_an_empty_map_that_is_saved_has_no_pieces_apart(tmp_path, caplog):
    own, run = LastingMap(load=None, save=str(tmp_path), mode="extend", save_every_s=1.0), Mapped()
    run.saved = empty_map
    own.finish(run, 0, lambda *_, **__: None)
    assert (tmp_path / HEAD).exists() and own.faults == [] and caplog.messages == []


def test_runs_that_share_a_map_are_told_and_nothing_is_lost(tmp_path):
    folder = str(tmp_path)
    save_map_files(whole_map(), tmp_path)
    one, other = (
        LastingMap(load=folder, save=folder, mode="extend", save_every_s=1.0) for _ in range(2)
    )
    one.finish(Mapped(), 0, lambda *_, **__: None)
    later = Mapped()
    later.saved = lambda: map_of(WALL, WALL, WALL)
    other.finish(later, 0, lambda *_, **__: None)
    assert one.faults == [] and len(load_map_files(tmp_path).submaps) == 3
    (tmp_path / OLD).replace(tmp_path / HEAD)
    assert len(load_map_files(tmp_path).submaps) == 1
    (fault,) = other.faults
    assert "another run saved its map meanwhile" in fault and OLD in fault


def test_a_map_is_saved_at_intervals_and_at_the_end(tmp_path, monkeypatch):
    own, written = lasting(tmp_path, monkeypatch)
    counts = []
    for second in (5.0, 6.9, 7.0, 8.9, 9.1, 11.0, 11.2):
        own.keep(round(second * S), Mapped())
        counts.append(len(written))
    assert counts == [0, 0, 1, 1, 2, 2, 3]
    events = []
    own.finish(Mapped(), 12 * S, lambda *event, **fields: events.append((event, fields)))
    assert events == [(("map_saved", 12 * S), {"submaps": 1, "loops": 1})] and len(written) == 4
    assert own.faults == []


def test_a_map_is_saved_as_soon_as_there_is_one_and_the_last_is_written(tmp_path, monkeypatch):
    own, written = lasting(tmp_path, monkeypatch, every_s=10.0)
    run, writing = Mapped(), Future()
    own._writing, run.has_submaps = writing, False
    counts = []
    for second in range(0, 26):
        run.has_submaps |= second == 12
        if second == 14:
            writing.set_result(True)
        own.keep(second * S, run)
        counts.append(len(written))
    assert counts == [0] * 14 + [1] * 10 + [2] * 2


@pytest.mark.parametrize("failure", [OSError, MemoryError])
def test_what_could_not_be_saved_is_told_once(tmp_path, monkeypatch, failure):
    own, _ = lasting(tmp_path, monkeypatch)

    def fails(*_, **__):
        raise failure("no space left")

    monkeypatch.setattr(lasting_map, "save_map_files", fails)
    for second in (0, 2, 4):
        own.keep(second * S, Mapped())
    own.finish(Mapped(), 5 * S, lambda *_, **__: None)  # poses stay as loops corrected them
    (fault,) = own.faults
    assert fault.startswith("the map could not be saved: ") and "no space left" in fault


LARGE = map_of(WALL, WALL, nodes=[[0, 0, 0], [400, 400, 0]])


def test_a_map_that_is_too_large_to_load_is_named_with_its_key_and_folder(tmp_path):
    save_map_files(LARGE, tmp_path)
    builder = ComponentBuilder(
        {"atlas": {"_target_": ATLAS, "voxel_m": 0.1, "load": f"{tmp_path}"}}
    )
    with pytest.raises(ConfigError, match="a floor plan of 403 m x 401 m") as caught:
        builder.make("atlas", Atlas)
    assert str(caught.value).startswith(f"atlas.load: got '{tmp_path}'")


def test_a_run_whose_map_is_too_large_to_load_replaces_none(tmp_path):
    save_map_files(whole_map(), tmp_path)
    own = LastingMap(load=None, save=str(tmp_path), mode="extend", save_every_s=1.0)
    run = Mapped()
    run.saved = lambda: LARGE
    own.finish(run, 0, lambda *_, **__: None)
    (fault,) = own.faults
    assert fault.startswith("the map could not be saved: ") and "403 m x 401 m" in fault
    assert len(load_map_files(tmp_path).submaps) == 2


def test_a_run_that_localizes_saves_no_map(tmp_path):
    save_map_files(whole_map(), tmp_path)
    with pytest.raises(
        ConfigError, match=r"save: got 'other', allowed: null where atlas\.mode is localize"
    ):
        LastingMap(load=str(tmp_path), save="other", mode="localize", save_every_s=1.0)
    assert len(LastingMap(load=str(tmp_path), save=str(tmp_path), mode="update", save_every_s=1.0)
               .loaded.submaps) == 2  # fmt: skip


def test_an_update_forgets_only_at_its_end_as_the_place_may_be_withdrawn(tmp_path):
    save_map_files(map_of(plan_of("###")), tmp_path)
    folder = str(tmp_path)
    own, run = LastingMap(load=folder, save=folder, mode="update", save_every_s=1.0), Mapped()
    nodes = [[CELL, 2 * CELL, 0], [0, 0, 0]]
    run.saved = lambda: map_of(plan_of("###"), plan_of(*["....."] * 5), nodes=nodes, runs=[0, 1])
    for second in range(3):
        own.keep(second * S, run)
    assert [len(one.plan) for one in load_map_files(tmp_path).submaps] == [3, 0]
    own.finish(run, 3 * S, lambda *_, **__: None)
    assert [len(one.plan) for one in load_map_files(tmp_path).submaps] == [0, 0]


@pytest.mark.parametrize(
    ("mode", "is_found"), [("update", True), ("update", False), ("extend", True)]
)
def test_an_update_forgets_once_the_run_was_located(tmp_path, mode, is_found):
    save_map_files(map_of(plan_of("###")), tmp_path)
    own = LastingMap(load=str(tmp_path), save=None, mode=mode, save_every_s=1.0)
    run = Mapped()
    run.is_found = is_found
    nodes = [[CELL, 2 * CELL, 0], [0, 0, 0]]
    run.saved = lambda: map_of(plan_of("###"), plan_of(*["....."] * 5), nodes=nodes, runs=[0, 1])
    kept = len(own.map_of(run).submaps[0].plan)
    assert kept == (0 if mode == "update" and is_found else 3)
