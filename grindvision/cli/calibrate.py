"""``grindvision calibrate``: sphere measurements and a nominal arm in, the calibrated arm and scanner out."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.calibrate_results import OUTDATED, RobotSource, results_of, write_results
from grindvision.cli.parameters import check_count, number, whole
from grindvision.cli.report import Run, add_output_arguments
from grindvision.errors import GrindvisionError, GrindvisionWarning, InputError

if TYPE_CHECKING:
    from grindvision.arm import MdhArm
    from grindvision.calibration import Calibration, Measurements
    from grindvision.calibration import Options as CalibrateOptions

EPILOG = """\
MEASUREMENTS.csv, one row per point measured at one pose of the arm, below a line of names; commas, semicolons, tabs or
blanks part the columns, further columns are ignored:
  q1_rad .. qN_rad          joint angles; q1_deg .. for degrees
  bx_mm, by_mm, bz_mm       the point in the tracker's frame; bx_m .. for metres
  sx_mm, sy_mm, sz_mm       the same point in the scanner's frame. Leave all three out when the tracker's reflector sits
                            on the tool (a tracked arm without scanner): then the reflector's place is found instead
  pose, sphere              optional labels: rows of one pose, or of one sphere, are held out together; rows in the
                            order of measuring, so that drifts and jumps can be seen
  brx_rad, bry_rad, brz_rad or bqw, bqx, bqy, bqz
                            the tool's orientation in the tracker's frame too (rotation vector or quaternion), where the
                            tracker measures whole poses
  reflector                 optional: names of several reflectors on the tool; their places are found
  socket [, bar_mm]         instead of bx ..: the ball lies in a fixed socket at an unknown place, named here (with
                            bar_mm: at the end of a ball bar of that length from it). With sx .. it is a sphere at rest
                            that the scanner sees from many poses: the arm without any tracker, its scale the scanner's
  to_socket, distance_mm    optional: the known distance from this row's socket to another
  plane                     instead of bx ..: the tip touches a fixed plane, named here
  q3_mm                     a prismatic joint (column type of the robot table) counts in mm, or in m as q3_m
  split                     optional, train or test; without it and without --train the rows are cross-validated
ROBOT.csv: joint,alpha_rad,a_mm,d_mm,theta_rad,beta_rad, one row per joint up to the scanner's (modified DH, Craig:
  Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d)); alpha_deg or a_m are converted by their names; joint and beta may be
  left out. From a standard (distal) DH table: move alpha and a one row down, with 0 in the first row.
  Further columns: type (revolute or prismatic; a track is a prismatic first row), lower_rad, upper_rad, speed_rad_s.
ROBOT.urdf: the first N joints of the chain, N as in MEASUREMENTS.csv; where it branches, up to --tip-link. Masses of
  its links say how the joints may sag; without them, links of the same weight a length and a load at the end do.

results in DIR:
  robot.csv        the corrected modified DH table, with the limits and speeds that the given one has
  hand_eye.json    T_joint_scanner and T_tracker_base, 4x4, mm (T_a_b @ p_b = p_a); the base is the URDF's --base-link
  robot_dh.csv     the same arm as a standard (distal) DH table, where one exists
  zero_offsets.csv what to add to each joint's zero, in degrees, for controllers that take nothing else (ABB, KUKA,
                   FANUC), from a fit of its own with only these free; calibration.conf: of a UR, the deltas
  robot.urdf       the given URDF with corrected joint origins (only with --robot ROBOT.urdf)
  beyond_geometry.json  gear waves (one and two a turn, or of any number found in the data), sag or couplings, where
                   held-out poses say that they help, with their own table
  report.png       did it work? errors of unseen points, residuals, where it holds, what can be known
  report.json      errors, rank, singular values, standard deviations (null: cannot be known), warnings; written last;
                   predicted_mm: error over the joints' range or --box (foreseen_mm is its old name, for one version)

exit code: 0 done, 2 the input cannot be used (one line says why), 1 anything else

examples:
  grindvision calibrate measurements.csv --robot robot.csv -o cell
  grindvision calibrate tracked.csv --robot ur5.urdf -o arm --train 300
  grindvision calibrate spheres.csv --robot robot.csv -o cell --free hand-eye
  grindvision calibrate tracked.csv --robot robot.csv -o arm --box 300 -200 0 700 200 300 --suggest 12
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
        help="names of columns that the file calls otherwise; + and - add columns, as in bx_mm=x_nominal+x_error,"
        " q3_deg=J3-J2",
    )
    data.add_argument(
        "--train",
        type=whole,
        metavar="N",
        help="fit N rows drawn at random and test on the others (default: as column split says, else all rows)",
    )
    data.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of that draw (default: 0)")
    what = parser.add_argument_group("what to estimate")
    data.add_argument("--base-link", metavar="LINK", help="link of a URDF where the chain begins (default: its root)")
    data.add_argument("--tip-link", metavar="LINK", help="link of a URDF where the chain ends (default: its only end)")
    what.add_argument("--base-fixed", action="store_true", help="the tracker measures exactly in the arm's base frame")
    what.add_argument(
        "--free",
        nargs="+",
        metavar="NAME",
        help="entries of the robot table to estimate, as d3_mm or theta4_rad, the number is the row; hand-eye: none of"
        " them, only where scanner and tracker stand; offsets: every theta_rad (and d_mm of a prismatic joint)"
        " (default: all, beta where axes are parallel; how far they may move follows from the data)",
    )
    what.add_argument("--fix", nargs="+", metavar="NAME", help="entries to hold, of those that are free by default")
    what.add_argument(
        "--beyond-geometry",
        choices=("auto", "off"),
        default="auto",
        help="auto: look for gear waves, sag and couplings, and write those that lower the error of held-out poses to"
        " beyond_geometry.json (default: auto)",
    )
    what.add_argument(
        "--gear-ratios", nargs="+", type=number, metavar="RATIO", help="turns of each motor a turn of its joint"
    )
    what.add_argument(
        "--down",
        nargs=3,
        type=number,
        default=[0.0, 0.0, -1.0],
        metavar=("X", "Y", "Z"),
        help="direction of gravity in the arm's base frame (default: 0 0 -1, an arm that stands upright)",
    )
    where = parser.add_argument_group("where it holds")
    where.add_argument(
        "--box",
        nargs=6,
        type=number,
        metavar=("X1", "Y1", "Z1", "X2", "Y2", "Z2"),
        help="two corners of the work, mm, base frame: the error is predicted there instead of over all joint angles",
    )
    where.add_argument(
        "--suggest", type=whole, metavar="N", help="write suggested_poses.csv: N joint angles that would help most"
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
    columns = columns_of(options.columns or [])

    from dataclasses import replace

    import numpy as np

    import grindvision.calibration as calibration
    from grindvision.cli.pictures import drawing

    draw = drawing("calibrate_picture")
    settings = _settings(options)
    with Run(options, ("measurements",), ("numpy", "scipy", "matplotlib"), 7, OUTDATED) as work:
        with work.stage("read"):
            measurements, arm, source = _read(options, columns)
            settings = replace(settings, free=_free_entries(options, arm), load=source.load(settings.down))
            if settings.base_fixed:
                measurements = source.in_table_base(measurements)
            if options.train is not None:
                if not measurements.train.all():
                    raise InputError(f"--train {options.train}, but the file's column split says it too; use one")
                measurements = measurements.drawn(options.train, np.random.default_rng(options.seed))
        with work.stage("calibrate"):
            result = _calibrated(measurements, arm, settings, options.measurements, columns)
        with work.stage("held_out"):
            result, unseen = calibration.evaluate(result, settings)
            if options.train is not None:
                drawn = f"{len(unseen.rows)} test rows, the others than {int(measurements.train.sum())} drawn to train"
                unseen = replace(unseen, how=f"{drawn}, seed {options.seed}")
        with work.stage("trust"):
            box = None if options.box is None else np.reshape(options.box, (2, 3))
            predicted = calibration.predict_errors(result, np.random.default_rng(options.seed), box)
            suggestion = None
            if options.suggest is not None:
                rng = np.random.default_rng(options.seed)
                suggestion = calibration.suggest_poses(result, predicted, options.suggest, rng)
        told = [*result.warnings, *calibration.diagnose_trust(predicted, unseen.after.mean)]
        if not unseen.improved:
            told.append("calibration did not help: unseen points are no nearer than before; do not use the result")
        for sentence in told:
            warnings.warn(sentence, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            write_results(result, source, suggestion, work.place)
        with work.stage("picture"):
            draw(result, unseen, predicted, work.warnings, work.place / "report.png")
        values = _from_the_data(options, result, measurements)
        shown = [str(unseen)]
        if result.dropped:
            shown.append(f"rows left out: {result.errors_of_dropped()}")
        if unseen.beyond is not None and result.beyond is not None:
            shown.append(f"with {result.beyond.kind} (beyond_geometry.json): {unseen.beyond}")
        shown.append(str(predicted))
        if suggestion is not None:
            shown.append(f"{suggestion} (suggested_poses.csv)")
        work.report(str(result), results_of(result, unseen, predicted, suggestion), values, shown="\n".join(shown))
    return 0


def _settings(options: argparse.Namespace) -> CalibrateOptions:
    from grindvision.calibration import Options

    return Options(
        base_fixed=options.base_fixed,
        robust=not options.keep_all,
        variant=options.variant,
        beyond_geometry=options.beyond_geometry == "auto",
        gear_ratios=tuple(options.gear_ratios or ()),
        down=_unit_vector(options.down),
        seed=options.seed,
    )


def _from_the_data(options: argparse.Namespace, result: Calibration, measurements: Measurements) -> dict[str, Any]:
    values: dict[str, Any] = {
        "joints": result.arm.n,
        "measured point": _measured_point(measurements),
        "length_prior_mm": result.sigmas.length_mm,
        "angle_prior_rad": result.sigmas.angle_rad,
    }
    if options.free is None and options.fix is None:
        names, entries = result.unknowns.names, result.unknowns.in_table
        values["free"] = [name for name, entry in zip(names, entries, strict=True) if entry]
    return values


def _calibrated(
    measurements: Measurements, arm: MdhArm, settings: Any, path: str, columns: dict[str, str]
) -> Calibration:
    """Calibrate; where nothing fits, look among the columns that were not used for a track that the table leaves out.

    Raises:
        InputError: such a column. GrindvisionError: see ``calibration.calibrate``.
    """
    from grindvision.calibration import calibrate, track_left_out, unused_columns

    try:
        return calibrate(measurements, arm, settings)
    except GrindvisionError as error:
        track = track_left_out(measurements, arm, unused_columns(path, columns))
        if track:
            raise InputError(track) from error
        raise


def _measured_point(measurements: Measurements) -> str:
    if measurements.reflectors:
        return "several reflectors on the tool, found"
    return "reflector on the tool, found" if measurements.on_tool else "scanner on the last joint"


def _unit_vector(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    length = (x * x + y * y + z * z) ** 0.5
    if not 0 < length < float("inf"):
        raise InputError(f"--down is {x:g} {y:g} {z:g}; give a direction")
    return x / length, y / length, z / length


def _free_entries(options: argparse.Namespace, arm: MdhArm) -> tuple[str, ...] | None:
    """Names of the table's entries to estimate, None for the usual ones.

    Raises:
        InputError: a name that is no entry, or both --free and --fix.
    """
    from grindvision.calibration import entry_name, table_entries

    if options.free is not None and options.fix is not None:
        raise InputError("--free and --fix say the same twice; use one")
    if options.fix is not None:
        held = table_entries(arm, options.fix)
        return tuple(entry_name(entry) for entry in table_entries(arm) if entry not in held)
    if options.free is None:
        return None
    names: list[str] = []
    for word in options.free:
        if word == "offsets":
            names += [f"d{i + 1}_mm" if linear else f"theta{i + 1}_rad" for i, linear in enumerate(arm.prismatic)]
        elif word != "hand-eye":
            names.append(word)
    table_entries(arm, names)
    return tuple(names)


def columns_of(words: Sequence[str]) -> dict[str, str]:
    """Our names and the file's from words like ``q1_deg=joint_1``."""
    pairs = dict(word.partition("=")[::2] for word in words)
    odd = [word for word in words if "" in word.partition("=")]
    if odd:
        raise InputError(f"--columns {odd[0]!r}; write NAME=COLUMN, as in q1_deg=joint_1")
    return pairs


def _read(options: argparse.Namespace, columns: dict[str, str]) -> tuple[Measurements, MdhArm, RobotSource]:
    from grindvision.arm import read_arm
    from grindvision.calibration import read_measurements

    robot = options.robot
    if Path(robot).suffix.lower() in (".urdf", ".xml"):
        from grindvision.arm.urdf_chain import urdf_chain

        found = read_measurements(options.measurements, None, columns)
        chain = urdf_chain(robot, found.q_rad.shape[1], options.base_link, options.tip_link)
        prismatic_joints = [joint for joint, flag in enumerate(chain.arm.prismatic) if flag]
        if prismatic_joints:
            found = read_measurements(options.measurements, None, columns, prismatic_joints)
        return found, chain.arm, RobotSource(robot, chain)
    if options.base_link or options.tip_link:
        raise InputError("--base-link and --tip-link name links of a URDF file; a table has none")
    arm = read_arm(robot)
    prismatic_joints = [joint for joint, flag in enumerate(arm.prismatic) if flag]
    return read_measurements(options.measurements, arm.n, columns, prismatic_joints), arm, RobotSource(robot, None)
