"""``grindvision verify``: does an old calibration still hold? New shots judged by it, pass or fail against a limit."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.calibrate import columns_of
from grindvision.cli.parameters import number
from grindvision.cli.report import Run, add_output_arguments
from grindvision.errors import FileError, GrindvisionWarning, InputError

if TYPE_CHECKING:
    from grindvision.calibration import ScannerOnArm

EPILOG = """\
CELL is the folder that `grindvision calibrate -o CELL` wrote: robot.csv and hand_eye.json are read.
MEASUREMENTS.csv has the columns that `grindvision calibrate --help` names; a column split is not looked at.

Nothing is fitted, except with --tracker-moved: then the six numbers of the tracker's place, from the same shots.

exit code: 0 the limit holds, 3 it does not, 2 the input cannot be used, 1 anything else

example:
  grindvision verify cell monday.csv -o monday --limit-mm 0.3
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    data = parser.add_argument_group("cell, shots and limit")
    data.add_argument("cell", metavar="CELL", help="folder of an earlier calibration")
    data.add_argument("measurements", metavar="MEASUREMENTS.csv", help="new shots, see `grindvision calibrate --help`")
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

    import numpy as np

    from grindvision.calibration import error_statistics, read_measurements, residuals_of

    cell = read_cell(options.cell)
    slides = [joint for joint, flag in enumerate(cell.arm.prismatic) if flag]
    with Run(options, ("measurements",), ("numpy", "scipy"), 3) as work:
        with work.stage("read"):
            shots = read_measurements(options.measurements, cell.arm.n, columns, slides)
            if shots.fixtures or shots.reflectors:
                raise InputError("sockets, planes and several reflectors cannot be verified; give tracked points")
        with work.stage("judge"):
            if options.tracker_moved:
                cell = _with_tracker_placed(cell, shots)
            residuals = residuals_of(cell, shots)
            errors = error_statistics(residuals)
            lengths = np.linalg.norm(residuals, axis=1)
            p95 = float(np.quantile(lengths, 0.95, method="higher"))
            passed = p95 <= options.limit_mm
            bias = residuals.mean(axis=0)
            shared = float(np.linalg.norm(bias))
            if shared > 0.7 * errors.mean and len(shots) >= 4 and not options.tracker_moved:
                told = ", ".join(f"{value:.2f}" for value in bias)
                warnings.warn(
                    f"the shots are all off the same way, by ({told}) mm in the tracker's frame: the tracker or the"
                    " base may have moved; try --tracker-moved",
                    GrindvisionWarning,
                    stacklevel=1,
                )
        worst = int(np.argmax(lengths))
        message = (
            f"{'pass' if passed else 'FAIL'}: 95 % of {len(shots)} shots are within {p95:.3f} mm, the limit is"
            f" {options.limit_mm:g} mm"
        )
        results: dict[str, Any] = {
            "passed": passed,
            "limit_mm": options.limit_mm,
            "p95_mm": p95,
            "errors_mm": {"test": {"after": vars(errors)}},
            "mean_residual_mm": bias,
            "worst": shots.label(worst),
        }
        work.report(message, results, {}, shown=f"{errors}; worst {shots.label(worst)}")
    return 0 if passed else 3


def read_cell(folder: str | Path) -> ScannerOnArm:
    """The cell that an earlier calibration wrote into a folder.

    Raises:
        FileError: robot.csv or hand_eye.json is missing or damaged. NotRigidError: a matrix is no rigid transform.
    """
    from grindvision.arm import read_arm
    from grindvision.calibration import ScannerOnArm
    from grindvision.files import read_json
    from grindvision.geometry import check_rigid

    folder = Path(folder)
    places = read_json(folder / "hand_eye.json")
    known = places if isinstance(places, dict) else {}
    missing = [name for name in ("T_joint_scanner", "T_tracker_base") if name not in known]
    if missing:
        raise FileError(f"{folder / 'hand_eye.json'}: {missing[0]} is missing; name a folder of `calibrate`")
    arm = read_arm(folder / "robot.csv")
    key = "T_tracker_table" if "T_tracker_table" in known else "T_tracker_base"
    return ScannerOnArm(arm, check_rigid(known["T_joint_scanner"], "T_joint_scanner"), check_rigid(known[key], key))


def _with_tracker_placed(cell: ScannerOnArm, shots: Any) -> ScannerOnArm:
    from dataclasses import replace

    from grindvision.geometry import fit_rigid

    found = fit_rigid(cell.points_base(shots.q_rad, shots.scanner_mm), shots.tracker_mm)
    return replace(cell, T_tracker_base=found.T_target_source)
