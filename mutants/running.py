"""Runs the tests against one fault after the other, each in a fork of a process with its libraries loaded."""

from __future__ import annotations

import ast
import importlib
import os
import shutil
import signal
import sys
import textwrap
import time
from collections.abc import Sequence
from pathlib import Path

from mutants.operators import Mutant
from mutants.plan import Plan, leave_kernels_as_they_were
from mutants.record import Verdict, statement_at

#: What a copy of the project needs to run its tests.
COPIED = (
    "grindvision", "grindvision_book", "benchmarks", "mutants", "tests", "data", "notebooks", "figures",
    "pyproject.toml", "environment.txt", "README.md",
)  # fmt: skip
#: What every test file loads anyway; ``grindvision`` itself is loaded after the fork.
LIBRARIES = ("numpy", "scipy.spatial", "scipy.optimize", "scipy.ndimage", "numba", "pandas", "pytest")
#: A run that lasts longer waits for what never comes; tests that compute without end are stopped sooner, in ``Plan``.
LIMIT_S = 1800.0


class Laboratory:
    """A copy of the project in which faults are planted; the project itself stays as it is."""

    def __init__(self, root: Path, place: Path, costs: Path | None = None) -> None:
        self.root, self.place = root, place.resolve()
        for name in LIBRARIES:
            importlib.import_module(name)
        for name in COPIED:
            source = root / name
            if source.is_dir():
                shutil.copytree(source, place / name)
            elif source.exists():
                shutil.copy2(source, place / name)
        self.seconds, self.failed = costs or place / "seconds.json", place / "failed.txt"
        self._sound: dict[str, bool] = {}

    def is_sound(self, test: str) -> bool:
        """Whether a test, by pytest's name, passes without a fault; each is asked once."""
        if test not in self._sound:
            self._sound[test] = self._run([test], [], None) == "survived"
        return self._sound[test]

    def judge(self, mutant: Mutant, tests: Sequence[str], killers: Sequence[str] = ()) -> Verdict:
        """Plant the fault, run the tests until the first that fails, and mend the copy again.

        The order: ``killers``, which have noticed other faults of this file, then the cheapest.

        Raises:
            ValueError: the test that fails also fails without the fault.
        """
        package = mutant.path.split("/")[0]
        file, kept = self.place / mutant.path, self.place / f"{package}.kept"
        asked = ["tests/" + "::".join([f"{name}.py", *test]) for name, *test in (one.split("::") for one in tests)]
        shutil.copytree(self.place / package, kept)
        begin = time.perf_counter()
        try:
            sound = file.read_text(encoding="utf-8")
            file.write_text(mutant.applied(sound), encoding="utf-8")
            unchanged = None if in_a_kernel(sound, mutant) else (file, sound.encode())
            outcome = self._run(asked, killers, unchanged)
            took_s = time.perf_counter() - begin
        finally:
            shutil.rmtree(self.place / package)
            kept.rename(self.place / package)
        if outcome == "survived" or not self.failed.exists():
            return Verdict(mutant, outcome, " ".join(tests), took_s)
        by = self.failed.read_text()
        if not self.is_sound(by):
            raise ValueError(f"{by} fails without a fault; mend that first")
        return Verdict(mutant, outcome, by, took_s)

    def _run(self, tests: Sequence[str], killers: Sequence[str], unchanged: tuple[Path, bytes] | None) -> str:
        self.failed.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            os.setsid()
            self._test(tests, killers, unchanged)
        deadline = time.perf_counter() + LIMIT_S
        while time.perf_counter() < deadline:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return {0: "survived", -signal.SIGPROF: "timeout"}.get(os.waitstatus_to_exitcode(status), "killed")
            time.sleep(0.05)
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return "timeout"

    def _test(self, tests: Sequence[str], killers: Sequence[str], unchanged: tuple[Path, bytes] | None) -> None:
        """In the forked process: run the tests in the copy, quietly, and end."""
        code = 70
        try:
            os.chdir(self.place)
            log = os.open(self.place / "last.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            sys.path.insert(0, str(self.place))
            os.environ["PYTHONPATH"] = str(self.place)
            os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # a fault may leave a file as long and as old as it was
            sys.dont_write_bytecode = True
            import pytest

            if unchanged:
                leave_kernels_as_they_were(*unchanged)
            plan = Plan(self.seconds, self.failed, killers)
            code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:nbmake", *tests], plugins=[plan]))
        finally:
            os._exit(code)


def in_a_kernel(text: str, mutant: Mutant) -> bool:
    """Whether a fault may change what is compiled: it stands in a kernel, or in no function of its own."""
    span = statement_at(text, mutant.start)
    if span is None:
        return True
    (one,) = ast.parse(textwrap.dedent(text[span[0] : span[1]])).body
    return not isinstance(one, ast.FunctionDef) or any("njit" in ast.unparse(part) for part in one.decorator_list)
