"""Run a recorded story live and print what it costs: latency, memory, threads, open files.

    python experiments/live.py                              two laps at the robot's speed
    python experiments/live.py --minutes 30 --rate 2        soak: half an hour at twice the speed
    python experiments/live.py --scenario flicker slam@slam.dark=depth

Every 10 s a line: memory of the run and of the processes that it started (resident), threads and
open files of the run. At the end the latency from an image's stamp to its pose (p50, p99), dropped
images, switches, the ten slowest poses with what their time went to, and by how much memory grew
per hour over the second half. Latency says something on an idle machine alone: how much of it other
processes took is printed too. `--csv FILE` writes the samples, one a minute, or without `--minutes`
the latency. Other words are overrides of the run.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

EVERY_S = 10.0
LAP_S = 20.0  # no story is shorter


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """What a run takes at one time."""

    at_s: float
    memory_mb: float
    children_mb: float
    threads: int
    files: int

    def __str__(self) -> str:
        """Return a line."""
        memory = f"{self.memory_mb:5.0f} MB + {self.children_mb:4.0f} MB in its processes"
        return f"{self.at_s:6.0f} s  {memory}  {self.threads} threads  {self.files} files"


def main() -> None:
    """Run, and print while it runs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=None)
    parser.add_argument("--rate", type=float, default=1.0)
    parser.add_argument("--scenario", default="there_and_back")
    parser.add_argument("--csv", type=Path, default=None)
    given, overrides = parser.parse_known_args()
    laps = 2 if given.minutes is None else int(given.minutes * 60 * given.rate / LAP_S) + 1
    words = [
        f"+scenario={given.scenario}", "run=live", f"run.rate={given.rate}", "effects=laps",
        f"effects.laps={laps}", "run.report=false", "run.progress=false", "~sinks@sinks.rerun",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.Popen(
            [sys.executable, "-m", "sceneslam", *words, *overrides, f"hydra.run.dir={folder}/run"]
        )
        began_s, busy_s = time.monotonic(), machine_busy_s()
        samples = watch(run, Path(folder) / "run", given.minutes)
        others_s = machine_busy_s() - busy_s - children_busy_s()
        others = others_s / (time.monotonic() - began_s) / (os.cpu_count() or 1)
        metrics = json.loads((Path(folder) / "run" / "metrics.json").read_text())
    show(samples, metrics)
    print(f"other processes took {max(others, 0.0):.0%} of the machine")
    if given.csv is not None:
        rows = soak_rows(samples) if given.minutes else [latency_row(metrics)]
        with given.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)


def watch(run: subprocess.Popen[bytes], folder: Path, minutes: float | None) -> list[Sample]:
    """Print and return samples from the first event on until the run ends, or is over time."""
    samples, began_s = list[Sample](), None
    while run.poll() is None:
        time.sleep(EVERY_S if began_s is not None else 0.5)
        events = folder / "events.jsonl"
        if began_s is None and events.is_file() and events.stat().st_size:
            began_s = time.monotonic()
        if began_s is None or run.poll() is not None:
            continue
        samples.append(sample(run.pid, time.monotonic() - began_s))
        print(samples[-1], flush=True)
        if minutes is not None and time.monotonic() - began_s > minutes * 60:
            run.terminate()
            break
    run.wait()
    return samples


def sample(pid: int, at_s: float) -> Sample:
    """Return what a process takes now."""
    process = Path(f"/proc/{pid}")
    return Sample(
        at_s=at_s,
        memory_mb=resident_mb(pid),
        children_mb=sum(resident_mb(child) for child in children(pid)),
        threads=len(list((process / "task").iterdir())),
        files=len(list((process / "fd").iterdir())),
    )


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process, 0 where it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096e-6
    except OSError:
        return 0.0


def children(pid: int) -> Iterator[int]:
    """Yield the processes that a process has started, and theirs."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            found = task.read_text().split()
        except OSError:
            continue
        for child in found:
            yield int(child)
            yield from children(int(child))


def machine_busy_s() -> float:
    """Return the time that all processors have worked since the machine started."""
    user, nice, system, _, _, interrupts, soft = map(
        int, Path("/proc/stat").read_text().split()[1:8]
    )
    return (user + nice + system + interrupts + soft) / os.sysconf("SC_CLK_TCK")


def children_busy_s() -> float:
    """Return the time that processes of this one have worked which have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def soak_rows(samples: list[Sample]) -> list[dict[str, str]]:
    """Return a row a minute."""
    ends = [one for before, one in pairwise(samples) if before.at_s // 60 != one.at_s // 60]
    return [
        {
            "minute": f"{one.at_s / 60:.0f}",
            "memory [MB]": f"{one.memory_mb:.0f}",
            "its processes [MB]": f"{one.children_mb:.0f}",
            "threads": str(one.threads),
            "open files": str(one.files),
        }
        for one in samples[:1] + ends
    ]


def latency_row(metrics: dict[str, Any]) -> dict[str, str]:
    """Return a run's latency as a row of the page's table."""
    latency, slowest = metrics["latency_ms"], metrics["slowest"]
    return {
        "observations": str(metrics["observations"]),
        "switches": str(len(metrics["switches"])),
        "p50 [ms]": f"{latency['p50']:.0f}",
        "p99 [ms]": f"{latency['p99']:.0f}",
        "slowest [ms]": f"{slowest[0]['latency_ms']:.0f}",
        "images dropped": str(metrics["dropped_images"]),
    }


def show(samples: list[Sample], metrics: dict[str, Any]) -> None:
    """Print what the whole run cost."""
    latency = metrics["latency_ms"]
    print(f"stamp to pose: p50 {latency['p50']:.0f} ms, p99 {latency['p99']:.0f} ms")
    taken, dropped = metrics["observations"], metrics["dropped_images"]
    switches = len(metrics["switches"])
    print(f"{taken} observations, {dropped} images dropped, {switches} switches")
    for slow in metrics["slowest"]:
        print(f"  {_why(slow, metrics['start_ns'])}")
    late = samples[len(samples) // 2 :]
    if len(late) > 2:
        hours = np.array([one.at_s for one in late]) / 3600
        memory_mb = np.array([one.memory_mb for one in late])  # its processes come and go
        print(f"memory over the second half: {np.polyfit(hours, memory_mb, 1)[0]:+.0f} MB per hour")
        threads, files = {one.threads for one in late}, {one.files for one in late}
        print(f"threads {min(threads)} to {max(threads)}, files {min(files)} to {max(files)}")


def _why(slow: dict[str, Any], start_ns: int) -> str:
    """Return a slow pose's line: when, how long, and the parts above a tenth of that."""
    parts = sorted(slow["parts_ms"].items(), key=lambda part: -part[1])
    shown = [f"{name} {ms:.0f}" for name, ms in parts if ms > 0.1 * slow["latency_ms"]]
    beside = f"; beside it: {', '.join(slow['beside'])}" if slow["beside"] else ""
    return (
        f"{(slow['stamp_ns'] - start_ns) / 1e9:7.2f} s  {slow['latency_ms']:4.0f} ms: "
        f"{', '.join(shown)} ms (computing {slow['cpu_ms']:.0f} ms){beside}"
    )


if __name__ == "__main__":
    main()
