"""The documentation as something that can be run: its files, its commands, and what they need."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from sceneslam.ros.writer import ObservationWriter
from sceneslam.testing.room import RIG, room_observation

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
OBSERVATIONS = 12
_FILE = re.compile(r"```\w+ title=\"([^\"]+)\"\n(.*?)```", re.S)
_SHELL = re.compile(r"```sh\n(.*?)```", re.S)
_RUN = ("python", "-m", "sceneslam")
_READS = ("source", "--help", "--cfg")  # with any of these nothing is rendered, or little


def commands(page: Path) -> Iterator[str]:
    """Yield the commands of a page, without comments."""
    for block in _SHELL.findall(page.read_text()):
        for line in block.replace("\\\n", " ").splitlines():
            if words := shlex.split(line, comments=True):
                yield shlex.join(words)


def write_files(page: Path, folder: Path) -> None:
    """Write the files that a page shows, as its reader would."""
    for name, text in _FILE.findall(page.read_text()):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def write_recordings(folder: Path) -> None:
    """Write what stands for the reader's own recording: `FILE`, and `FOLDER` in TUM's layout."""
    writer = ObservationWriter(folder / "FILE.mcap", rig=RIG, image_format="png")
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for index in range(OBSERVATIONS):
        observation = room_observation(index)
        writer.write(observation)
        for name, picture in (
            ("rgb", observation.image_bgr),
            ("depth", (observation.depth_m * 5000).astype(np.uint16)),
        ):
            path = folder / "freiburg1" / name / f"{index}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            large = cv2.resize(picture, (640, 480), interpolation=cv2.INTER_NEAREST)  # as TUM's are
            cv2.imwrite(str(path), large)
            lists[name].append(f"{observation.stamp_ns * 1e-9:.6f} {name}/{index}.png")
    writer.close()
    _write_film(folder / "clip.mp4")
    (folder / "exposures.txt").write_text("0.0 0.01 1\n0.2 0.02 2\n")
    shutil.copy(ROOT / "modules" / "detectors" / "bright_dark.yaml", folder / "my_scenes.yaml")
    for name, lines in lists.items():
        (folder / "freiburg1" / f"{name}.txt").write_text("\n".join(lines) + "\n")


def _write_film(path: Path) -> None:
    """Write a film of the same images."""
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, RIG.camera.size_wh)
    for index in range(OBSERVATIONS):
        film.write(room_observation(index).image_bgr)
    film.release()


def as_run_here(command: str) -> list[str]:
    """Return a command with the reader's names filled in, at the length of a test.

    What would be rendered by the simulator, which other tests do, is read from the recording.
    """
    words = [_filled(word) for word in shlex.split(command)]
    words[0] = sys.executable if words[0] == "python" else words[0]
    if tuple(shlex.split(command)[:3]) == _RUN:
        if not any(word.startswith(_READS) for word in words):
            words += ["source=mcap", "source.path=FILE.mcap"]
        if "--help" not in words and "--cfg" not in words:
            words.append("run.progress=false")
        words = _fewer(words)
    return words


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command of the documentation in a folder, in a process of its own."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])  # as activated
    return subprocess.run(
        as_run_here(command),
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PATH": path},
        capture_output=True,
        text=True,
        timeout=300,
    )


def run_inside(command: str) -> int:
    """Run a `python -m` command in this process and folder, which saves the imports."""
    arguments, module = as_run_here(command)[3:], shlex.split(command)[2]
    was, sys.argv = sys.argv, [module, *arguments]
    is_package = hasattr(sys.modules.get(module), "__path__")
    sys.modules.pop(f"{module}.__main__" if is_package else module, None)  # a test imported it
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=False)
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = was
    return 0


def _filled(word: str) -> str:
    for name, value in (("FILE", "FILE.mcap"), ("FOLDER", "freiburg1"), ("RUN", "run")):
        word = re.sub(rf"\b{name}\b(?!\.)", value, word)
    return word


def _fewer(words: list[str]) -> list[str]:
    """Return a sweep over two values of its first key."""
    swept = [k for k, word in enumerate(words) if "," in word and not re.search(r"=[\[{]", word)]
    for k in swept:
        key, _, values = word_parts = words[k].partition("=")
        assert all(word_parts), words[k]
        words[k] = f"{key}={','.join(values.split(',')[: 2 if k == swept[0] else 1])}"
    return words
