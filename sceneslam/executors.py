"""Executors for calls that may take seconds: in the caller's thread, or live in another one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")


class InStep(Executor):
    """Runs every call immediately, in the thread of its caller."""

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Return the finished call's future; KeyboardInterrupt is raised here."""
        future: Future[_T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def executor(name: str, *, is_live: bool) -> Executor:
    """Return an executor that runs calls one by one; if live, in a thread of that name."""
    return ThreadPoolExecutor(1, thread_name_prefix=name) if is_live else InStep()
