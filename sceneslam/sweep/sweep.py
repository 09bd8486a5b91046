"""Running of the missing jobs of a sweep, and its table."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from sceneslam.collect.overview import overview
from sceneslam.collect.rows import rows_of
from sceneslam.collect.status import State, Status
from sceneslam.collect.write import write_rows
from sceneslam.interrupts import termination_noted
from sceneslam.storage.folder import RunFolder
from sceneslam.sweep.backends import BACKENDS, Backend
from sceneslam.sweep.progress import Progress
from sceneslam.sweep.snapshot import keep_code
from sceneslam.sweep.supervise import JobOrder, settle
from sceneslam.types.errors import ConfigError, InputError, text_of
from sceneslam.types.files import whole

_OWN = ".sweep"  # in a sweep's folder: launcher, code and stop file
_KEPT = "sweep.json"
_TOLD_ERRORS = 10


def run_sweep(
    sweep: Path, folders: Sequence[Path], launcher: Mapping[str, Any], began_in: Path
) -> bool:
    """Run the jobs that are not final; return whether all are complete. Writes the table.

    A job that only lacks poses is final. Other incomplete ones, such as one of damaged input or of
    a full disk, are run again; one that a stop keeps from beginning has its earlier results.

    `launcher` has the name of a backend, in `backend`, and its settings; `began_in` is the base
    folder of relative paths.
    """
    backend = _backend(launcher)
    own = sweep / _OWN
    own.mkdir(parents=True, exist_ok=True)
    jobs = [folder.relative_to(sweep).as_posix() for folder in folders]
    kept = {"launcher": dict(launcher), "began_in": str(began_in), "jobs": jobs}
    with whole(own / _KEPT) as file:
        file.write(json.dumps(kept, indent=2) + "\n")
    stop = own / "stop"
    stop.unlink(missing_ok=True)
    before = {folder: _status(folder) for folder in folders}
    missing = [folder for folder in folders if not before[folder].is_final(folder)]
    for folder in missing:
        before[folder].now(State.WAITING, wall_s=None, pid=None).write(folder)
    if missing:
        code = keep_code(own / "code")
        orders = [
            JobOrder(folder=folder, code=code, began_in=began_in, stop=stop) for folder in missing
        ]
        with termination_noted(stop.touch), Progress(missing):
            backend.run(orders)
    for folder in missing:
        settle(folder, State.STOPPED, "never began")
        now = _status(folder)
        if now.state is State.STOPPED and now.pid is None and before[folder].is_settled:
            before[folder].write(folder)
    _tell(sweep, folders, skipped=len(folders) - len(missing))
    return all(_status(folder).state is State.DONE for folder in folders)


def resume(sweep: Path) -> bool:
    """Run the missing jobs of a sweep as composed; return whether all are complete then."""
    path = sweep / _OWN / _KEPT
    if not path.is_file():
        raise InputError(f"not the folder of a sweep (it has no {_OWN}/{_KEPT}): {sweep}")
    try:
        kept = json.loads(path.read_text())
        launcher, began_in = dict(kept["launcher"]), Path(kept["began_in"])
        folders = [sweep / str(name) for name in kept["jobs"]]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(f"the sweep's file is damaged ({text_of(error)}): {path}") from error
    for folder in folders:
        if Status.read(folder) is None:
            how = f"give the sweep's command again, with hydra.sweep.dir={sweep}"
            raise InputError(f"a job's folder or status is missing ({how}): {folder}")
    if not began_in.is_dir():
        raise InputError(f"the folder in which the sweep began is missing: {began_in}")
    with closing(RunFolder.claim(sweep, kind="sweep")):
        return run_sweep(sweep, folders, launcher, began_in)


def _tell(sweep: Path, folders: Sequence[Path], *, skipped: int) -> None:
    """Write the sweep's table and page, and print how its jobs ended."""
    rows = rows_of(sweep, folders)
    if not rows:
        raise InputError(f"no run in the folder: {sweep}")
    page = write_rows(sweep, rows)
    print(overview(rows), end="")
    statuses = {folder: _status(folder) for folder in folders}
    counts = Counter(status.state.value for status in statuses.values())
    wrong = [(folder, status) for folder, status in statuses.items() if status.error]
    for folder, status in wrong[:_TOLD_ERRORS]:
        print(f"error: job {folder.relative_to(sweep)}: {status.error}", file=sys.stderr)
    counted = ", ".join(f"{count} {state}" for state, count in counts.items())
    was = f" ({skipped} of them before)" if skipped else ""
    print(f"{len(folders)} jobs: {counted}{was}\ntable    {page.parent}/table.csv\npage     {page}")


def _backend(launcher: Mapping[str, Any]) -> Backend:
    settings = dict(launcher)
    name = settings.pop("backend", None)
    if name not in BACKENDS:
        raise ConfigError("hydra.launcher.backend", name, " | ".join(BACKENDS))
    try:
        made: Backend = BACKENDS[name](**settings)
    except ConfigError as error:
        raise error.under("hydra.launcher") from error
    return made


def _status(folder: Path) -> Status:
    return Status.read(folder) or Status(state=State.WAITING)
