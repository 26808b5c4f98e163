"""``grindvision study``: a study of the book with any number of cases, on this machine or on a Dask cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from grindvision.cli.parameters import check_count, whole
from grindvision.cli.streams import say

STUDIES = {
    "compound": "robot cells that find one path from four orientations (chapter 08)",
    "path": "pairs of scans under conditions that fill their ranges evenly (chapter 09)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Describe the command's arguments."""
    parser.add_argument("study", choices=STUDIES, help="; ".join(f"{name}: {text}" for name, text in STUDIES.items()))
    parser.add_argument("-o", "--output", required=True, metavar="CSV", help="rows stream here; run again to resume")
    parser.add_argument("--cases", type=whole, default=128, help="how many; for path a power of two (default 128)")
    parser.add_argument("--seed", type=whole, default=1, help="of the study (default 1)")
    parser.add_argument("--jobs", type=whole, default=-1, help="processes on this machine (default: all cores)")
    parser.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="run on this Dask cluster instead")


def run(options: argparse.Namespace) -> int:
    """Run the study and say what came out."""
    check_count("--cases", options.cases, 1, 10_000_000)
    check_count("--seed", options.seed, 0, 10**18)
    if options.jobs != -1:
        check_count("--jobs", options.jobs, 1, 10_000)

    import pandas as pd

    from grindvision_book.studies.running import run_study

    if options.study == "compound":
        from grindvision_book.chapter_08.compound import compound_case

        measure: Callable[..., dict[str, Any]] = compound_case
        cases = pd.DataFrame({"stream": range(options.cases)})
    else:
        from grindvision_book.chapter_09.limits import RANGES, path_case
        from grindvision_book.studies.designs import space_filling

        measure = path_case
        cases = space_filling(RANGES, options.cases, options.seed)
    rows = run_study(measure, cases, options.seed, options.output, options.scheduler, options.jobs)
    failed = int((rows["error"] != "").sum())
    say(f"{len(rows)} cases in {options.output}, {failed} of them refused (column error)", options.output)
    return 0
