"""Whole processes, from the shell's point of view: start, imports, work, end."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time

from benchmarks.peers.laps import Answer
from benchmarks.peers.programs import PROGRAMS
from grindvision.errors import GrindvisionError

BYTES = 1 if sys.platform == "darwin" else 1024  # unit of ru_maxrss


def process(words: list[str], compiled: bool = True, **files: str) -> Answer:
    """Run a command; ``{python}``, ``{programs}``, ``{folder}`` and the names of files in its words are filled in."""
    with tempfile.TemporaryDirectory() as folder:
        command = [word.format(python=sys.executable, programs=PROGRAMS, folder=folder, **files) for word in words]
        environment = {**os.environ, **({} if compiled else {"NUMBA_CACHE_DIR": f"{folder}/nothing"})}
        begin = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        wall = time.perf_counter() - begin
    if done.returncode:
        raise GrindvisionError(f"{command[0]} failed: {done.stderr.strip()[-200:] or done.returncode}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"measured": {"wall_s": wall, "peak_mib": used.ru_maxrss * BYTES / 1024**2, "growth_mib": float("nan")}}
