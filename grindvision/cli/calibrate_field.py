"""``grindvision calibrate-field``: scans of a flat plate in, the scanner's own depth error out."""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from grindvision.cli.parameters import number
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.scans import CLOUD_FORMATS, add_unit_argument, read_scans
from grindvision.errors import GrindvisionWarning, InputError

if TYPE_CHECKING:
    from grindvision.vision.depth_calibration.field_correction import FieldCorrection

EPILOG = """\
Scan one flat plate that fills the view; move it (or the scanner) along its normal by known steps, scan again. The steps
should be half as long as the waves of the depth error or shorter, and reach over the depths of later work. All clouds
in the scanner's frame: origin in the scanner, z forward.

results in DIR:
  field.npz        the depth error over the volume, for --field-correction of detect and groove
  report.png       did it work? the depth error at the nearest and the farthest plate, plates that took no part
  report.json      held-out error, volume, timings, versions, parameters; written last

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
    add_unit_argument(scans)
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    if options.steps_mm is None:
        raise InputError(
            "--steps-mm is missing: say how much farther than the first each plate stands, 0 for the first"
        )

    import numpy as np

    from grindvision.clouds import finite_points
    from grindvision.vision.depth_calibration.field_correction import calibrate_field, held_out_rms_mm, write_field

    with Run(options, ("plates",), ("numpy", "scipy", "numba", "matplotlib"), 5) as work:
        with work.stage("read"):
            clouds = read_scans(options.plates, options.unit)
            plates = [finite_points(cloud, path) for cloud, path in zip(clouds, options.plates, strict=True)]
        with work.stage("calibrate"):
            field = calibrate_field(plates, options.steps_mm, options.distance_mm)
        unseen = None
        if len(plates) > 2:
            with work.stage("held_out"):
                unseen = held_out_rms_mm(plates, options.steps_mm)
            if unseen[1] >= unseen[0]:
                text = "plates that took no part are no flatter with the correction than without; do not use it"
                warnings.warn(text, GrindvisionWarning, stacklevel=1)
        else:
            text = f"{len(plates)} plate(s): nothing is left to test the correction on; scan at least three"
            warnings.warn(text, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            write_field(field, work.place / "field.npz")
        with work.stage("picture"):
            _draw(field, unseen, work.warnings, work.place / "report.png")
        results = {
            "rms_mm": float(np.sqrt(np.mean(field.error_grid_mm**2))),
            "held_out_rms_mm": None if unseen is None else {"before": unseen[0], "after": unseen[1]},
            "slopes": {"low": field.low[:2], "high": field.high[:2]},
            "distance_mm": {"low": field.low[2], "high": field.high[2]},
            "plate_normal": field.normal,
        }
        stays = (
            "" if options.distance_mm is not None else "one offset of all depths stays, as --distance-mm was not given"
        )
        work.report(str(field), results, {"nodes": field.error_grid_mm.shape}, shown=stays)
    return 0


def _draw(field: FieldCorrection, unseen: tuple[float, float] | None, told: Sequence[str], path: Path) -> None:
    """Draw report.png: the verdict, and the depth error at the nearest and at the farthest plate."""
    import numpy as np
    from matplotlib.figure import Figure

    from grindvision.cli.verdict import draw_verdict
    from grindvision.files import write_whole

    figure = Figure(figsize=(11, 5), layout="constrained")
    panels = figure.subplots(1, 2)
    most = np.abs(field.error_grid_mm).max()
    for panel, layer, distance in zip(panels, (0, -1), field.low[2:].tolist() + field.high[2:].tolist(), strict=True):
        (left, bottom), (right, top) = field.low[:2] * distance, field.high[:2] * distance
        image = panel.imshow(
            field.error_grid_mm[:, :, layer].T,
            extent=(left, right, bottom, top),
            origin="lower",
            cmap="RdBu_r",
            vmin=-most,
            vmax=most,
        )
        panel.set(title=f"{distance:.0f} mm away", xlabel="x, mm, scanner frame", ylabel="y, mm")
    figure.colorbar(image, ax=panels, label="depth error that is taken off, mm", shrink=0.8)
    verdict, facts = "Calibrated, but not tested", "Scan at least three plates to test it."
    if unseen is not None:
        verdict = f"Calibrated: a plate that took no part is off flat by {unseen[1]:.2f} mm rms"
        facts = f"Before: {unseen[0]:.2f} mm rms. Noise is in both numbers."
        if unseen[1] >= unseen[0]:
            verdict = "Calibration did not help"
    draw_verdict(figure, verdict, facts, told)
    with write_whole(path) as temporary:
        figure.savefig(temporary, dpi=110)
