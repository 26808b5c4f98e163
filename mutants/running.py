"""Runs the tests against one fault after the other, each in a fork of a process with its libraries loaded."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mutants.operators import Mutant

#: What a copy of the project needs to run its tests.
COPIED = (
    "grindvision", "grindvision_book", "benchmarks", "mutants", "tests", "data", "notebooks", "figures",
    "pyproject.toml", "environment.txt", "README.md",
)  # fmt: skip
#: What every test file loads anyway; ``grindvision`` itself is loaded after the fork.
LIBRARIES = ("numpy", "scipy.spatial", "scipy.optimize", "scipy.ndimage", "numba", "pandas", "pytest")
#: A run that takes so much longer than without a fault has noticed it: a loop without end.
PATIENCE, MIN_S = 5.0, 120.0


@dataclass(frozen=True)
class Verdict:
    """What became of a fault: ``killed``, ``timeout`` (a loop without end, killed too) or ``survived``."""

    mutant: Mutant
    outcome: str
    tests: str
    seconds: float

    @property
    def noticed(self) -> bool:
        """Whether the tests noticed the fault."""
        return self.outcome != "survived"

    def __str__(self) -> str:
        return f"{self.outcome:8} {self.mutant} ({self.tests}, {self.seconds:.0f} s)"


class Laboratory:
    """A copy of the project in which faults are planted; the project itself stays as it is."""

    def __init__(self, root: Path, place: Path) -> None:
        self.root, self.place = root, place
        for name in LIBRARIES:
            importlib.import_module(name)
        for name in COPIED:
            source = root / name
            if source.is_dir():
                shutil.copytree(source, place / name)
            elif source.exists():
                shutil.copy2(source, place / name)
        self.usual_s: dict[str, float] = {}

    def sound(self, tests: Sequence[str]) -> bool:
        """Whether the tests pass without a fault; warms the compiled kernels' caches and takes the time."""
        begin = time.perf_counter()
        passed = self._run(tests, 3600.0) == "survived"
        self.usual_s[" ".join(tests)] = time.perf_counter() - begin
        return passed

    def judge(self, mutant: Mutant, tests: Sequence[str]) -> Verdict:
        """Plant the fault, run the tests until the first that fails, and mend the copy again."""
        names = " ".join(tests)
        package = mutant.path.split("/")[0]
        file, kept = self.place / mutant.path, self.place / f"{package}.kept"
        shutil.copytree(self.place / package, kept)
        begin = time.perf_counter()
        try:
            file.write_text(mutant.applied(file.read_text(encoding="utf-8")), encoding="utf-8")
            outcome = self._run(tests, max(PATIENCE * self.usual_s.get(names, 0.0), MIN_S))
        finally:
            shutil.rmtree(self.place / package)
            kept.rename(self.place / package)
        return Verdict(mutant, outcome, names, time.perf_counter() - begin)

    def _run(self, tests: Sequence[str], limit_s: float) -> str:
        child = os.fork()
        if child == 0:
            os.setsid()
            self._test(tests)
        deadline = time.perf_counter() + limit_s
        while time.perf_counter() < deadline:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return "survived" if os.waitstatus_to_exitcode(status) == 0 else "killed"
            time.sleep(0.05)
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return "timeout"

    def _test(self, tests: Sequence[str]) -> None:
        """In the forked process: run the tests in the copy, quietly, and end."""
        code = 70
        try:
            os.chdir(self.place)
            log = os.open(self.place / "last.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            sys.path.insert(0, str(self.place))
            os.environ["PYTHONPATH"] = str(self.place)
            import pytest

            asked = ["tests/" + "::".join([f"{name}.py", *test]) for name, *test in (one.split("::") for one in tests)]
            code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *asked]))
        finally:
            os._exit(code)
