"""Decoding ahead in threads, with results in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def prefetched(
    jobs: Iterable[Callable[[], Item]], *, workers: int = 1, ahead: int = 4
) -> Iterator[Item]:
    """Yield the jobs' results in order; up to `ahead` further jobs are in progress.

    On two cores, more than one worker beside the caller only slows down tracking. The iterator of
    jobs is advanced in the caller's thread. A job's exception is raised in place of its result.
    When the caller stops, jobs that have not started are dropped.
    """
    pool = ThreadPoolExecutor(max_workers=workers, thread_name_prefix="decode")
    running: deque[Future[Item]] = deque()
    try:
        for job in jobs:
            running.append(pool.submit(job))
            if len(running) > ahead:
                yield running.popleft().result()
        while running:
            yield running.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
