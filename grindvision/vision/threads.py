"""Work done side by side in two threads; the compiled kernels release the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")


def side_by_side(function: Callable[..., Result], *columns: Iterable) -> list[Result]:
    """``list(map(function, *columns))`` in two threads, of which the caller's is one: what a thread has freed stays
    with it, and a caller who waits would keep memory that a third thread has to ask for again."""
    jobs = list(zip(*columns, strict=True))
    results: list[Result | None] = [None] * len(jobs)
    waiting = iter(range(len(jobs)))

    def work() -> None:
        for at in waiting:
            results[at] = function(*jobs[at])

    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(work)
        work()
        other.result()
    return results
