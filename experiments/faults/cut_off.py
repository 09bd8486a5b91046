"""Faults of the whole program: a run is struck from outside at a random instant, then recovered.

Every run is a process of its own, forked from one that has imported what it needs, in a folder
that holds foreign files. What it reported is noted outside of it, in memory that outlives it.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import RLock
from time import sleep
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from tqdm import tqdm

from sceneslam.app import run
from sceneslam.experiments.faults.torn import torn_files
from sceneslam.experiments.faults.witness import reported_ns
from sceneslam.recover.__main__ import main as recover
from sceneslam.storage.folder import RunFolder
from sceneslam.storage.journal import JOURNAL
from sceneslam.streams import secure_streams
from sceneslam.types.trajectory import Trajectory

KINDS = ("kill", "terminate", "hang up", "closed streams", "full streams", "broken pipe", "disk")
_FOREIGN = ("notes.txt", "trajectory_gps.tum", "figures/fig1.png", "map/survey.pgm")
_PRELOAD = [
    __name__,
    "sceneslam.evaluation.figures.run_figures",
    "matplotlib.figure",
    "mcap.writer",
]
_DISK_KB = (1200, 6000)
_BAG = str(files("sceneslam.conf").joinpath("source/rosbag.yaml"))
_PATIENCE_S = 120.0
_SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "hang up": signal.SIGHUP}


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """How one run went that was struck."""

    kind: str
    was_cut: bool  # before its end
    lost_s: float  # of what it reported, in the recording's time
    foreign: int  # foreign files that were changed
    torn: tuple[str, ...]  # files that have their names and are not whole
    is_right: bool  # the trajectory is the undisturbed run's, as far as the run came


@dataclass(slots=True)
class Program:
    """Runs of one configuration, which has the sink `run.mcap`, each struck by one fault."""

    config: Mapping[str, Any]
    folder: Path
    _whole: Trajectory = field(init=False)  # as reported by the undisturbed run

    def __post_init__(self) -> None:
        """Run it undisturbed: what the others are compared with.

        All of them read what a first run recorded, so that none waits for the simulator.
        """
        recorded = self.folder / "recorded"
        _ended(self._start(recorded, "none", self.folder / "recorded.told"))
        bag: Any = OmegaConf.to_container(OmegaConf.load(_BAG))
        self.config = {**self.config, "source": bag | {"path": str(recorded / "run.mcap")}}
        _ended(self._start(self.folder / "whole", "none", self.folder / "whole.told"))
        self._whole = Trajectory.read_tum(self.folder / "whole" / "trajectory_online.tum")

    def strike(self, kind: str, seed: int) -> Cut:
        """Run it with a fault of a kind, at an instant and of a size that the seed draws."""
        draw = np.random.default_rng(seed)
        name = f"{kind.replace(' ', '_')}_{seed}"
        disk, told = self.folder / name, self.folder / f"{name}.told"
        disk.mkdir()
        if kind == "disk":
            _mount(disk, int(draw.integers(*_DISK_KB)))
        try:
            return self._struck(kind, disk / "run", told, draw)
        finally:
            if kind == "disk":
                subprocess.run(["umount", "-l", str(disk)], check=True)

    def _struck(self, kind: str, folder: Path, told: Path, draw: np.random.Generator) -> Cut:
        RunFolder.claim(folder).close()
        for foreign in _FOREIGN:
            (folder / foreign).parent.mkdir(exist_ok=True)
            (folder / foreign).write_text(foreign)
        process = self._start(folder, kind, told)
        if kind in _SIGNALS:
            # At some pose, or while the results are written.
            poses = int(draw.integers(len(self._whole) * 11 // 10))
            while process.is_alive() and len(reported_ns(told)) < min(poses, len(self._whole)):
                sleep(1e-3)
            sleep(draw.uniform(0.0, 0.3 if poses > len(self._whole) else 0.03))
            if process.is_alive() and process.pid is not None:
                os.kill(process.pid, _SIGNALS[kind])
        _ended(process)
        torn = torn_files(folder)
        was_cut = (folder / JOURNAL).exists()
        if was_cut:
            _ended(_context().Process(target=_recover, args=(folder,)))
        return Cut(
            kind=kind,
            was_cut=was_cut,
            lost_s=self._lost_s(folder, told),
            foreign=sum((folder / one).read_text() != one for one in _FOREIGN),
            torn=(*torn, *torn_files(folder)),
            is_right=self._is_right(folder, kind),
        )

    def _start(self, folder: Path, kind: str, told: Path) -> BaseProcess:
        witness = {"_target_": "sceneslam.experiments.faults.witness.Outliving", "path": str(told)}
        sinks = {**(self.config.get("sinks") or {}), "told": witness}
        config = {**self.config, "sinks": sinks}
        process: BaseProcess = _context().Process(target=_run, args=(config, folder, kind))
        process.start()
        return process

    def _lost_s(self, folder: Path, told: Path) -> float:
        """Return how much of what was reported is not in the trajectory as reported."""
        stamps_ns = reported_ns(told)
        if not len(stamps_ns):
            return 0.0
        path = folder / "trajectory_online.tum"
        kept = Trajectory.read_tum(path).stamps_ns if path.exists() else stamps_ns[:0]
        first_ns = stamps_ns[0] if not len(kept) else kept[-1]
        return float(max(stamps_ns[-1] - first_ns, 0)) * 1e-9 if len(kept) else np.inf

    def _is_right(self, folder: Path, kind: str) -> bool:
        path = folder / "trajectory_online.tum"
        if not path.exists():
            return kind in _SIGNALS  # before its first observation
        online, whole = Trajectory.read_tum(path), self._whole
        is_whole = kind in _SIGNALS or len(online) == len(whole)
        poses = whole.T_world_base[: len(online)]
        return is_whole and np.array_equal(online.T_world_base, poses)


def _context() -> Any:
    context = get_context("forkserver")
    context.set_forkserver_preload(_PRELOAD)
    return context


def _run(config: Mapping[str, Any], folder: Path, kind: str) -> None:
    """Run in a process of its own, with the streams that the fault calls for."""
    _break_streams(kind)
    secure_streams()
    tqdm.set_lock(RLock())  # a killed process would leave its own, of many processes, behind
    run(config, folder)


def _recover(folder: Path) -> None:
    _break_streams("closed streams")
    secure_streams()
    recover([str(folder)])


def _break_streams(kind: str) -> None:
    if kind == "closed streams":
        for number in (0, 1, 2):
            os.close(number)
    if kind == "full streams":
        for number in (1, 2):
            os.dup2(os.open("/dev/full", os.O_WRONLY), number)
    if kind == "broken pipe":
        reading, writing = os.pipe()
        os.dup2(writing, 1)
        os.dup2(writing, 2)
        os.close(reading)
        os.close(writing)


def _ended(process: BaseProcess) -> None:
    """Wait for a process's end; raises TimeoutError where it does not come."""
    if process.pid is None:
        process.start()
    process.join(_PATIENCE_S)
    if process.is_alive():
        process.kill()
        raise TimeoutError(f"a run did not end within {_PATIENCE_S:g} s")


def _mount(folder: Path, size_kb: int) -> None:
    """Put a disk of so many kB in the place of a folder."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", str(folder)]
    subprocess.run(words, check=True, capture_output=True)


def can_mount(folder: Path) -> bool:
    """Tell whether disks can be made: that is the administrator's right."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        _mount(folder, 100)
    except (OSError, subprocess.CalledProcessError):
        return False
    subprocess.run(["umount", str(folder)], check=True)
    return True
