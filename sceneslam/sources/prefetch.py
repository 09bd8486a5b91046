"""Decoding ahead of use, in threads, in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")


def prefetched(
    jobs: Iterable[Callable[[], Item]], *, workers: int = 1, ahead: int = 4
) -> Iterator[Item]:
    """Yield each job's result in the jobs' order while up to `ahead` more are being worked on.

    One worker beside the caller is what two cores carry: more only take turns with the tracking.
    The jobs themselves are drawn in the caller's thread. A job's exception is raised where its
    result would have come. When the caller stops, work that has not begun is dropped.
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
