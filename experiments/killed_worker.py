"""Kill the process of a SLAM module in the middle of a run, and print what became of the run.

    python experiments/killed_worker.py                        orb_slam3, which has its own process
    python experiments/killed_worker.py rgbd run.isolation=process
    python experiments/killed_worker.py orb_slam3 --kill-at 4 12 run=live

The module runs in the light of `bright_to_dark` with all lamps on, `laser` is its fallback; further
words are overrides. Printed is, for each kill, when the fallback took over and when the module was
back, on the recording's clock; then coverage, error, and whether any process was left behind.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

POLL_S = 0.02
KEY = "bright"  # of slam: the module that is killed


def main() -> int:
    """Run, kill, and print; return 1 where the run did not survive."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("module", nargs="?", default="orb_slam3")
    parser.add_argument("--kill-at", type=float, nargs="+", default=[5.0], metavar="SECONDS")
    given, overrides = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "+scenario=bright_to_dark", "lights=on", f"slam@slam.{KEY}={given.module}",
            "run.report=false", "run.progress=false", "~sinks@sinks.rerun",
            f"hydra.run.dir={folder}/run", *overrides,
        ]  # fmt: skip
        run = subprocess.Popen([sys.executable, "-m", "sceneslam", *words])
        killed = [kill(run, Path(folder) / "run", at_s) for at_s in given.kill_at]
        run.wait()
        left = [pid for pids in killed for pid in pids if Path(f"/proc/{pid}").exists()]
        metrics = json.loads((Path(folder) / "run" / "metrics.json").read_text())
        show(list(events(Path(folder) / "run")), given.kill_at)
    print(f"coverage {100 * metrics['coverage']:.1f} %, ATE {metrics['ate_online_m']:.4f} m")
    print(f"processes left behind: {len(left)}")
    return 0 if metrics["coverage"] > 0.99 and not left and all(killed) else 1


def kill(run: subprocess.Popen[bytes], folder: Path, at_s: float) -> list[int]:
    """Kill what works for the module once the run is so far; return the processes."""
    while run.poll() is None:
        told = list(events(folder))
        stamps_ns = [event["stamp_ns"] for event in told if event["event"] == "vote"]
        is_far = bool(stamps_ns) and stamps_ns[-1] - stamps_ns[0] > at_s * 1e9
        if is_far and active(told) == KEY:
            workers = [pid for pid in children(run.pid) if works(pid)]
            for pid in workers:
                os.kill(pid, signal.SIGKILL)
            return workers
        time.sleep(POLL_S)
    return []


def events(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield what a run has told so far."""
    path = folder / "events.jsonl"
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:  # it is being written
            return


def active(told: list[dict[str, Any]]) -> str:
    """Return the module of the last decision."""
    decisions = [event["to"] for event in told if event["event"] == "decision"]
    return str(decisions[-1]) if decisions else ""


def children(pid: int) -> Iterator[int]:
    """Yield the processes that a process has started."""
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        yield from (int(child) for child in task.read_text().split())


def works(pid: int) -> bool:
    """Tell whether a process has computed for half a second: one that only stands by has not."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") > 0.5


def show(told: list[dict[str, Any]], kills_s: list[float]) -> None:
    """Print what came after each kill."""
    first_ns = next(event["stamp_ns"] for event in told if event["event"] == "vote")

    def at_s(event: dict[str, Any]) -> float:
        return float(event["stamp_ns"] - first_ns) / 1e9

    faults = [event for event in told if event["event"] == "fault"]
    decisions = [event for event in told if event["event"] == "decision"]
    for fault in faults:
        print(f"{at_s(fault):6.2f} s  {fault['what']}")
        later = [one for one in decisions if one["stamp_ns"] >= fault["stamp_ns"]]
        fallback = next((one for one in later if one["to"] != KEY), None)
        if fallback is not None:
            print(f"{at_s(fallback):6.2f} s  {fallback['to']} took over ({fallback['reason']})")
            back = next((one for one in later if one["to"] == KEY), None)
            print(
                f"{at_s(back):6.2f} s  {KEY} is back" if back else "          it did not come back"
            )
    if len(faults) < len(kills_s):
        print(f"{len(kills_s)} asked for, {len(faults)} noticed")


if __name__ == "__main__":
    sys.exit(main())
