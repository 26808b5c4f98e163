"""``grindvision detect``: two scans in, the grinding path out."""

from __future__ import annotations

import argparse
import math
import warnings
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import add_camera_arguments, scanner_pose, where_it_stood
from grindvision.cli.deformation_file import DEFORMATION_FILE, deformation_text
from grindvision.cli.facing import viewpoint_of
from grindvision.cli.parameters import check_count, number, whole
from grindvision.cli.part import add_box_arguments, add_datum_argument, cut_to_box, read_datum
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.scans import (
    CLOUD_FORMATS,
    UNITS,
    add_field_argument,
    add_mirrored_argument,
    add_unit_argument,
    add_viewpoint_argument,
    check_own_frame,
    corrected,
    diagnose_pose,
    read_correction,
    read_pair,
    rows_text,
    size_question,
)
from grindvision.errors import GrindvisionWarning, InputError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.clouds import Cloud
    from grindvision.models import Model
    from grindvision.vision.change.coverage import Coverage
    from grindvision.vision.change.detection import Detection
    from grindvision.vision.depth_calibration.field_correction import FieldCorrection
    from grindvision.vision.surface.facets import Facets

ENOUGH_SHOWN = 0.8
"""Fraction of the test scan on which ``--require-height`` must be met: its rim has nothing to compare with."""

PATH_COLUMNS = "point,x_mm,y_mm,z_mm,nx,ny,nz"

EPILOG = """\
results in DIR:
  path.csv         point,x_mm,y_mm,z_mm,nx,ny,nz: path points and outward normals, scanner frame of TEST
  path_base.csv    the same in the robot's base frame, with --scanner-pose or --hand-eye
  difference.ply   the points that stand out, scanner frame of TEST
  deformation.csv  x_mm,y_mm,z_mm,outward_mm,sigma_mm, where no rigid pose fits: how far the part is bent against SAMPLE
                   along its outward normal; what stands out is measured above SAMPLE bent like it
  report.png       did it work? the scans before and after, the difference, the path
  report.json      T_sample_test, confidence, beads, timings, versions, parameters, questions; written last

exit code: 0 done (also when there is nothing to grind), 3 done, but the pair cannot show the --require-height,
2 the input cannot be used (one line says why), 1 anything else

examples:
  grindvision detect good.ply test.ply -o result
  grindvision detect good.stl test.pcd -o result --unit m --scanner-pose pose.json --points 12
  grindvision detect good.ply test.ply -o result --hand-eye camera/hand_eye.json --robot-pose 412.5 80 310 180 0 45
  grindvision detect good.ply test.ply -o result --sample-box -80 -60 380 80 60 440 --test-box -90 -60 380 70 60 440
  grindvision detect model.stl test.ply -o result --field-correction camera/field.npz
  grindvision detect good.ply test.ply -o again --parameters result/parameters.toml
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    scans = parser.add_argument_group("scans")
    scans.add_argument(
        "sample",
        metavar="SAMPLE",
        help=f"scan of the good part ({CLOUD_FORMATS}), or its model: STL, OBJ or a PLY with faces, of which what the"
        " scanner of TEST could see is compared",
    )
    scans.add_argument("test", metavar="TEST", help="scan of the part to be ground, from any side of the same face")
    add_unit_argument(scans)
    scans.add_argument("--sample-unit", choices=UNITS, help="unit of SAMPLE's numbers, where it is not that of TEST")
    scans.add_argument(
        "--scanner-pose",
        metavar="FILE.json",
        help="4x4 matrix T_base_scanner of the TEST scan, mm, bare or under that key; adds path_base.csv",
    )
    add_viewpoint_argument(scans, "--sample-viewpoint", "SAMPLE")
    add_viewpoint_argument(scans, "--test-viewpoint", "TEST")
    add_box_arguments(scans)
    add_mirrored_argument(scans, "SAMPLE and TEST")
    scans.add_argument(
        "--mirrored-only",
        choices=("sample", "test"),
        help="only this one of the two clouds is mirrored (default: both)",
    )
    add_datum_argument(scans)
    add_field_argument(scans)
    scans.add_argument(
        "--sample-model",
        action="store_true",
        help="SAMPLE is made of points of a model and has no scanner's error: --field-correction is for TEST alone (a"
        " mesh needs no such word)",
    )
    add_camera_arguments(parser, "TEST")
    path = parser.add_argument_group("path")
    path.add_argument("--points", type=whole, default=6, metavar="N", help="path points per bead (default: 6)")
    path.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of the random draws (default: 0)")
    path.add_argument(
        "--require-height",
        type=number,
        metavar="MM",
        help="end with exit code 3, and say where, unless a bead of this height would be told on at least"
        f" {ENOUGH_SHOWN:.0%}% of the test scan",
    )
    add_output_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    check_count("--points", options.points, 1, 100_000)
    check_count("--seed", options.seed, 0, 10**18)
    if options.require_height is not None and not 0 < options.require_height < 1e6:
        raise InputError(f"--require-height is {options.require_height}; give a height in mm above zero")
    if options.mirrored is None and options.mirrored_only is not None:
        raise InputError("--mirrored-only says which cloud --mirrored is for; give --mirrored as well, or leave it out")

    from grindvision.cli.picture_process import drawing_beside

    draw = drawing_beside("detect_picture")  # before all else is loaded: both take their time
    from grindvision.cli.detect_shown import to_show
    from grindvision.clouds import write_ply
    from grindvision.files import write_text
    from grindvision.geometry import move_points, rotate_vectors
    from grindvision.vision.change.detection import STAGES, DetectOptions, detect

    field = read_correction(options.field_correction, options.test_viewpoint)
    T_base_scanner = scanner_pose(options)
    libraries = ("numpy", "scipy", "numba", "matplotlib")
    with Run(
        options, ("sample", "test"), libraries, len(STAGES) + 4, outdated=("path_base.csv", DEFORMATION_FILE)
    ) as work:
        with work.stage("read"):
            sample, test, clouds = read_sample_and_test(options, field, _mirrored(options))
        for finding in [] if T_base_scanner is None else diagnose_pose(T_base_scanner, test):
            warnings.warn(finding, GrindvisionWarning, stacklevel=1)
        settings = DetectOptions(
            options.points,
            options.seed,
            options.sample_viewpoint,
            options.test_viewpoint,
            read_datum(options.datum, options.sample_unit or options.unit),
        )
        found = detect(sample, test, settings, work.finished)
        lacking = _lacking_height(found, options.require_height)
        if lacking:
            warnings.warn(lacking, GrindvisionWarning, stacklevel=1)
        with work.stage("write"):
            write_text(work.place / "path.csv", rows_text(PATH_COLUMNS, found.path_points, found.path_normals))
            if T_base_scanner is not None:
                points = move_points(T_base_scanner, found.path_points)
                normals = rotate_vectors(T_base_scanner, found.path_normals)
                write_text(work.place / "path_base.csv", rows_text(PATH_COLUMNS, points, normals))
            write_ply(work.place / "difference.ply", found.difference.points)
            if found.deformed is not None:
                write_text(work.place / DEFORMATION_FILE, deformation_text(found.deformed))
        with work.stage("picture"):
            draw(to_show(found), work.warnings, work.place / "report.png")
        questions = [size_question(("SAMPLE", "TEST"), clouds)]
        questions += where_it_stood(T_base_scanner)
        values = _from_the_data(options, found)
        shown = "" if found.model is None else f"SAMPLE is a model: {found.model}"
        work.report(str(found), _results(found), values, found.timings_s, shown, questions)
    return 3 if lacking else 0


def read_sample_and_test(
    options: argparse.Namespace, field: FieldCorrection | None, mirrored: tuple[str | None, str | None] = (None, None)
) -> tuple[np.ndarray | Model, np.ndarray, list[Cloud | Model]]:
    """SAMPLE and TEST as ``detect`` takes them, without the scanner's depth error, and as they were read; what lies
    outside of their boxes is in neither."""
    from grindvision.clouds import Cloud, finite_points

    units = options.sample_unit or options.unit, options.unit
    good, scan = read_pair((options.sample, options.test), units, mirrored)
    test = finite_points(scan, options.test)
    if field is None:  # which is for clouds in the scanner's own frame
        options.test_viewpoint = viewpoint_of(options.test, scan, options.test_viewpoint, "--test-viewpoint")
    if not isinstance(good, Cloud):
        if options.sample_viewpoint is not None:
            raise InputError("--sample-viewpoint is for a scan, and SAMPLE is a model; leave it out")
        if options.sample_box is not None:
            raise InputError("--sample-box is for a scan, and SAMPLE is a model; leave it out")
        test = test if field is None else corrected(field, scan, test, options.test)
        scan, test = cut_to_box(scan, test, options.test_box, options.test, "--test-box")
        return good, test, [good, scan]
    sample = finite_points(good, options.sample)
    if field is None:
        seen_from = viewpoint_of(options.sample, good, options.sample_viewpoint, "--sample-viewpoint")
        options.sample_viewpoint = seen_from
    else:
        test = corrected(field, scan, test, options.test)
        if not options.sample_model:
            check_own_frame(options.sample_viewpoint)
            sample = corrected(field, good, sample, options.sample, "export it as measured, or say --sample-model")
    good, sample = cut_to_box(good, sample, options.sample_box, options.sample, "--sample-box")
    scan, test = cut_to_box(scan, test, options.test_box, options.test, "--test-box")
    return sample, test, [good, scan]


def _lacking_height(found: Detection, height_mm: float | None) -> str:
    """In words, where the pair cannot show a bead of the height asked for; empty where it can, or none is asked for."""
    if height_mm is None:
        return ""
    from grindvision.vision.change.coverage import cannot_show

    blind, places = cannot_show(found.difference, height_mm)
    if blind <= 1 - ENOUGH_SHOWN:
        return ""
    where = f", the largest place {places[0]}" if places else ""
    return (
        f"a bead of {height_mm:g} mm (--require-height) would not be told on {blind:.0%} of the test scan{where}; scan"
        " nearer, with less noise, or from where both scans show the surface"
    )


def _mirrored(options: argparse.Namespace) -> tuple[str | None, str | None]:
    """For SAMPLE and TEST the axis that counts the wrong way, or None."""
    only = options.mirrored_only
    return options.mirrored if only != "test" else None, options.mirrored if only != "sample" else None


def _results(found: Detection) -> dict[str, Any]:
    registration = found.registration
    return {
        "T_sample_test": registration.T_target_source,
        "fitness": registration.overlap,
        "rmse": registration.rms_mm,
        "confidence": found.confidence,
        "covariance": registration.total_covariance,
        "level_of_detection_mm": found.difference.level_of_detection_mm,
        "coverage": _coverage(found.coverage),
        "faces_off": [
            {
                "middle_mm": face.middle_mm,
                "normal": face.normal,
                "area_mm2": face.area_mm2,
                "offset_mm": face.offset_mm,
                "sigma_mm": face.sigma_mm,
            }
            for face in found.faces_off
        ],
        "deformation": None if found.deformed is None else found.deformed.facts(),
        **({} if found.model is None else {"model": _model(found.model.facets)}),
        "beads": [
            {
                "points": len(bead.points),
                "closed": bead.closed,
                "length_mm": bead.length_mm,
                "width_mm": bead.width_mm,
                "height_mm": bead.height_mm,
            }
            for bead in found.beads
        ],
        "specks": [
            {
                "middle_mm": speck.middle_mm,
                "area_mm2": speck.area_mm2,
                "height_mm": speck.height_mm,
                "floating": speck.floating,
            }
            for speck in found.difference.specks
        ],
    }


def _model(facets: Facets) -> dict[str, Any]:
    """What SAMPLE is, where it is a model."""
    return {
        "facets": len(facets),
        "degenerate": facets.degenerate,
        "turned": facets.turned,
        "closed": facets.closed,
        "area_mm2": facets.area_mm2,
    }


def _coverage(coverage: Coverage) -> dict[str, Any]:
    """What was compared and what could be seen there; lengths in mm, places in the scanner frame of TEST."""
    sides = (
        ("test", coverage.test_fraction, coverage.test_missed_mm2, coverage.test_missed),
        ("sample", coverage.sample_fraction, coverage.sample_missed_mm2, coverage.sample_missed),
    )
    heights = {"median": coverage.height_mm, "on_95_percent": coverage.height_95_mm}
    stated = {name: height if height < math.inf else None for name, height in heights.items()}
    return {
        **{
            name: {
                "fraction": fraction,
                "not_compared_mm2": area_mm2,
                "places": [{"middle_mm": place.middle_mm, "area_mm2": place.area_mm2} for place in places],
            }
            for name, fraction, area_mm2, places in sides
        },
        "min_height_mm": stated,
        "min_width_mm": coverage.width_mm,
        "min_sideways_mm": coverage.sideways_mm,
        "least_height_mm": stated,  # the keys of 0.1, for one version
        "least_width_mm": coverage.width_mm,
    }


def _from_the_data(options: argparse.Namespace, found: Detection) -> dict[str, Any]:
    values: dict[str, Any] = {
        "surfel_mm": found.test.surfels.grid.size_mm,
        "voxel_mm": found.test.voxels.grid.size_mm,
        "level_of_detection_mm": found.difference.level_of_detection_mm,
    }
    if options.unit is None:
        values["unit"] = "mm unless the files say m"
    if found.model is not None and options.field_correction is not None:
        values["sample-model"] = True
    for name, scan in (("sample", found.sample), ("test", found.test)):
        if getattr(options, f"{name}_viewpoint") is None:
            values[f"{name}-viewpoint"] = "not known" if scan.viewpoint_mm is None else scan.viewpoint_mm
    return values
