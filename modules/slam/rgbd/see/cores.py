"""Run work in another process or thread if a spare core is available."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future
from copy import deepcopy
from typing import Generic, TypeVar

from sceneslam.executors import InStep, executor

from .side_process import SideProcess

Task = TypeVar("Task")
Result = TypeVar("Result")


def worker_beside(
    build: Callable[..., Callable[[Task], Result]], *arguments: object
) -> SideProcess[Task, Result] | Here[Task, Result]:
    """Return a worker that does tasks in another process, or here, with the same results."""
    if _has_spare_core():
        return SideProcess(build, *arguments)
    return Here(build(*arguments))


def thread_beside(name: str) -> Executor:
    """Return an executor that runs functions in another thread, or here."""
    return executor(name, is_live=_has_spare_core())


def _has_spare_core() -> bool:
    """Tell whether this run may use more than one core; a sweep may reserve all for its jobs."""
    return os.environ.get("SCENESLAM_CORES") != "1"


class Here(Generic[Task, Result]):
    """Does each task at once on a copy, as another process would."""

    def __init__(self, work: Callable[[Task], Result]) -> None:
        self._work = work

    def submit(self, task: Task) -> Future[Result]:
        """Return the future of the finished task."""
        return InStep().submit(self._work, deepcopy(task))

    def end(self) -> None:
        """Do nothing: no task is pending."""
