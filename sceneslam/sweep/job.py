"""One job of a sweep, as a process: `python -m sceneslam.sweep.job FOLDER`."""

from __future__ import annotations

import os
import pickle
import platform
import sys
import traceback
from pathlib import Path
from typing import cast

from hydra import version
from hydra._internal.callbacks import Callbacks
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.utils import run_job
from hydra.types import HydraContext
from omegaconf import DictConfig, open_dict, read_write

from sceneslam.cli import CONFIG, INCOMPLETE, OK, Ended, carry_out
from sceneslam.collect.status import State, Status
from sceneslam.interrupts import terminate_with
from sceneslam.leaving import leave_threads
from sceneslam.sweep.plugin import COMPOSED

_STATES = {OK: State.DONE, INCOMPLETE: State.INCOMPLETE}


def main() -> None:
    """Run the job of a folder and write its status there."""
    folder = Path(sys.argv[1])
    terminate_with(0)  # not sys.stdin, whose lock would still be held at the end of the job
    status = Status.read(folder) or Status(state=State.WAITING)
    status.now(State.RUNNING, host=platform.node(), pid=os.getpid()).write(folder)
    state, error = _run(folder)
    status.now(state, error, host=platform.node(), pid=os.getpid()).write(folder)
    leave_threads(0)


def _run(folder: Path) -> tuple[State, str]:
    """Return a job's final state and error."""
    try:
        with (folder / COMPOSED).open("rb") as file:
            config: DictConfig = pickle.load(file)
        _place(config, folder)
        ended = _carried_out(config)
    except KeyboardInterrupt:
        return State.STOPPED, "stopped while it ran"
    except Exception as error:
        traceback.print_exc()
        return State.FAILED, f"unexpected {type(error).__name__}: {error}; see job.log"
    return _STATES.get(ended.code, State.FAILED), "; ".join(ended.errors)


def _place(config: DictConfig, folder: Path) -> None:
    """Set where a job is: its sweep may have been moved since it was composed."""
    depth = len(Path(str(config.hydra.sweep.subdir)).parts)
    with read_write(config.hydra), open_dict(config.hydra):
        config.hydra.sweep.dir = str(folder.parents[depth - 1])
        config.hydra.runtime.output_dir = str(folder)


def _carried_out(config: DictConfig) -> Ended:
    """Run a configuration as a job of Hydra, with the same search path for compositions."""
    search_path = create_config_search_path(CONFIG)
    for source in config.hydra.runtime.config_sources:
        if source.provider == "command-line":  # the user's --config-dir
            search_path.append(source.provider, f"{source.schema}://{source.path}")
    version.setbase(config.hydra.runtime.version_base)
    hydra = Hydra.create_main_hydra2(config.hydra.job.name, search_path)
    done = run_job(
        task_function=carry_out,
        config=config,
        job_dir_key="hydra.sweep.dir",
        job_subdir_key="hydra.sweep.subdir",
        hydra_context=HydraContext(hydra.config_loader, Callbacks(config)),
    )
    return cast(Ended, done.return_value)


if __name__ == "__main__":
    main()
