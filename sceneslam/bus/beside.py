"""Where calls that may take seconds are made: in step with a recording, or beside the pose."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_T = TypeVar("_T")


class InStep(Executor):
    """Makes every call at once, in the thread of its caller."""

    def submit(self, fn: Callable[_P, _T], /, *args: _P.args, **kwargs: _P.kwargs) -> Future[_T]:
        """Return what came of the call; KeyboardInterrupt is raised here."""
        future: Future[_T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def executor(name: str, *, is_live: bool) -> Executor:
    """Return what makes one call after the other: live, in a thread of that name."""
    return ThreadPoolExecutor(1, thread_name_prefix=name) if is_live else InStep()
