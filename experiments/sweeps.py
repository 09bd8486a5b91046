"""Do sweeps keep their promises? Each launcher's table, a killed job, two workers against one.

    python experiments/sweeps.py [OVERRIDE ...]
    python experiments/sweeps.py throughput [OVERRIDE ...]

The overrides go to every job, to make them shorter.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter, sleep

from sceneslam.collect.status import State, Status

_LAUNCHERS = ("basic", "joblib", "submitit_local", "ray")
_SWEEP = (sys.executable, "-m", "sceneslam", "-m", "+experiment=threshold_sweep")


def main(words: list[str]) -> None:
    """Print what was found."""
    with tempfile.TemporaryDirectory(prefix="sweeps") as name:
        if words[:1] == ["throughput"]:
            _throughput(Path(name), words[1:])
            return
        _tables(Path(name), words)
        _killed(Path(name), words)


def _tables(folder: Path, words: list[str]) -> None:
    print("| launcher | jobs | done | wall [s] | table.csv as of basic |\n|---|---|---|---|---|")
    for launcher in _LAUNCHERS:
        out = folder / launcher
        began_s = perf_counter()
        _sweep(out, launcher, words).wait()
        wall_s = perf_counter() - began_s
        states = [_state(path) for path in _jobs(out)]
        is_same = (out / "table.csv").read_bytes() == (folder / "basic/table.csv").read_bytes()
        done = states.count(State.DONE)
        same = "the same to the bit" if is_same else "ANOTHER"
        print(f"| {launcher} | {len(states)} | {done} | {wall_s:.0f} | {same} |", flush=True)


def _killed(folder: Path, words: list[str]) -> None:
    """Kill a job half-way, and a worker of Ray with its job; then resume."""
    print("\n| launcher | killed | states of the others | after resuming | table.csv |")
    print("|---|---|---|---|---|")
    for launcher, what in (("joblib", "job"), ("ray", "worker")):
        out = folder / f"{launcher}_{what}_killed"
        sweep = _sweep(out, launcher, words)
        pid = _running(out / "5")
        os.kill(_parent(pid) if what == "worker" else pid, signal.SIGKILL)
        sweep.wait()
        states = [_state(path) for path in _jobs(out)]
        others = {state.value for k, state in enumerate(states) if k != 5}
        subprocess.run([sys.executable, "-m", "sceneslam.sweep", str(out)], **_QUIET)
        again = {_state(path).value for path in _jobs(out)}
        is_same = (out / "table.csv").read_bytes() == (folder / "basic/table.csv").read_bytes()
        same = "the same to the bit" if is_same else "ANOTHER"
        told = f"{states[5].value} | {', '.join(others)} | {', '.join(again)}"
        print(f"| {launcher} | {what} 5: {told} | {same} |", flush=True)


def _throughput(folder: Path, words: list[str]) -> None:
    """Compare two workers with one; both pay for starting and composing."""
    seconds = {}
    for n_jobs in (1, 2):
        began_s = perf_counter()
        _sweep(folder / str(n_jobs), "joblib", [f"hydra.launcher.n_jobs={n_jobs}", *words]).wait()
        seconds[n_jobs] = perf_counter() - began_s
        print(f"n_jobs={n_jobs}: {len(_jobs(folder / str(n_jobs)))} jobs, {seconds[n_jobs]:.1f} s")
    print(f"two workers have {seconds[1] / seconds[2]:.2f} times the throughput of one")


_QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "check": False}


def _sweep(out: Path, launcher: str, words: list[str]) -> subprocess.Popen[bytes]:
    command = [*_SWEEP, f"hydra/launcher={launcher}", f"hydra.sweep.dir={out}", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _jobs(out: Path) -> list[Path]:
    return sorted((path.parent for path in out.glob("*/job.json")), key=lambda path: int(path.name))


def _state(job: Path) -> State:
    status = Status.read(job)
    return State.WAITING if status is None else status.state


def _running(job: Path) -> int:
    """Wait until a job runs; return its process."""
    while (status := Status.read(job)) is None or status.state is not State.RUNNING:
        sleep(0.02)
    return status.pid or 0


def _parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


if __name__ == "__main__":
    main(sys.argv[1:])
