"""Print what a long run in one place costs, ten minutes by ten minutes.

    python experiments/hour.py FOLDER [OVERRIDES]

A round trip is repeated for an hour of the recording's clock; the run takes what it takes. CPU time
and memory are those of all its processes. The results of the run lie in FOLDER, its progress beside
it.
"""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
import time
from pathlib import Path

LAP_S, HOUR_S, PART_S = 43.7, 3600.0, 600.0  # a lap of there_and_back
RATE_HZ = 10.0
OVERRIDES = [
    "+scenario=there_and_back",
    "effects=laps",
    f"effects.laps={round(HOUR_S / LAP_S) + 1}",
    f"source.camera.rate_hz={RATE_HZ}",
    "source.camera.size_wh=[320,240]",
    "run.report=false",
]
HEAD = "minutes", "observations", "CPU per observation [ms]", "peak memory [MB]"
_DONE = re.compile(rb"(\d+)/\d+ \[")
_TICKS = os.sysconf("SC_CLK_TCK")


def children(pid: int) -> list[int]:
    """Return a process and all that it has started."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += children(int(child))
    return found


def cost(pid: int) -> tuple[float, float]:
    """Return the CPU time [s] and memory [MB] of a process and its children."""
    cpu_s = memory_mb = 0.0
    for each in children(pid):
        words = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
        cpu_s += sum(map(int, words[11:15])) / _TICKS
        pages = int(Path(f"/proc/{each}/statm").read_text().split()[1])
        memory_mb += pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return cpu_s, memory_mb


def main() -> None:
    """Run, and print a row per ten minutes."""
    folder, overrides = Path(sys.argv[1]), sys.argv[2:]
    progress = folder.with_name(f"{folder.name}.progress")
    command = [sys.executable, "-m", "sceneslam", *OVERRIDES, f"hydra.run.dir={folder}", *overrides]
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(HEAD)
    per_part, part, last, peak_mb = round(PART_S * RATE_HZ), 0, (0, 0.0), 0.0
    with progress.open("wb") as log:
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)
        while run.poll() is None:
            time.sleep(0.5)
            counts = _DONE.findall(progress.read_bytes()[-400:])
            try:
                cpu_s, memory_mb = cost(run.pid)
            except (FileNotFoundError, ProcessLookupError):
                continue  # a process has just ended
            peak_mb = max(peak_mb, memory_mb)
            done = int(counts[-1]) if counts else 0
            if done >= (part + 1) * per_part:
                spent_ms = 1e3 * (cpu_s - last[1]) / (done - last[0])
                minutes = f"{10 * part} to {10 * part + 10}"
                table.writerow([minutes, done - last[0], f"{spent_ms:.1f}", f"{peak_mb:.0f}"])
                sys.stdout.flush()
                part, last, peak_mb = part + 1, (done, cpu_s), 0.0
    table.writerow(["end", "-", "-", f"{peak_mb:.0f}"])
    sys.exit(run.returncode)


if __name__ == "__main__":
    main()
