"""``grindvision calibrate``: sphere measurements and a nominal arm in, the calibrated arm and scanner out."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.parameters import check_count, whole
from grindvision.cli.report import Run, add_output_arguments
from grindvision.errors import GrindvisionWarning, InputError

if TYPE_CHECKING:
    from grindvision.arm import MdhArm
    from grindvision.calibration import Calibration, HeldOut, Measurements

EPILOG = """\
MEASUREMENTS.csv, one row per point measured at one pose of the arm, below a line of names; commas, semicolons, tabs or
blanks part the columns, further columns are ignored:
  q1_rad .. qN_rad          joint angles; q1_deg .. for degrees
  bx_mm, by_mm, bz_mm       the point in the tracker's frame; bx_m .. for metres
  sx_mm, sy_mm, sz_mm       the same point in the scanner's frame. Leave all three out when the tracker's reflector sits
                            on the tool (a tracked arm without scanner): then the reflector's place is found instead
  pose, sphere              optional labels: rows of one pose, or of one sphere, are held out together
  split                     optional, train or test; without it and without --train the rows are cross-validated
ROBOT.csv: joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad, one row per joint up to the scanner's (modified DH, Craig:
  Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d)); alpha_deg or a_m are converted by their names; joint and beta may be
  left out. From a standard (distal) DH table: move alpha and a one row down, with 0 in the first row.
ROBOT.urdf: the first N joints of the chain, N as in MEASUREMENTS.csv.

results in DIR:
  robot.csv        the corrected modified DH table
  hand_eye.json    T_joint_scanner and T_tracker_base, 4x4, mm (T_a_b @ p_b = p_a)
  report.png       did it work? errors of unseen points before and after, residuals, what can be known
  report.json      errors, rank, singular values, standard deviations (null: cannot be known), warnings; written last

exit code: 0 done, 2 the input cannot be used (one line says why), 1 anything else

examples:
  grindvision calibrate measurements.csv --robot robot.csv -o cell
  grindvision calibrate tracked.csv --robot ur5.urdf -o arm --train 300
  grindvision calibrate log.csv --robot ur5.csv -o arm --columns q1_deg=joint_1 q2_deg=joint_2 bx_mm=x+dx ...
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    data = parser.add_argument_group("measurements and arm")
    data.add_argument("measurements", metavar="MEASUREMENTS.csv", help="joint angles and measured points, see below")
    data.add_argument("--robot", metavar="ROBOT.csv|ROBOT.urdf", help="needed: the arm as its maker describes it")
    data.add_argument(
        "--columns",
        nargs="+",
        metavar="NAME=COLUMN",
        help="names of columns that the file calls otherwise; + adds columns, as in bx_mm=x_nominal+x_error",
    )
    data.add_argument(
        "--train",
        type=whole,
        metavar="N",
        help="fit N rows drawn at random and test on the others (default: as column split says, else all rows)",
    )
    data.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of that draw (default: 0)")
    what = parser.add_argument_group("what to estimate")
    what.add_argument("--base-fixed", action="store_true", help="the tracker measures exactly in the arm's base frame")
    what.add_argument(
        "--free",
        nargs="+",
        metavar="NAME",
        help="entries of the robot table to estimate, as d3_mm or theta4_rad; the number is the row (default: all of"
        " them, beta where axes are parallel; how far they may move follows from the data)",
    )
    what.add_argument("--keep-all", action="store_true", help="use every row, also those that contradict the others")
    what.add_argument(
        "--variant",
        choices=("ours", "paper"),
        default="ours",
        help="paper: one linear step, equal weights, no priors (default: ours)",
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    check_count("--seed", options.seed, 0, 10**18)
    if options.robot is None:
        raise InputError("--robot is missing: give the arm as a modified DH table (CSV) or as URDF")
    columns = _renamed(options.columns or [])

    from dataclasses import replace

    import numpy as np

    import grindvision.calibration as calibration
    from grindvision.arm import write_arm
    from grindvision.cli.pictures import drawing
    from grindvision.files import write_json

    draw = drawing("calibrate_picture")
    settings = calibration.Options(
        base_fixed=options.base_fixed,
        free=None if options.free is None else tuple(options.free),
        robust=not options.keep_all,
        variant=options.variant,
    )
    with Run(options, ("measurements",), ("numpy", "scipy", "matplotlib"), 6) as work:
        with work.stage("read"):
            measurements, arm = _read(options.measurements, options.robot, columns)
            if options.train is not None:
                if not measurements.train.all():
                    raise InputError(f"--train {options.train}, but the file's column split says it too; use one")
                measurements = measurements.drawn(options.train, np.random.default_rng(options.seed))
        with work.stage("calibrate"):
            result = calibration.calibrate(measurements, arm, settings)
        with work.stage("held_out"):
            if measurements.train.all():
                unseen = calibration.cross_validated(result, settings)
            else:
                unseen = calibration.on_test_rows(result)
            if options.train is not None:
                drawn = f"{len(unseen.rows)} test rows, the others than {int(measurements.train.sum())} drawn to train"
                unseen = replace(unseen, how=f"{drawn}, seed {options.seed}")
        told = [*result.warnings]
        if unseen.after.mean >= unseen.before.mean:
            told.append("calibration did not help: unseen points are no nearer than before; do not use the result")
        for sentence in told:
            warnings.warn(sentence, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            write_arm(result.arm, work.place / "robot.csv")
            hand_eye = {"T_joint_scanner": result.cell.T_joint_scanner, "T_tracker_base": result.cell.T_tracker_base}
            write_json(work.place / "hand_eye.json", hand_eye)
        with work.stage("picture"):
            draw(result, unseen, work.warnings, work.place / "report.png")
        point = "reflector on the tool, found" if measurements.on_tool else "scanner on the last joint"
        values: dict[str, Any] = {
            "joints": arm.n,
            "measured point": point,
            "length_prior_mm": result.spreads.length_mm,
            "angle_prior_rad": result.spreads.angle_rad,
        }
        if options.free is None:
            names, entries = result.unknowns.names, result.unknowns.in_table
            values["free"] = [name for name, entry in zip(names, entries, strict=True) if entry]
        work.report(str(result), _results(result, unseen), values, shown=str(unseen))
    return 0


def _renamed(words: Sequence[str]) -> dict[str, str]:
    """Our names and the file's from words like ``q1_deg=joint_1``."""
    pairs = dict(word.partition("=")[::2] for word in words)
    odd = [word for word in words if "" in word.partition("=")]
    if odd:
        raise InputError(f"--columns {odd[0]!r}; write NAME=COLUMN, as in q1_deg=joint_1")
    return pairs


def _read(measurements: str, robot: str, columns: dict[str, str]) -> tuple[Measurements, MdhArm]:
    from grindvision.arm import read_arm
    from grindvision.calibration import read_measurements

    if Path(robot).suffix.lower() in (".urdf", ".xml"):
        from grindvision.arm.urdf import urdf_arm

        found = read_measurements(measurements, None, columns)
        return found, urdf_arm(robot, found.q_rad.shape[1])
    arm = read_arm(robot)
    return read_measurements(measurements, arm.n, columns), arm


def _results(result: Calibration, unseen: HeldOut) -> dict[str, Any]:
    from dataclasses import asdict

    knowledge, names = result.identifiability, result.unknowns.names
    errors = {
        "train": {"before": result.errors(train=True, before=True), "after": result.errors(train=True)},
        "test": {"before": unseen.before, "after": unseen.after},
    }
    return {
        "rank": knowledge.rank,
        "unknowns": len(names),
        "singular_values": knowledge.singular_values,
        "errors_mm": {part: {when: asdict(value) for when, value in both.items()} for part, both in errors.items()},
        "held_out": unseen.how,
        "changes": dict(zip(names, result.values, strict=True)),
        "standard_deviations": dict(zip(names, result.std, strict=True)),
        "only_together": list(knowledge.sentences),
        "observability": knowledge.observability,
        "noise": asdict(result.spreads),
        "dropped": [result.measurements.label(row) for row in result.dropped],
        "iterations": result.iterations,
        "converged": result.converged,
    }
