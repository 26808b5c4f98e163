"""CloudCompare's cloud-to-cloud distance from its command line."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.peers.laps import Answer
from benchmarks.peers.programs import run_cloudcompare
from benchmarks.peers.recipe import THRESHOLD_MM


def difference(sample: str, test: str) -> Answer:
    """Points farther than 0.5 mm from their nearest neighbour; the times are those of CloudCompare's own log."""
    with tempfile.TemporaryDirectory() as folder:
        result, other = Path(folder) / "distances.bin", Path(folder) / "sample.bin"
        export = ("-C_EXPORT_FMT", "ASC", "-PREC", "4")
        save = ("-SAVE_CLOUDS", "FILE", f"{result} {other}")
        log = run_cloudcompare(*export, "-O", test, "-O", sample, "-C2C_DIST", *save)
        distances = np.loadtxt(result, usecols=3)
    seconds = sum(float(number) for number in re.findall(r"istances\] Time: ([\d.]+) s", log))
    unknown = dict.fromkeys(("cpu_s", "peak_mib", "growth_mib"), np.nan)
    return {
        "changed": distances > THRESHOLD_MM,
        "measured": {"wall_s": seconds, **unknown},
        "laps_s": {"difference": seconds},
    }
