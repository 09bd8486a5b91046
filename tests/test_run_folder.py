"""A run's folder: nobody else's, and nothing foreign in it is touched."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from configured import config
from omegaconf import OmegaConf

from sceneslam.app import run
from sceneslam.config.claim import ClaimFolder
from sceneslam.sinks.foxglove import FoxgloveSink
from sceneslam.sinks.mcap import McapSink
from sceneslam.sinks.ros2.sink import Ros2Sink
from sceneslam.storage.folder import RunFolder, give_back
from sceneslam.storage.reserve import Reserve
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.files import MARK, finish, new_file, own, part_of, replacing

CLAIM = """
import sys
from pathlib import Path
from sceneslam.storage.folder import RunFolder
from sceneslam.types.errors import ConfigError
sys.stdin.readline()
try:
    claimed = RunFolder.claim(Path(sys.argv[1]), is_stamped=sys.argv[2] == "stamped")
    print(claimed.path.name, flush=True)
except ConfigError as error:
    print("refused", flush=True)
sys.stdin.readline()
"""


def claim_at_once(path, kind, count=6):
    """Let processes claim one folder at the same time; return what each of them got."""
    command = [sys.executable, "-c", CLAIM, str(path), kind]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen(command, **pipes) for _ in range(count)]
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    got = [process.stdout.readline().strip() for process in processes]
    for process in processes:
        process.communicate("go\n")
    return sorted(got)


def test_runs_of_one_second_get_a_folder_each(tmp_path):
    got = claim_at_once(tmp_path / "outputs" / "12-00-00", "stamped")
    assert got == ["12-00-00", *(f"12-00-00_{number}" for number in range(1, 6))]


def test_a_folder_that_was_named_belongs_to_one_run_at_a_time(tmp_path):
    assert claim_at_once(tmp_path / "a" / "b", "named").count("refused") == 5
    assert RunFolder.claim(tmp_path / "a" / "b").path == tmp_path / "a" / "b"


@pytest.mark.parametrize(("first", "second"), [("run", "sweep"), ("sweep", "run")])
def test_a_folder_of_a_run_is_not_that_of_a_sweep(tmp_path, first, second):
    claimed = RunFolder.claim(tmp_path / "a", kind=first)
    with pytest.raises(ConfigError, match=f"it is the folder of a {first}"):
        RunFolder.claim(tmp_path / "a", kind=second)
    claimed.close()
    with pytest.raises(ConfigError, match=f"it is the folder of a {first}"):
        RunFolder.claim(tmp_path / "a", kind=second)
    RunFolder.claim(tmp_path / "a", kind=first).clear()
    with pytest.raises(ConfigError, match=f"it is the folder of a {first}"):
        RunFolder.claim(tmp_path / "a", kind=second)


def test_a_folder_with_foreign_files_is_refused_and_left_as_it_is(tmp_path):
    for name in ("figures/fig1.png", "map/survey.pgm", "trajectory_gps.tum"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    with pytest.raises(ConfigError, match=r"no run wrote: figures and 2 more"):
        run(config(), tmp_path)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_what_lies_beside_the_files_of_a_run_outlives_the_next_run(tmp_path):
    run(config(), tmp_path)
    mine = ["notes.txt", "trajectory_gps.tum", "figures/fig1.png", "map/survey.pgm"]
    for name in mine:
        (tmp_path / name).write_text("mine")
    finished = run(config(source__dark_from=1000, run__report=False), tmp_path)
    assert finished.faults == ()
    assert [(tmp_path / name).read_text() for name in mine] == ["mine"] * 4
    assert not (tmp_path / "trajectory_1_dark.tum").exists()


def test_a_foreign_file_that_has_the_name_of_a_runs_is_no_runs(tmp_path):
    run(config(run__report=False), tmp_path)
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(ConfigError, match=r"no run wrote: report\.html"):
        run(config(), tmp_path)
    assert (tmp_path / "report.html").read_text() == "mine"


def test_a_foreign_file_that_comes_while_it_runs_is_not_replaced(tmp_path):
    sink = {"_target_": "fakes.Intruder", "name": "trajectory_1_dark.tum"}
    finished = run(config(sinks={"intruder": sink}, run__report=False), tmp_path)
    assert (tmp_path / "trajectory_1_dark.tum").read_text() == "mine"
    assert any("no run wrote" in fault for fault in finished.faults)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"policy__confirm_window_s": -1}, ConfigError),
        ({"sinks": {"closed": {"_target_": "fakes.ClosedSink"}}}, InputError),
    ],
)
def test_a_mistake_leaves_no_folder(tmp_path, changes, error):
    with pytest.raises(error):
        run(config(**changes), tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_a_folder_below_the_home_folder_is_made_there(tmp_path, monkeypatch, kind):
    monkeypatch.setenv("HOME", str(tmp_path))
    composed = OmegaConf.create({"hydra": {kind: {"dir": "~/out"}}})
    ClaimFolder()._claim(composed, kind)
    assert composed.hydra[kind].dir == str(tmp_path / "out") and (tmp_path / "out" / MARK).exists()


def test_a_mistake_removes_no_folder_that_was_there(tmp_path):
    (tmp_path / "a").mkdir()
    RunFolder.claim(tmp_path / "a" / "b" / "c")
    (tmp_path / "a" / "b" / "c" / ".hydra").mkdir()
    (tmp_path / "a" / "b" / "c" / ".hydra" / "config.yaml").touch()
    give_back(tmp_path / "a" / "b" / "c")
    assert list(tmp_path.rglob("*")) == [tmp_path / "a"]


def test_a_folder_is_not_given_back_once_it_holds_something(tmp_path):
    RunFolder.claim(tmp_path / "a")
    (tmp_path / "a" / "runs").mkdir()
    give_back(tmp_path / "a")
    assert (tmp_path / "a" / MARK).exists()


def test_a_mark_that_names_files_elsewhere_removes_none_of_them(tmp_path):
    RunFolder.claim(tmp_path / "run").close()
    (tmp_path / "precious").touch()
    with (tmp_path / "run" / MARK).open("a") as mark:
        mark.write(f"../precious\n{tmp_path / 'precious'}\n")
    RunFolder.claim(tmp_path / "run").clear()
    assert (tmp_path / "precious").exists()


def test_a_file_has_its_name_when_it_is_whole_or_never(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(RuntimeError), replacing(path) as file:
        file.write("half")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with replacing(path) as file:
        file.write("whole")
        assert not path.exists()
    assert path.read_text() == "whole"


def test_a_file_of_a_sink_has_its_name_once_it_is_finished(tmp_path):
    RunFolder.claim(tmp_path)
    part_of(tmp_path / "run.mcap").write_bytes(b"all")
    finish(tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap").read_bytes() == b"all"
    assert own(tmp_path / "run.mcap") == tmp_path / "run.mcap"
    (tmp_path / "other.mcap").touch()
    with pytest.raises(FileExistsError):
        own(tmp_path / "other.mcap")


@pytest.mark.parametrize("name", ["in.mcap", "run/journal.bin", "run/half.mcap"])
def test_a_sink_replaces_no_file_that_is_there(tmp_path, name):
    (tmp_path / "run").mkdir()
    there = tmp_path / (f"{name}.part" if "half" in name else name)
    there.write_text("mine")
    with pytest.raises(FileExistsError):
        new_file(tmp_path / "run", str(tmp_path / name))
    assert there.read_text() == "mine"
    assert new_file(tmp_path / "run", "../out/a.mcap") == tmp_path / "out" / "a.mcap"
    assert (tmp_path / "out").is_dir()


def test_a_full_disk_closes_the_sinks_that_write_files_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(Reserve, "is_enough", lambda self, poses: poses < 50)
    sinks = {name: {"_target_": f"fakes.{name}"} for name in ("IdleSink", "Display")}
    finished = run(config(run__report=False, sinks=sinks), tmp_path)
    left = "[Errno 28] what is left is for the results"
    assert finished.faults == (f"sinks.IdleSink stopped writing: OSError: {left}",)
    assert len(finished.trajectory) == 100


def test_room_on_the_disk_is_kept_also_without_sinks(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(Reserve, "is_enough", lambda self, poses: asked.append(poses) or True)
    run(config(run__report=False), tmp_path)
    assert asked == list(range(1, 101))


def test_sinks_on_a_network_write_no_files():
    assert McapSink.writes_files and not Ros2Sink.writes_files and not FoxgloveSink.writes_files


def test_the_mark_says_who_writes_and_what(tmp_path):
    run(config(), tmp_path / "run")
    about, *names = (tmp_path / "run" / MARK).read_text().splitlines()
    assert json.loads(about)["pid"] == os.getpid()
    written = {str(path.relative_to(tmp_path / "run")) for path in files(tmp_path / "run")}
    assert written - {MARK} <= set(names)


def files(folder: Path):
    return [path for path in folder.rglob("*") if path.is_file()]
