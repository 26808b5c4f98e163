"""``grindvision calibrate-field``: scans of a flat plate in, the scanner's own depth error out."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import asdict

from grindvision.cli.parameters import check_count, number, whole
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.scans import CLOUD_FORMATS, add_unit_argument, read_scans
from grindvision.errors import GrindvisionWarning, InputError
from grindvision.words import counted

EPILOG = """\
Scan one flat plate that fills the view; move it (or the scanner) along its normal by known steps, scan again. The steps
should be half as long as the waves of the depth error or shorter, and reach over the depths of later work. All clouds
in the scanner's frame: origin in the scanner, z forward.

results in DIR:
  field.npz        the depth error over the volume, for --field-correction of detect and groove
  report.png       did it work? the depth error at the nearest and the farthest plate, plates that took no part
  report.json      held-out error; predicted_mm: depth error that a corrected point keeps over the volume, between the
                   plates too; how large a tilt, a wrong step or a wrong distance these scans could hide
                   (could_not_be_seen); volume, timings, versions, parameters; written last

exit code: 0 done, 2 the input cannot be used (one line says why), 1 anything else

examples:
  grindvision calibrate-field p0.ply p1.ply p2.ply p3.ply --steps-mm 0 15 30 45 -o camera --distance-mm 420.3
  grindvision groove weld.ply -o weld --field-correction camera/field.npz
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    scans = parser.add_argument_group("scans of the plate")
    scans.add_argument("plates", nargs="+", metavar="PLATE", help=f"scans of the flat plate ({CLOUD_FORMATS})")
    scans.add_argument(
        "--steps-mm",
        type=number,
        nargs="+",
        metavar="MM",
        help="needed: how much farther than the first each plate stands along its normal, 0 for the first",
    )
    scans.add_argument(
        "--distance-mm",
        type=number,
        metavar="MM",
        help="from the scanner's origin to the first plate along its normal (default: not known; then one offset of all"
        " depths stays, for the hand-eye calibration to take up)",
    )
    scans.add_argument(
        "--seed",
        type=whole,
        default=0,
        metavar="N",
        help="seed of the draws from which the error over the volume is predicted (default: 0)",
    )
    add_unit_argument(scans)
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    check_count("--seed", options.seed, 0, 10**18)
    if options.steps_mm is None:
        raise InputError(
            "--steps-mm is missing: say how much farther than the first each plate stands, 0 for the first"
        )

    import numpy as np

    from grindvision.cli.pictures import drawing
    from grindvision.clouds import finite_points
    from grindvision.vision.depth_calibration.field_correction import (
        CalibrateFieldOptions,
        calibrate_field,
        held_out_rms_mm,
        write_field,
    )
    from grindvision.vision.depth_calibration.field_errors import predict_field_errors
    from grindvision.vision.depth_calibration.plate_checks import diagnose_plates

    draw = drawing("calibrate_field_picture")
    with Run(options, ("plates",), ("numpy", "scipy", "numba", "matplotlib"), 5) as work:
        with work.stage("read"):
            clouds = read_scans(options.plates, options.unit)
            plates = [finite_points(cloud, path) for cloud, path in zip(clouds, options.plates, strict=True)]
        with work.stage("calibrate"):
            field = calibrate_field(plates, options.steps_mm, CalibrateFieldOptions(options.distance_mm))
            diagnosis = diagnose_plates(plates, options.steps_mm, options.distance_mm)
        for text in diagnosis.warnings:
            warnings.warn(text, GrindvisionWarning, stacklevel=1)
        unseen = predicted = None
        if len(plates) > 2:
            with work.stage("held_out"):
                unseen = held_out_rms_mm(plates, options.steps_mm)
            with work.stage("predicted"):
                predicted = predict_field_errors(plates, options.steps_mm, np.random.default_rng(options.seed))
            if unseen[1] >= unseen[0]:
                text = "plates that took no part are no flatter with the correction than without; do not use it"
                warnings.warn(text, GrindvisionWarning, stacklevel=1)
        else:
            text = f"{counted(len(plates), 'plate')}: nothing is left to test the correction on; scan at least three"
            warnings.warn(text, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            write_field(field, work.place / "field.npz")
        with work.stage("picture"):
            draw(field, unseen, predicted, work.warnings, work.place / "report.png")
        results = {
            "rms_mm": float(np.sqrt(np.mean(field.error_grid_mm**2))),
            "held_out_rms_mm": None if unseen is None else {"before": unseen[0], "after": unseen[1]},
            "predicted_mm": None if predicted is None else predicted.as_numbers(),
            "slopes": {"low": field.low[:2], "high": field.high[:2]},
            "distance_mm": {"low": field.low[2], "high": field.high[2]},
            "plate_normal": field.normal,
            "could_not_be_seen": asdict(diagnosis.unseen),
        }
        stays = str(diagnosis.unseen) if predicted is None else f"{predicted}\n{diagnosis.unseen}"
        if options.distance_mm is None:
            stays += "\none offset of all depths stays, as --distance-mm was not given"
        work.report(str(field), results, {"nodes": field.error_grid_mm.shape}, shown=stays)
    return 0
