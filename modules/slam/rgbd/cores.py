"""What is done beside the tracking, where this process has a core to spare for it."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from copy import deepcopy
from typing import Any, Generic, TypeVar

from .side_process import SideProcess

Task = TypeVar("Task")
Result = TypeVar("Result")


def worker_beside(
    build: Callable[..., Callable[[Task], Result]], *arguments: object
) -> SideProcess[Task, Result] | Here[Task, Result]:
    """Return what does tasks in a process of its own, or here: with the same results."""
    if _has_spare_core():
        return SideProcess(build, *arguments)
    return Here(build(*arguments))


def thread_beside(name: str) -> Executor:
    """Return what runs functions in a thread of its own, or here."""
    if _has_spare_core():
        return ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
    return _AtOnce()


def _has_spare_core() -> bool:
    """Tell whether more than one core is this run's: a sweep says so where its jobs take all."""
    return os.environ.get("SCENESLAM_CORES") != "1"


class Here(Generic[Task, Result]):
    """Does each task when it comes, on a copy, as another process would."""

    def __init__(self, work: Callable[[Task], Result]) -> None:
        self._work = work

    def submit(self, task: Task) -> Future[Result]:
        """Return when it is done."""
        return _AtOnce().submit(self._work, deepcopy(task))

    def end(self) -> None:
        """Do nothing: it is at nothing."""


class _AtOnce(Executor):
    """Runs functions when they come."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done = Future[Any]()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        return done
