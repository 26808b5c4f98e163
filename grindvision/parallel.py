"""Work done side by side in two threads; the compiled kernels release the interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")


def usable_cores() -> int:
    """Cores that this process may keep busy: ``NUMBA_NUM_THREADS`` where it is set, else all of the machine."""
    return int(os.environ.get("NUMBA_NUM_THREADS") or os.cpu_count() or 1)


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """``list(map(function, *columns))`` in two threads, of which the caller's is one: what a thread has freed stays
    with it, and a caller who waits would keep memory that a third thread has to ask for again. With one core to
    use, in one."""
    jobs = list(zip(*columns, strict=True))
    if usable_cores() == 1:
        return [function(*job) for job in jobs]
    results: list[Result] = [None] * len(jobs)  # type: ignore[list-item]  # every place is filled below
    waiting = iter(range(len(jobs)))

    def work() -> None:
        for at in waiting:
            results[at] = function(*jobs[at])

    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(work)
        work()
        other.result()
    return results
