"""Change the code one line at a time and count how often the tests notice.

python experiments/mutation.py detectors --sample 100 --seed 0 --csv FILE

The changes are made by cosmic-ray (`pip install '.[mutation]'`), in a copy of what git tracks. Of
many mutants an even sample is run. What is listed at the end survived: no test saw it.
"""

from __future__ import annotations

import argparse
import csv
import random
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import WorkerOutcome, WorkItem, WorkResult

ROOT = Path(__file__).resolve().parents[1]
_PARTS = {  # name -> its code, and the tests that guard it
    "detectors": (
        ["modules/detectors"],
        [
            "tests/test_detectors.py",
            "tests/test_detector_rules.py",
            "tests/test_detector_features.py",
            "tests/test_detector_lens.py",
            "tests/test_detector_wheel_check.py",
            "tests/test_detector_onnx.py",
            "tests/test_exposure.py",
        ],
    ),
    "atlas": (
        ["sceneslam/atlas"],
        [
            "tests/test_atlas_submaps.py",
            "tests/test_atlas_limits.py",
            "tests/test_atlas_places.py",
            "tests/test_atlas_loops.py",
            "tests/test_atlas_maps.py",
            "tests/test_atlas_graph.py",
            "tests/test_atlas_run_loops.py",
            "tests/test_long_runs.py",
            "tests/test_atlas_upright.py",
            "tests/test_atlas.py",
            "tests/test_revision.py",
            "tests/test_uncertainty.py",
            "tests/test_one_map*.py",
        ],
    ),
    "bus": (
        ["sceneslam/bus"],
        [
            "tests/test_bus_limits.py",
            "tests/test_module_answers.py",
            "tests/test_policy.py",
            "tests/test_memory.py",
            "tests/test_machine.py",
            "tests/test_tilt.py",
            "tests/test_pace.py",
            "tests/test_bayes_filter.py",
            "tests/test_bus*.py",
            "tests/test_restarts.py",
            "tests/test_gate.py",
            "tests/test_uncertainty.py",
            "tests/test_handover.py",
            "tests/test_calibration.py",
        ],
    ),
}
# With `from __future__ import annotations` an annotation is not run: `X | None` cannot fail.
_NEVER_RUN = re.compile(r"core/ReplaceBinaryOperator_BitOr_|core/ReplaceBinaryOperator_.*_BitOr$")
_CONFIG = """\
[cosmic-ray]
module-path = {modules}
timeout = {timeout_s}
excluded-modules = []
test-command = {command}
[cosmic-ray.distributor]
name = "local"
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 1 where fewer than the least share of mutants was killed."""
    options = _parser().parse_args(arguments)
    code, tests = _PARTS[options.part]
    with tempfile.TemporaryDirectory(prefix="mutation_") as name:
        copy = Path(name)
        _copy_tracked(copy)
        found = [str(test.relative_to(copy)) for glob in tests for test in sorted(copy.glob(glob))]
        files = list(dict.fromkeys(found))  # in the order of the list: the quickest first
        pytest = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *files]
        config = _CONFIG.format(
            modules=code, timeout_s=options.timeout_s, command=repr(" ".join(pytest))
        )
        (copy / "cosmic.toml").write_text(config.replace("'", '"'))
        _call(copy, "init", "cosmic.toml", "mutants.sqlite")
        _call(copy, "baseline", "cosmic.toml")
        with use_db(str(copy / "mutants.sqlite"), WorkDB.Mode.open) as database:
            total = _sample(database, options.sample, options.seed)
        _call(copy, "exec", "cosmic.toml", "mutants.sqlite")
        with use_db(str(copy / "mutants.sqlite"), WorkDB.Mode.open) as database:
            rows = [_row(item, result) for item, result in database.completed_work_items]
    return _report(sorted(rows), total, options)


def _copy_tracked(copy: Path) -> None:
    """Copy what git tracks; the packages lie where their names say, as in an installed wheel."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    for name in listed.stdout.decode().split("\0"):
        if name and (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).write_bytes((ROOT / name).read_bytes())
    for package in ("conf", "modules", "experiments"):
        (copy / "sceneslam" / package).symlink_to(copy / package)


def _call(folder: Path, *words: str) -> None:
    subprocess.run(["cosmic-ray", *words], cwd=folder, check=True)


def _sample(database: WorkDB, count: int, seed: int) -> int:
    """Keep so many mutants, drawn evenly; return how many there were."""
    items = [
        item
        for item in database.work_items
        if not any(_NEVER_RUN.search(mutation.operator_name) for mutation in item.mutations)
    ]
    items.sort(key=_place)
    kept = random.Random(seed).sample(items, min(count, len(items)))
    database.clear()
    database.add_work_items(kept)
    return len(items)


def _place(item: WorkItem) -> tuple[str, int, int, str, int]:
    (mutation,) = item.mutations
    line, column = mutation.start_pos
    path = mutation.module_path.as_posix()
    return path, line, column, mutation.operator_name, mutation.occurrence


def _row(item: WorkItem, result: WorkResult) -> tuple[str, int, str, str]:
    """Return file, line, what was changed, and whether a test saw it."""
    path, line, _, operator, _ = _place(item)
    is_run = result.worker_outcome in (WorkerOutcome.NORMAL, WorkerOutcome.ABNORMAL)
    outcome = ("killed" if result.is_killed else "survived") if is_run else "not run"
    return path, line, operator.removeprefix("core/"), outcome


def _report(
    rows: Sequence[tuple[str, int, str, str]], total: int, options: argparse.Namespace
) -> int:
    run = [row for row in rows if row[3] != "not run"]
    killed = sum(row[3] == "killed" for row in run)
    share = killed / max(len(run), 1)
    for path, line, operator, outcome in rows:
        if outcome == "survived":
            print(f"survived  {path}:{line}  {operator}")
    print(f"{options.part}: {killed} of {len(run)} killed ({share:.1%}), of {total} mutants in all")
    if options.csv is not None:
        with options.csv.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerows([("file", "line", "change", "outcome"), *rows])
    return int(share < options.least)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("part", choices=_PARTS)
    parser.add_argument("--sample", type=int, default=10**6, help="so many mutants (all)")
    parser.add_argument("--seed", type=int, default=0, help="of the sample (0)")
    parser.add_argument("--timeout-s", type=float, default=120.0, help="of a test run (120)")
    parser.add_argument("--least", type=float, default=0.85, help="share that is to be killed")
    parser.add_argument("--csv", type=Path, help="where every mutant is listed")
    return parser


if __name__ == "__main__":
    sys.exit(main())
