"""``grindvision study``: a study of the book with any number of cases, on this machine or on a Dask cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

STUDIES = {
    "compound": "robot cells that find one path from four orientations (chapter 08)",
    "path": "pairs of scans under conditions that fill their ranges evenly (chapter 09)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("study", choices=STUDIES, help="; ".join(f"{name}: {text}" for name, text in STUDIES.items()))
    parser.add_argument("-o", "--output", required=True, metavar="CSV", help="rows stream here; run again to resume")
    parser.add_argument("--cases", type=int, default=128, help="how many; for path a power of two (default 128)")
    parser.add_argument("--seed", type=int, default=1, help="of the study (default 1)")
    parser.add_argument("--jobs", type=int, default=-1, help="processes on this machine (default: all cores)")
    parser.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="run on this Dask cluster instead")


def run(options: argparse.Namespace) -> int:
    """Run the study and say what came out."""
    import pandas as pd

    from grindvision.errors import InputError
    from grindvision_book.study import run_study

    if options.cases < 1 or options.seed < 0 or options.jobs == 0:
        raise InputError(
            f"cases {options.cases}, seed {options.seed}, jobs {options.jobs}: give at least 1, 0, 1 (or -1)"
        )
    if options.study == "compound":
        from grindvision_book.compound import compound_case

        measure: Callable[..., dict[str, Any]] = compound_case
        cases = pd.DataFrame({"stream": range(options.cases)})
    else:
        from grindvision_book.designs import space_filling
        from grindvision_book.limits import RANGES, path_case

        measure = path_case
        cases = space_filling(RANGES, options.cases, options.seed)
    rows = run_study(measure, cases, options.seed, options.output, options.scheduler, options.jobs)
    failed = int((rows["error"] != "").sum())
    print(f"{len(rows)} cases in {options.output}, {failed} of them refused (column error)")
    return 0
