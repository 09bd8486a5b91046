"""Every command of the documentation runs as it is written, every file it shows is used."""

import json
import re
import shutil
import subprocess
import sys
import tomllib

import pytest
from documentation import (
    OBSERVATIONS,
    PAGES,
    ROOT,
    commands,
    run,
    run_inside,
    write_files,
    write_recordings,
)

NOT_RUN = {  # first words -> why it is not run here
    "make": "runs these tests, or the run that stands beside it in the README",
    ".": "makes the environment that the tests run in",
    "pip install": "needs a network; what it installs is held against pyproject.toml",
    "rerun": "opens a window; the recording is read by tests of the sink",
    "ros2": "needs a robot's ROS",
    "export": "is for the reader's shell",
    "python -m sceneslam doctor source=ros2": "needs a robot; tests of the doctor have one",
    "python -m sceneslam doctor source=realsense": "needs a camera",
    "mkdocs serve": "serves until it is stopped; the site is built by a test",
    "python -m sceneslam.sweep": "goes on with a sweep; tests of sweeps stop one and do",
    "python experiments/": "takes minutes; its numbers stand beside it, a test finds the program",
}
RECORDED = "python -m sceneslam +scenario=bright_to_dark"
# A viewer stays, a robot is not there: composed only. Tests of these sinks and sources have both.
LIVE = re.compile(r"source=(ros2|realsense)")
SHOWS = re.compile(rf"viewer=rerun|{LIVE.pattern}")
ASKS = re.compile(r" \+experiment=(?!unswitched)")  # takes minutes; is composed only
ALL = [(page, command) for page in PAGES for command in commands(page)]
RUN = [
    (page, command)
    for page, command in ALL
    if not command.startswith(tuple(NOT_RUN))
    and not (SHOWS.search(command) or ASKS.search(command))
]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    write_recordings(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert run_inside(f"{RECORDED} hydra.run.dir=run atlas.save=MAP") == 0
    shutil.copytree(folder / "run", folder / "OTHER_RUN")
    for name in ("ESTIMATE", "TRUTH"):
        shutil.copy(folder / "run" / "trajectory.tum", folder / f"{name}.tum")
    return folder


@pytest.fixture
def workshop(tmp_path, recordings):
    for path in recordings.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return tmp_path


@pytest.mark.parametrize(("page", "command"), RUN, ids=[f"{p.stem}: {c}" for p, c in RUN])
def test_command_runs(workshop, monkeypatch, capfd, page, command):
    write_files(page, workshop)
    monkeypatch.chdir(workshop)
    if any(workshop.glob("*.py")):  # the reader's own code is found in the current folder
        done = run(command, workshop)
        code, said, errors = done.returncode, done.stdout, done.stderr
    else:
        code = run_inside(command)
        said, errors = capfd.readouterr()
    assert code == 0, errors
    if re.search(r"-m sceneslam (?!-m|--help|.*--cfg|.* -m |.*detect_only)", command):
        assert f"{OBSERVATIONS} poses (coverage 100.0 %)" in said


@pytest.mark.parametrize(
    "command", [c for _, c in ALL if ASKS.search(c) or (LIVE.search(c) and "doctor" not in c)]
)
def test_what_is_not_run_composes(workshop, monkeypatch, capfd, command):
    monkeypatch.chdir(workshop)
    asked = command.replace("sceneslam -m ", "sceneslam ")
    assert run_inside(f"{asked} --cfg job") == 0
    assert "policy:" in capfd.readouterr().out


@pytest.mark.parametrize("command", [c for _, c in ALL if c.startswith("python experiments/")])
def test_program_that_takes_minutes_is_there(command):
    assert (ROOT / command.split()[1]).is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_installed_extras_exist(page):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for extras in re.findall(r"pip install [^\n`]*\[([\w,]+)\]", page.read_text()):
        assert set(extras.split(",")) <= set(project["optional-dependencies"])


def test_guide_keeps_its_promise_of_40_lines(tmp_path):
    write_files(ROOT / "docs" / "own_module.md", tmp_path)
    lines = (tmp_path / "my_slam.py").read_text().splitlines()
    assert len([line for line in lines if line.strip()]) <= 40


def test_site_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    build = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "-q",
        "--strict",
        "-d",
        str(tmp_path / "site"),
    ]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "site" / "search" / "search_index.json").read_text())
    titles = {entry["title"] for entry in found["docs"]}
    assert {"Your own recording in ten minutes", "detector", "Frames and maps"} <= titles
    fetched = r'<(?:script|link|img)[^>]*(?:src|href)="?(?:https?:)?//'
    for page in (tmp_path / "site").rglob("*.html"):
        assert not re.search(fetched, page.read_text()), page
