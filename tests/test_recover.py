"""What a run that is cut off leaves on disk, and the results that are made of it."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest
from configured import config

from sceneslam.app import run
from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.recover.__main__ import main
from sceneslam.recover.recover import _reference, _Retold
from sceneslam.storage.journal import MAGIC, Journal, JournalHeader, read_journal
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.files import AppendedFile
from sceneslam.types.maps import MapLayers
from sceneslam.types.rig import Wheels
from sceneslam.types.trajectory import Trajectory

RESULTS = ("trajectory.tum", "trajectory_online.tum", "metrics.json", "report.html")
HEAD = JournalHeader(title="test", value_label="grey", wheels=Wheels(axle_m=0.1), began_in="/")


def started(settings, folder, fds=()):
    """Start a run in a process of its own; a forked one would lack the libraries' threads."""
    given = folder.with_suffix(".pickle")
    given.write_bytes(pickle.dumps((sys.path, settings, folder)))
    code = "import pickle, sys\nfrom pathlib import Path\n"
    code += "sys.path, *given = pickle.loads(Path(sys.argv[1]).read_bytes())\n"
    code += "from sceneslam.app import run\nrun(*given)"
    return subprocess.Popen([sys.executable, "-c", code, given], pass_fds=fds)


def killed(tmp_path, at, has_report=False, **changes):
    """Run in a process that is killed at an observation; return the run's folder."""
    folder, sink = tmp_path / "run", {"_target_": "fakes.Killer", "at": at}
    settings = config(sinks={"killer": sink}, run__report=has_report, **changes)
    assert started(settings, folder).wait() == -signal.SIGKILL
    return folder


@pytest.mark.parametrize("handover", ["cold", "rewind"])
def test_a_killed_run_is_recovered_as_it_would_have_been_written(tmp_path, handover):
    folder = killed(tmp_path, 80, has_report=True, policy__handover=handover)
    assert not any((folder / name).exists() for name in RESULTS)
    assert main([str(folder)]) == 0
    whole = tmp_path / "whole"
    run(config(run__max_observations=81, policy__handover=handover, run__report=False), whole)
    names = [path.name for path in whole.glob("traj*")]
    assert len(names) == 5
    for name in names:
        assert (folder / name).read_bytes() == (whole / name).read_bytes()
    metrics, expected = (json.loads((one / "metrics.json").read_text()) for one in (folder, whole))
    told = ("poses", "observations", "coverage", "path_length_m", "bridged")
    assert [metrics[name] for name in told] == [expected[name] for name in told]
    page = (folder / "report.html").read_text()
    assert "recovered from its journal" in page and "what detector, bus and modules cost" in page


def test_reasons_and_counts_that_were_not_kept_are_named(tmp_path, capsys):
    folder = killed(tmp_path, 20)
    assert main([str(folder)]) == 0
    said = capsys.readouterr().err
    assert "missing: the sensor data that modules lacked" in said
    assert "missing: the number of dropped observations" in said
    errors = " ".join(json.loads((folder / "metrics.json").read_text())["errors"])
    assert "recovered without the sensor data that modules lacked" in errors


def test_events_that_cannot_be_written_again_cost_no_pose(tmp_path, monkeypatch, capsys):
    def fail(path):
        raise OSError("no space left on device")

    folder = killed(tmp_path, 80)
    monkeypatch.setattr("sceneslam.recover.recover.replacing", fail)
    assert main([str(folder)]) == 0
    assert "missing: a new events.jsonl: OSError: no space left" in capsys.readouterr().err
    assert len(Trajectory.read_tum(folder / "trajectory.tum")) == 81


def test_only_a_run_that_asked_for_a_reference_is_compared_with_the_one_in_its_folder(tmp_path):
    folder = killed(tmp_path, 20)
    (folder / "reference").mkdir()
    poses = Trajectory(stamps_ns=np.arange(2), T_world_base=np.tile(np.eye(4), (2, 1, 1)))
    poses.write_tum(folder / "reference" / "trajectory.tum")
    assert main([str(folder)]) == 0
    assert "reference" not in json.loads((folder / "metrics.json").read_text())


def test_reference_gets_the_stamps_of_the_observations(tmp_path):
    class Received:
        def logged_ns(self, stamps_ns):
            return stamps_ns + np.array([5, 40, 10])  # not in their order

    observed_ns = np.array([100, 120, 140])
    T_map_base = np.stack([se3.from_xy_yaw(x, 0.0, 0.0) for x in range(3)])
    source = Received()
    written = Trajectory(stamps_ns=observed_ns, T_world_base=T_map_base)
    (tmp_path / "reference").mkdir()
    path = tmp_path / "reference" / "trajectory.tum"
    written.stamped(source.logged_ns(observed_ns)).write_tum(path)
    read = _reference(tmp_path, source, observed_ns)
    assert read.stamps_ns.tolist() == [100, 120, 140]
    np.testing.assert_allclose(read.positions_m[:, 0], [0.0, 1.0, 2.0])


def test_a_run_at_its_end_has_no_journal_and_is_not_recovered(tmp_path, capsys):
    run(config(run__report=False), tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert not (tmp_path / "journal.bin").exists() and not (tmp_path / "reserve.bin").exists()
    assert main([str(tmp_path)]) == 0
    assert "came to its end" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


def test_a_second_recovery_finds_nothing_left_to_do(tmp_path, capsys):
    folder = killed(tmp_path, 20)
    assert main([str(folder), "allow_targets=[fakes]"]) == 0
    capsys.readouterr()
    assert main([str(folder)]) == 0
    assert "came to its end" in capsys.readouterr().out
    assert not [path for path in folder.rglob("*") if path.suffix == ".part"]


def test_a_source_of_ones_own_is_read_where_the_command_line_allows_it(tmp_path, capsys):
    folder = killed(tmp_path, 20)
    assert main([str(folder)]) == 0
    assert "allow_targets=[fakes]" in capsys.readouterr().err
    assert not (folder / "groundtruth.tum").exists() and (folder / "journal.bin").exists()
    assert main([str(folder), "allow_targets=[fakes]"]) == 0
    assert "missing: the ground truth" not in capsys.readouterr().err
    assert (folder / "groundtruth.tum").exists() and not (folder / "journal.bin").exists()
    assert len(Trajectory.read_tum(folder / "trajectory.tum")) == 21


def test_another_word_than_a_run_and_what_is_allowed_is_refused(tmp_path, capsys):
    folder = killed(tmp_path, 5)
    assert main([str(folder), "seed=1"]) == 2
    assert "recover: got 'seed=1', allowed: RUN, allow_targets=[NAME]" in capsys.readouterr().err
    assert not (folder / "trajectory.tum").exists()


@pytest.mark.parametrize("cut_bytes", [1, 60, 5000])
def test_torn_ends_cost_what_is_torn_and_are_told(tmp_path, capsys, cut_bytes):
    folder = killed(tmp_path, 80)
    for name in ("journal.bin", "events.jsonl"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[:-cut_bytes] + b"\0" * (cut_bytes // 2))
    assert main([str(folder)]) == 0
    assert "journal.bin, which are torn" in capsys.readouterr().err
    assert len(Trajectory.read_tum(folder / "trajectory.tum")) >= 81 - 1 - cut_bytes // 250
    lines = (folder / "events.jsonl").read_text().splitlines()
    assert all(json.loads(line)["event"] for line in lines)


@pytest.mark.parametrize("what", ["covariances", "fuse_maps"])
def test_a_part_that_fails_costs_no_pose(tmp_path, capsys, monkeypatch, what):
    def fail(*_):
        raise MemoryError("too large")

    folder = killed(tmp_path, 20)
    monkeypatch.setattr(f"sceneslam.atlas.atlas.Atlas.{what}", fail)
    assert main([str(folder)]) == 1
    assert "MemoryError: too large" in capsys.readouterr().err
    assert len(Trajectory.read_tum(folder / "trajectory.tum")) == 21
    assert (folder / "metrics.json").is_file() and (folder / "journal.bin").is_file()


def test_a_recording_that_is_gone_costs_the_ground_truth_alone(tmp_path, capsys):
    folder = killed(tmp_path, 20)
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("_target_: fakes.FakeSource", "_target_: x.Y"))
    assert main([str(folder)]) == 0
    assert "missing: the ground truth" in capsys.readouterr().err
    assert len(Trajectory.read_tum(folder / "trajectory.tum")) == 21


@pytest.mark.parametrize("what", ["nothing", "empty", "no_config", "garbage", "a_folder"])
def test_what_is_no_run_is_told_and_left_alone(tmp_path, capsys, what):
    folder = tmp_path / "run"
    if what != "nothing":
        folder = killed(tmp_path, 5) if what != "empty" else folder
        folder.mkdir(exist_ok=True)
    if what == "no_config":
        (folder / "config.yaml").unlink()
    if what == "garbage":
        (folder / "journal.bin").write_bytes(b"garbage")
    if what == "a_folder":
        (folder / "journal.bin").unlink()
        (folder / "journal.bin").mkdir()
    assert main([str(folder)]) == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert not (folder / "trajectory.tum").exists()


def test_a_run_that_is_under_way_is_not_recovered(tmp_path):
    reading, writing = os.pipe()
    sink = {"_target_": "fakes.Waiter", "until": reading, "at": 5}
    settings = config(sinks={"waiter": sink}, run__report=False)
    child = started(settings, tmp_path / "run", fds=(reading,))
    os.close(reading)
    try:
        while not (tmp_path / "run" / "waiting").exists():
            os.sched_yield()
        assert main([str(tmp_path / "run")]) == 2
    finally:
        os.close(writing)
        child.wait()
    assert len(Trajectory.read_tum(tmp_path / "run" / "trajectory.tum")) == 100


def told_atlas(journal, seed):
    """Tell an atlas at random what a run may tell it, and keep the journal of it."""
    draw = np.random.default_rng(seed)
    atlas = Atlas(voxel_m=0.1)
    atlas.keep_journal(journal)
    for stamp_ns in range(0, 3000, 10):
        kind = draw.integers(20)
        if stamp_ns == 0 or kind == 0:
            transforms = (se3.exp(draw.normal(size=6)) for _ in range(2))
            session = atlas.begin_session(f"möd_{kind}", *transforms)
        if kind == 1:
            atlas.rewind(stamp_ns - 50, se3.exp(draw.normal(size=6)) if draw.integers(2) else None)
        if kind == 2:
            revised = atlas.online
            known = np.tile(draw.uniform() * np.eye(6), (len(revised), 1, 1))
            known[::3] = np.nan
            covariances = known if draw.integers(2) else None
            atlas.close_session(session, None, replace(revised, covariances=covariances))
        known = draw.normal(size=(6, 6))
        covariance = known @ known.T if kind > 5 else None
        atlas.add_local(stamp_ns, se3.exp(draw.normal(size=6)))
        atlas.add(
            stamp_ns, se3.exp(draw.normal(size=6)), "" if kind in (1, 3) else "möd", covariance
        )
        if kind == 4:
            nodes_ns = np.unique(draw.integers(0, stamp_ns, size=5))
            moved = np.array([se3.exp(draw.normal(size=6)) for _ in nodes_ns])
            atlas.correct(Correction(stamps_ns=nodes_ns, T_new_old=moved))
        atlas.report(stamp_ns)
        journal.flush()
    return atlas


@pytest.mark.parametrize("seed", range(5))
def test_an_atlas_that_is_told_a_journal_is_the_one_it_was_kept_of(tmp_path, seed):
    journal = Journal(tmp_path / "journal.bin", HEAD)
    atlas = told_atlas(journal, seed)
    journal.close()
    again = Atlas(voxel_m=0.1)
    kept = read_journal(tmp_path / "journal.bin", _Retold(again))
    assert asdict(kept.head) == asdict(HEAD) and kept.torn_bytes == 0
    assert kept.observed_ns.tolist() == list(range(0, 3000, 10))
    for _ in range(2):
        for name in ("trajectory", "online"):
            one, two = getattr(atlas, name), getattr(again, name)
            np.testing.assert_array_equal(one.stamps_ns, two.stamps_ns)
            np.testing.assert_array_equal(one.T_world_base, two.T_world_base)
        for told in (atlas, again):  # then the poses are those that the modules revised
            told.end_with(Correction.none())
    assert atlas.pose_modules == again.pose_modules
    np.testing.assert_allclose(atlas.covariances(Wheels()), again.covariances(Wheels()), rtol=1e-12)


def test_a_cut_off_run_is_corrected_once(tmp_path):
    """A correction of the mapper, while the run lasts, is of the poses as they were told."""
    journal = Journal(tmp_path / "journal.bin", HEAD)
    atlas = Atlas(voxel_m=0.1)
    atlas.keep_journal(journal)
    told, revised = (
        np.stack([se3.from_xy_yaw(0, y_m, 0) for y_m in of]) for of in ([0, 1], [0, 0])
    )
    first = atlas.begin_session("a", se3.identity())
    for stamp_ns in range(2):
        atlas.add_local(stamp_ns, told[stamp_ns])
        atlas.add(stamp_ns, told[stamp_ns], "a")
        atlas.report(stamp_ns)
    atlas.close_session(
        first, MapLayers(), Trajectory(stamps_ns=np.arange(2), T_world_base=revised)
    )
    atlas.begin_session("b", told[1])
    atlas.correct(Correction(stamps_ns=np.arange(2), T_new_old=revised @ se3.inverse(told)))
    atlas.add_local(2, se3.identity())
    atlas.add(2, told[1], "b")
    atlas.report(2)
    for stop in ("killed", "mapped"):
        if stop != "killed":  # nothing is left to be corrected
            atlas.end_with(Correction.none())
        journal.flush()
        again = Atlas(voxel_m=0.1)
        read_journal(tmp_path / "journal.bin", _Retold(again))
        for one in (atlas, again):
            assert one.online.positions_m[:, 1].tolist() == [0.0, 1.0, 0.0]
            np.testing.assert_allclose(one.trajectory.positions_m, 0.0, atol=1e-12)
            assert one.sessions[1].T_map_local[1, 3] == pytest.approx(0.0)


def test_a_journal_read_up_to_any_byte_is_the_beginning_of_what_was_told(tmp_path):
    journal = Journal(tmp_path / "journal.bin", HEAD)
    told_atlas(journal, 0)
    journal.close()
    data = (tmp_path / "journal.bin").read_bytes()
    path, counts = tmp_path / "cut.bin", []
    for end in range(len(data) - 1400, len(data) - 700, 7):
        path.write_bytes(data[:end])
        counts.append(len(read_journal(path, _Retold(Atlas(voxel_m=0.1))).observed_ns))
    assert counts == sorted(counts) and 1 <= counts[-1] - counts[0] <= 3


def test_a_record_that_cannot_be_read_costs_no_other(tmp_path):
    """Poses of 32 bits, as a module revised them at its end."""
    journal = Journal(tmp_path / "journal.bin", HEAD)
    told_atlas(journal, 0)
    poses = np.tile(np.eye(4, dtype=np.float32), (5, 1, 1))
    journal.add_end(0, Trajectory(stamps_ns=np.arange(5), T_world_base=poses))
    journal.add_observation(3000)
    journal.close()
    kept = read_journal(tmp_path / "journal.bin", _Retold(Atlas(voxel_m=0.1)))
    assert kept.observed_ns.tolist() == list(range(0, 3010, 10))
    assert kept.torn_bytes == 9 + 9 + 5 * (8 + 12 * 4)


def test_a_journal_takes_at_most_450_bytes_a_pose(tmp_path):
    journal = Journal(tmp_path / "journal.bin", HEAD)
    for stamp_ns in range(1000):
        journal.add_local(stamp_ns, np.eye(4))
        journal.add_pose(stamp_ns, np.eye(4), "bright", np.eye(6), None)
        journal.add_observation(stamp_ns)
    journal.close()
    assert 300_000 < (tmp_path / "journal.bin").stat().st_size < 450_000


def test_a_journal_that_cannot_be_read_says_so(tmp_path):
    (tmp_path / "journal.bin").write_bytes(MAGIC + b"H")
    with pytest.raises(InputError, match="first record"):
        read_journal(tmp_path / "journal.bin", _Retold(Atlas(voxel_m=0.1)))


def test_a_file_that_is_appended_to_a_full_disk_ends_with_a_whole_piece(tmp_path):
    room = [False, True, True]
    with pytest.MonkeyPatch.context() as patch:
        write, left = os.write, [10]

        def full(fd, data):
            if not left[0]:
                raise OSError(28, "No space left on device")
            done = write(fd, bytes(data)[: left[0]])
            left[0] -= done
            return done

        def make_room():
            left[0] = 10 * room[-1]
            return room.pop()

        patch.setattr("sceneslam.types.files.os.write", full)
        file = AppendedFile(tmp_path / "a", make_room)
        file.append(b"12345678")
        file.append(b"abcdefgh")  # makes room once
        with pytest.raises(OSError, match="No space"):
            file.append(b"x" * 40)
        file.close()
    assert (tmp_path / "a").read_bytes() == b"12345678abcdefgh"


def test_a_killed_run_in_a_folder_is_replaced_by_the_next(tmp_path):
    folder = killed(tmp_path, 20)
    finished = run(config(run__report=False), folder)
    assert finished.faults == () and not (folder / "journal.bin").exists()
    shutil.rmtree(folder)
