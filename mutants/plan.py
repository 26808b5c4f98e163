"""pytest plugin: the tests most likely to notice a fault first, then the cheapest; the time of each is kept.

Loaded in the process that tests a fault. Names of tests are pytest's own, ``tests/test_x.py::test_y[z]``.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import pytest

#: What a test of unknown cost is taken to need where tests are sorted, s.
UNKNOWN_S = 1.0
#: A test that computes so many times longer than it did before, and at least so long, is in a loop without end; kernels
#: may have to be compiled. One of unknown cost gets more.
PATIENCE, MIN_S, UNKNOWN_LIMIT_S = 10.0, 60.0, 240.0


class Plan:
    """Sorts the tests, stops one that never ends, keeps the seconds of those that pass and the name of the last."""

    def __init__(self, seconds: Path, last: Path, first: Sequence[str]) -> None:
        self.path, self.last, self.first = seconds, last, list(first)
        self.cost: dict[str, float] = json.loads(seconds.read_text()) if seconds.exists() else {}
        self.passed = True

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Killers of other faults of the file, then by cost in steps of four; within a step files stay together, and
        so do their fixtures."""
        items.sort(key=lambda item: self._rank(item.nodeid))

    def _rank(self, name: str) -> tuple[int, int]:
        if name in self.first and self.cost.get(name, UNKNOWN_S) < 4.0:
            return (-1, self.first.index(name))
        return (step_of(self.cost.get(name, UNKNOWN_S)), 0)

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, None]:
        """Time one test, and end the process where it computes without end."""
        begin, known_s = time.process_time(), self.cost.get(item.nodeid)
        signal.signal(signal.SIGPROF, signal.SIG_DFL)  # ends the process inside a compiled kernel too
        limit_s = UNKNOWN_LIMIT_S if known_s is None else max(PATIENCE * known_s, MIN_S)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        self.last.write_text(item.nodeid)
        yield
        took_s = round(time.process_time() - begin, 3)
        if self.passed:
            self.cost[item.nodeid] = took_s if known_s is None else min(took_s, known_s)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Notice a failure."""
        self.passed = self.passed and not report.failed

    def pytest_sessionfinish(self) -> None:
        """Keep what has been learnt."""
        signal.setitimer(signal.ITIMER_PROF, 0)
        self.path.write_text(json.dumps(self.cost, indent=0, sort_keys=True))


def step_of(seconds: float) -> int:
    """Steps of cost, each four times the one below: 0 up to 0.06 s."""
    return next(step for step in range(99) if seconds <= 0.0625 * 4**step)


def leave_kernels_as_they_were(file: Path, sound: bytes) -> None:
    """Let the cache of compiled kernels take a file for unchanged: the fault in it is in no kernel."""
    from grindvision import kernels

    read = kernels._content
    kernels._content = lambda source: sound if source == file else read(source)  # type: ignore[assignment]
