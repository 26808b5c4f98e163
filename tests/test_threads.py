"""Work side by side in two threads."""

import threading

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from grindvision.parallel import one_blas_thread, parallel_map


def test_results_come_in_order_as_those_of_map():
    assert parallel_map(pow, range(50), [2] * 50) == [number**2 for number in range(50)]
    assert parallel_map(abs, []) == []


def test_two_jobs_run_at_once(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    both = threading.Barrier(2, timeout=60)
    assert sorted(parallel_map(lambda _: both.wait(), range(2))) == [0, 1]


def test_a_process_that_may_use_one_core_starts_no_thread(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    assert parallel_map(lambda _: threading.get_ident(), range(4)) == [threading.get_ident()] * 4


@pytest.mark.parametrize("broken", range(4))
def test_what_is_raised_comes_through(broken):
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda number: 1 / (number - broken), range(4))


def test_linear_algebra_is_kept_to_one_thread_and_released_every_time():
    def threads():
        return {one["filepath"]: one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        for _ in range(2):
            with one_blas_thread():
                assert set(threads().values()) == {1}
            assert threads() == before
