"""Work done side by side in two threads, and the linear algebra library kept to one of its own.

The compiled kernels release the interpreter lock. Our arrays are long and thin: threads of the linear algebra library
cost more than they bring, spin beside ours, and change last digits.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

Result = TypeVar("Result")

_blas_lock = threading.Lock()
_blas_users = 0
_blas_limit: Any = None
_pools: Any = None
_modules_then = 0


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Inside the block, or the function that it decorates, NumPy's and SciPy's linear algebra runs in one thread.

    The setting is the process's: other threads of the caller have it meanwhile, and afterwards all have back what
    they had, when the last of several blocks that overlap has ended.
    """
    global _blas_users, _blas_limit
    with _blas_lock:
        if _blas_users == 0:
            _blas_limit = thread_pools().select(user_api="blas").limit(limits=1)
        _blas_users += 1
    try:
        yield
    finally:
        with _blas_lock:
            _blas_users -= 1
            if _blas_users == 0:
                _blas_limit.restore_original_limits()


def thread_pools() -> Any:
    """Control over the threads of all loaded libraries, which are sought anew, in milliseconds, after an import."""
    global _pools, _modules_then
    from threadpoolctl import ThreadpoolController

    if _modules_then != len(sys.modules):
        _modules_then = len(sys.modules)
        _pools = ThreadpoolController()
    return _pools


def usable_cores() -> int:
    """Cores that this process may keep busy: ``NUMBA_NUM_THREADS`` where it is set, else all of the machine."""
    return int(os.environ.get("NUMBA_NUM_THREADS") or os.cpu_count() or 1)


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """``list(map(function, *columns))`` in two threads, of which the caller's is one: what a thread has freed stays
    with it, and a caller who waits would keep memory that a third thread has to ask for again. With one core to
    use, or one job, in one."""
    jobs = list(zip(*columns, strict=True))
    if usable_cores() == 1 or len(jobs) < 2:
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
