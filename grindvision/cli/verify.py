"""``grindvision verify``: does an old calibration still hold? New shots judged by it, pass or fail against a limit."""

from __future__ import annotations

import argparse
import warnings
from typing import Any

from grindvision.cli.calibrate import columns_of
from grindvision.cli.parameters import number
from grindvision.cli.report import Run, add_output_arguments
from grindvision.errors import GrindvisionWarning, InputError

EPILOG = """\
CELL is the folder that `grindvision calibrate -o CELL` wrote: robot.csv and hand_eye.json are read.
MEASUREMENTS.csv has the columns that `grindvision calibrate --help` names; a column split is not looked at.

Nothing is fitted, except with --tracker-moved: then the six numbers of the tracker's place, from the same shots.

results in DIR:
  report.json      the errors of the shots, whether the limit holds, warnings, timings, versions; written last

exit code: 0 the limit holds, 3 it does not, 2 the input cannot be used, 1 anything else

example:
  grindvision verify cell monday.csv -o monday --limit-mm 0.3
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    data = parser.add_argument_group("cell, shots and limit")
    data.add_argument("cell", metavar="CELL", help="folder of an earlier calibration")
    data.add_argument("measurements", metavar="MEASUREMENTS.csv", help="new measurements (shots), one a row, see below")
    data.add_argument("--limit-mm", type=number, metavar="MM", help="needed: what 95 %% of the shots must stay below")
    data.add_argument("--columns", nargs="+", metavar="NAME=COLUMN", help="as in `grindvision calibrate`")
    data.add_argument(
        "--tracker-moved", action="store_true", help="the tracker stands elsewhere than before: find its place first"
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    if options.limit_mm is None or not 0 < options.limit_mm < float("inf"):
        raise InputError("--limit-mm is missing or not above 0: say what the shots must stay below, as in 0.3")
    columns = columns_of(options.columns or [])

    from grindvision.calibration.holding import VerifyOptions, read_cell, verify
    from grindvision.calibration.measurement_files import read_measurements

    cell = read_cell(options.cell)
    prismatic_joints = [joint for joint, flag in enumerate(cell.arm.prismatic) if flag]
    with Run(options, ("measurements",), ("numpy", "scipy"), 3) as work:
        with work.stage("read"):
            shots = read_measurements(options.measurements, cell.arm.n, columns, prismatic_joints)
        with work.stage("judge"):
            found = verify(cell, shots, VerifyOptions(options.limit_mm, options.tracker_moved))
            if found.warning is not None:
                warnings.warn(found.warning, GrindvisionWarning, stacklevel=1)
        results: dict[str, Any] = {
            "passed": found.passed,
            "limit_mm": found.limit_mm,
            "p95_mm": found.p95_mm,
            "errors_mm": {"test": {"after": vars(found.errors)}},
            "mean_residual_mm": found.mean_residual_mm,
            "worst": found.worst,
        }
        work.report(str(found), results, {}, shown=f"{found.errors}; worst {found.worst}")
    return 0 if found.passed else 3
