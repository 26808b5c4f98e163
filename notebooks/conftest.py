"""Chapters that pytest runs have the fast setting and one thread each, whatever the tests beside them have."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

FAST = {
    "GRINDVISION_FAST": "1",
    "NUMBA_NUM_THREADS": "1",
    "LOKY_MAX_CPU_COUNT": "1",
}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.pop("MPLBACKEND", None)  # a kernel draws into its notebook
    if item.path.parent == Path(__file__).parent:
        os.environ.update(FAST)
    try:
        return (yield)
    finally:
        os.environ.clear()
        os.environ.update(before)
