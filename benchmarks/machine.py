"""What the races ran on: processor, memory, versions; and how fast memory is, measured."""

from __future__ import annotations

import os
import platform
import subprocess
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from grindvision_book.machinery.places import ROOT

LIBRARIES = ("grindvision", "numpy", "scipy", "numba", "open3d-cpu", "open3d", "small-gicp", "kiss-matcher")
PROGRAMS = {"PCL": ("pkg-config", "--modversion", "pcl_common"), "g++": ("g++", "-dumpfullversion")}


def facts(seed: int) -> dict[str, str]:
    """Machine, versions, commit and seed, in words."""
    found = {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 1024**3:.0f} GiB",
        "system": f"{platform.system()} {platform.machine()}",
        "Python": platform.python_version(),
    }
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    for name, command in PROGRAMS.items():
        if answer := _said(*command):
            found[name] = answer
    found["commit"] = _said("git", "describe", "--always", "--dirty") or "unknown"
    return {**found, "load at the start": f"{os.getloadavg()[0]:.1f}", "seed": str(seed)}


def copied_mib_per_s(mib: int = 256, rounds: int = 5) -> float:
    """Memory bandwidth of one thread: bytes read and written by the fastest of some large copies."""
    source, target = np.ones(mib * 2**17), np.zeros(mib * 2**17)
    return 2 * mib / min(_seconds(np.copyto, target, source) for _ in range(rounds))


def visit_s(rows: int, visits: int = 2_000_000, rounds: int = 5) -> float:
    """Seconds to fetch one point (24 bytes) from a random row of a table of so many ``rows``, one thread."""
    table, at = np.ones((rows, 3)), np.random.default_rng(0).integers(rows, size=visits)
    return min(_seconds(np.take, table, at, 0) for _ in range(rounds)) / visits


def sums_per_s(size: int = 1500, rounds: int = 5) -> float:
    """Multiply-adds of float32 a second in the fastest of some products of large matrices, as many threads as BLAS."""
    matrix = np.ones((size, size), dtype=np.float32)
    return size**3 / min(_seconds(np.dot, matrix, matrix) for _ in range(rounds))


def _seconds(function: Callable[..., object], *what: object) -> float:
    begin = time.perf_counter()
    function(*what)
    return time.perf_counter() - begin


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def _said(*command: str) -> str:
    try:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=20).stdout.strip()
    except OSError:
        return ""
