"""One racer in a process of its own: takes jobs, a line of JSON each, and answers with time, memory and result.

Started by ``racing.Worker`` as ``python -m benchmarks.worker MODULE:FUNCTION``. The process imports the racer first, so
imports are not in the times; a job names input files and a file for the answer, and never the truth.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np


def memory_mib() -> tuple[float, float]:
    """Memory of this process now and at its highest, MiB."""
    try:
        with open("/proc/self/status") as file:
            fields = dict(line.split(":", 1) for line in file)
        now, peak = (int(fields[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))
        return now, peak
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)
        return peak, peak


def run(function: Callable[..., dict[str, Any]], job: dict[str, Any], imported_mib: float) -> dict[str, Any]:
    """Do one job and measure it; a racer that is a program of its own brings its own ``measured``."""
    begin, begin_cpu = time.perf_counter(), time.process_time()
    try:
        answer = function(**job["inputs"], **job["settings"])
    except Exception as error:
        answer = {"error": f"{type(error).__name__}: {error}"}
    wall, cpu, peak = time.perf_counter() - begin, time.process_time() - begin_cpu, memory_mib()[1]
    measured = {"wall_s": wall, "cpu_s": cpu, "peak_mib": peak, "growth_mib": peak - imported_mib}
    measured |= answer.pop("measured", {})
    arrays = {name: value for name, value in answer.items() if isinstance(value, np.ndarray)}
    np.savez(job["answer"], allow_pickle=False, **arrays)
    return measured | {"error": answer.get("error", ""), "laps_s": answer.get("laps_s", {})}


def main() -> None:
    """Serve jobs until the input ends; what libraries print goes to standard error."""
    replies = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    module, name = sys.argv[1].split(":")
    function = getattr(import_module(module), name)
    imported_mib, _ = memory_mib()
    for line in sys.stdin:
        print(json.dumps(run(function, json.loads(line), imported_mib)), file=replies, flush=True)


if __name__ == "__main__":
    main()
