"""What every report.json says besides its results: stage times, versions, parameters, inputs."""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from grindvision import __version__
from grindvision.files import sha256


class Stopwatch:
    """Seconds per named stage, and in all since it was made."""

    def __init__(self) -> None:
        self._begin = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block under ``name``."""
        begin = time.perf_counter()
        yield
        self._stages[name] = time.perf_counter() - begin

    def seconds(self) -> dict[str, float]:
        """Seconds of each stage so far and ``total``."""
        total = time.perf_counter() - self._begin
        return {name: round(value, 6) for name, value in {**self._stages, "total": total}.items()}


def run_facts(
    options: argparse.Namespace, inputs: Sequence[str | Path], libraries: Sequence[str], stopwatch: Stopwatch
) -> dict[str, Any]:
    """Keys ``timings_s``, ``versions``, ``parameters`` (the command's options) and ``inputs`` (name, sha256)."""
    versions = {"grindvision": __version__, "python": platform.python_version()}
    return {
        "timings_s": stopwatch.seconds(),
        "versions": versions | {name: version(name) for name in libraries},
        "parameters": {name: value for name, value in vars(options).items() if name != "command"},
        "inputs": [{"name": Path(path).name, "sha256": sha256(path)} for path in inputs],
    }
