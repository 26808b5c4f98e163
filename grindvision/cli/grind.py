"""``grindvision grind``: two scans in, grinding passes out; and, from a scan afterwards, whether the stock is gone."""

from __future__ import annotations

import argparse
import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import add_camera_arguments, scanner_pose, where_it_stood
from grindvision.cli.grind_results import piece_facts, plan_facts, write_ways
from grindvision.cli.grind_robot import PROGRAM_FILES, add_robot_arguments, grind_robot
from grindvision.cli.parameters import check_count, number, whole
from grindvision.cli.part import (
    add_box_arguments,
    add_datum_argument,
    doubts_before_grinding,
    read_datum,
)
from grindvision.cli.report import Run, add_output_arguments
from grindvision.cli.scans import (
    CLOUD_FORMATS,
    UNITS,
    add_field_argument,
    add_unit_argument,
    add_viewpoint_argument,
    read_correction,
    size_question,
)
from grindvision.errors import GrindvisionWarning, InputError
from grindvision.words import counted

if TYPE_CHECKING:
    import numpy as np

    from grindvision.motion.grinding_options import GrindingOptions

EPILOG = """\
results in DIR:
  passes.csv        piece,pass,line,kind,x_mm,y_mm,z_mm,nx,ny,nz,tx,ty,tz,feed_mm_s,force_n: the way of the wheel's
                    lowest point through all passes; scanner frame of TEST, n outward normal, t along the line
  passes_base.csv   the same in the robot's base frame, with --scanner-pose or --hand-eye
  grind1.*, ...     with --robot: a programme for each piece
  plan.npz          what --again goes on with
  report.pdf        one page a piece: map, section, numbers, verdict, serials, hashes, versions
  report.png        the largest piece; report.json  stock and passes in numbers; written last

The wheel must be touched off on the good surface beside the stock: where a scanner and an arm see that surface
differs by their own calibration, which no difference of scans shows. Or say how far they may err with --place-sigma:
the first passes stop above that, --again learns from its scan where the wheel cut, and the rest goes down to the end.
The part stays clamped in between; say where the scanner stood in both runs, by --scanner-pose or --hand-eye, unless it
stands still.

exit code: 0 done, 3 with --again and --tolerance-mm: done, but the tolerance is not met, 2 the input cannot be used
(one line says why), 1 anything else

examples:
  grindvision grind good.ply test.ply -o job --wheel 20 --width 6 --depth 0.1
  grindvision grind good.ply test.ply -o job --robot ur3 --scanner-pose pose.json --base controller --program urscript
  grindvision grind good.ply test.ply -o job --hand-eye camera/hand_eye.json --robot-pose 412.5 80 310 180 0 45
  grindvision grind cad_points.ply casting.ply -o job --region face.ply --skin 0.5 --depth 0.25
  grindvision grind --again job after.ply --tolerance-mm 0.15
"""

#: Option -> field of ``GrindingOptions`` and what a number of the option is worth there.
FIELDS = {
    "wheel": ("radius_mm", 1.0),
    "disc": ("radius_mm", 1.0),
    "width": ("width_mm", 1.0),
    "contact_angle": ("contact_angle_rad", math.pi / 180),
    "depth": ("depth_mm", 1.0),
    "overlap": ("overlap", 1.0),
    "pattern": ("pattern", None),
    "step": ("step_mm", 1.0),
    "leave": ("leave_mm", 1.0),
    "passes": ("passes_max", None),
    "force": ("force_n", 1.0),
    "surface_speed": ("surface_speed_m_s", 1.0),
    "k": ("k_mm2_n", 1.0),
    "lead": ("lead_mm", 1.0),
    "retract": ("retract_mm", 1.0),
    "keep_out_distance": ("keep_out_mm", 1.0),
    "lead_angle": ("lead_angle_rad", math.pi / 180),
}


LIBRARIES = ("numpy", "scipy", "numba", "matplotlib")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class, parser.epilog = argparse.RawDescriptionHelpFormatter, EPILOG
    scans = parser.add_argument_group("scans")
    scans.add_argument(
        "clouds",
        nargs="+",
        metavar="CLOUD",
        help=f"SAMPLE and TEST, or with --again the new scan ({CLOUD_FORMATS}); SAMPLE may be a model: STL, OBJ or a"
        " PLY with faces",
    )
    scans.add_argument("--again", metavar="DIR", help="folder of an earlier run: judge a scan made after its passes")
    scans.add_argument("--sample", metavar="FILE", help="with --again: the good scan, where it was moved")
    scans.add_argument(
        "--tolerance-mm", type=number, metavar="MM", help="with --again: what may stand above the good surface at most"
    )
    add_unit_argument(scans)
    scans.add_argument("--sample-unit", choices=UNITS, help="unit of SAMPLE's numbers, where it is not that of TEST")
    add_box_arguments(scans)
    add_field_argument(scans)
    scans.add_argument("--sample-model", action="store_true", help="SAMPLE is made of points of a model, as in detect")
    add_datum_argument(scans, region=True)
    scans.add_argument("--scanner-pose", metavar="FILE.json", help="4x4 matrix T_base_scanner of the last scan, mm")
    add_viewpoint_argument(scans, "--sample-viewpoint", "SAMPLE")
    add_viewpoint_argument(scans, "--test-viewpoint", "TEST or the new scan")
    scans.add_argument("--seed", type=whole, default=0, metavar="N", help="seed of the random draws (default: 0)")
    wheel = parser.add_argument_group("wheel and cut")
    kind = wheel.add_mutually_exclusive_group()
    kind.add_argument("--wheel", type=number, metavar="MM", help="radius of a wheel cutting with its rim (default: 20)")
    kind.add_argument("--disc", type=number, metavar="MM", help="radius of a disc that grinds with its tilted face")
    wheel.add_argument("--width", type=number, metavar="MM", help="width of the wheel (default: 6)")
    wheel.add_argument("--contact-angle", type=number, metavar="DEG", help="of the disc to the surface (default: 15)")
    wheel.add_argument("--depth", type=number, metavar="MM", help="depth of cut per pass (default: 0.1)")
    wheel.add_argument("--overlap", type=number, metavar="F", help="of lines, fraction of the contact (default: 0.3)")
    wheel.add_argument(
        "--pattern",
        choices=("bead", "raster", "contour"),
        help="bead: along it; raster: in rows; contour: around (default: bead)",
    )
    wheel.add_argument("--step", type=number, metavar="MM", help="between path points at most (default: 1)")
    wheel.add_argument("--leave", type=number, metavar="MM", help="left standing (default: 1.5 sigma of the surface)")
    wheel.add_argument("--passes", type=whole, metavar="N", help="plan so many passes at most, to scan after them")
    process = parser.add_argument_group("process")
    process.add_argument("--force", type=number, metavar="N", help="limit of the contact force, newtons (default: 40)")
    process.add_argument(
        "--feed", type=number, nargs=2, metavar=("MIN", "MAX"), help="limits of the feed, mm/s (default: 1 50)"
    )
    process.add_argument("--surface-speed", type=number, metavar="M_S", help="of the wheel (default: 20)")
    process.add_argument(
        "--k", type=number, metavar="MM2_N", help="Preston's coefficient (default: 2.5e-5; learnt later)"
    )
    process.add_argument(
        "--place-sigma",
        type=number,
        metavar="MM",
        help="standard deviation of where the arm's wheel meets a surface that the scan shows, by scanner, hand-eye and"
        " arm: so much is left standing, three times, until --again has seen where the wheel cut (default: 0, the wheel"
        " is touched off on the good surface beside the stock)",
    )
    ways = parser.add_argument_group("ways")
    ways.add_argument("--lead", type=number, metavar="MM", help="length of lead-in and lead-out (default: 5)")
    ways.add_argument("--retract", type=number, metavar="MM", help="height between lines (default: 20)")
    ways.add_argument("--keep-out", metavar="FILE", help="cloud of points, frame of TEST, that must not be touched")
    ways.add_argument("--keep-out-distance", type=number, metavar="MM", help="kept to them (default: 1)")
    ways.add_argument("--lead-angle", type=number, metavar="DEG", help="the tool's axis leans forward (default: 0)")
    add_camera_arguments(parser, "TEST or the new scan")
    add_robot_arguments(parser)
    report = parser.add_argument_group("report")
    report.add_argument("--serial", nargs="+", metavar="NAME=VALUE", help="printed on every page, as part=A17 wheel=W3")
    add_output_arguments(parser, required=False)


def run(options: argparse.Namespace) -> int:
    """Run it."""
    check_count("--seed", options.seed, 0, 10**18)
    serials = _serials(options.serial or [])
    if options.again is not None:
        from grindvision.cli.grind_again import run_again

        if len(options.clouds) != 1:
            raise InputError(f"--again takes one new scan, {len(options.clouds)} clouds were given")
        for name in ("region", "skin"):
            if getattr(options, name) is not None:
                raise InputError(f"--{name} is for a new job; --again knows where the pieces of its job are")
        options.test = options.clouds[0]
        options.output = options.output or str(Path(options.again) / "again")
        return run_again(options, serials)
    if len(options.clouds) != 2:
        raise InputError(f"give SAMPLE and TEST; not {counted(len(options.clouds), 'cloud')}")
    for name in ("sample", "tolerance_mm"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} is for a scan after the passes; give --again DIR as well")
    if options.output is None:
        raise InputError("-o DIR is missing: say where the results go")
    options.sample, options.test = options.clouds
    return _plan(options, serials)


def grinding_options(options: argparse.Namespace, before: GrindingOptions | None = None) -> GrindingOptions:
    """What the command line says of wheel, cut, process and ways; the rest as ``before``, or by default."""
    from dataclasses import asdict

    from grindvision.motion.grinding_options import GrindingOptions

    values = {} if before is None else asdict(before)
    for name, (field, worth) in FIELDS.items():
        given = getattr(options, name)
        if given is not None:
            values[field] = given if worth is None else given * worth
    if options.wheel is not None or options.disc is not None:
        values["tool"] = "wheel" if options.disc is None else "disc"
    if options.feed is not None:
        values["feed_min_mm_s"], values["feed_max_mm_s"] = options.feed
    return GrindingOptions(**values)


def _plan(options: argparse.Namespace, serials: dict[str, str]) -> int:
    from grindvision.cli.detect import read_sample_and_test
    from grindvision.cli.pictures import drawing
    from grindvision.files import sha256
    from grindvision.grinding import STAGES, GrindOptions, grind
    from grindvision.grinding_files import PLAN_FILE, job_of, write_job

    draw = drawing("grind_picture")
    settings = grinding_options(options)
    field = read_correction(options.field_correction, options.test_viewpoint)
    if options.place_sigma is not None and not 0 <= options.place_sigma < 1e3:
        raise InputError(f"--place-sigma is {options.place_sigma}; give a length in mm, 0 for a wheel touched off")
    T_base_scanner = scanner_pose(options)
    robot = grind_robot(options, T_base_scanner)
    del options.clouds
    outdated = ("passes.csv", "passes_base.csv", PLAN_FILE, "report.pdf", *PROGRAM_FILES)
    with Run(options, ("sample", "test"), LIBRARIES, len(STAGES) + 4, outdated) as work:
        paths = (options.sample, options.test)
        with work.stage("read"):
            sample, test, clouds = read_sample_and_test(options, field)
            keep_out = _keep_out(options)
        for finding in doubts_before_grinding(options, T_base_scanner, test):
            warnings.warn(finding, GrindvisionWarning, stacklevel=1)
        asked = GrindOptions(
            settings,
            keep_out=keep_out,
            seed=options.seed,
            viewpoint_sample_mm=options.sample_viewpoint,
            viewpoint_test_mm=options.test_viewpoint,
            place_sigma_mm=options.place_sigma or 0.0,
            datum_mm=read_datum(options.datum, options.sample_unit or options.unit),
            region_mm=read_datum(options.region, options.unit, "--region"),
            skin_mm=options.skin,
        )
        found = grind(sample, test, asked, work.finished)
        with work.stage("write"):
            pieces = found.stock.pieces
            job = job_of(found.T_sample_test, pieces, found.plans, settings, _origin(options), T_base_scanner)
            write_job(work.place / PLAN_FILE, job, pieces)
            motion = write_ways(work.place, found.plans, T_base_scanner, robot, test)
        facts = {"serials": serials, "inputs": {path: sha256(path) for path in paths}}
        with work.stage("picture"):
            draw(found.stock.pieces, found.plans, None, str(found), work.warnings, facts, work.place)
        questions = [size_question(("SAMPLE", "TEST"), clouds)]
        questions += where_it_stood(T_base_scanner, robot)
        results = {
            "T_sample_test": found.T_sample_test,
            "confidence": found.compared.registration.confidence,
            "serials": serials,
            "deformation": None if found.compared.deformed is None else found.compared.deformed.facts(),
            "stock": {
                "volume_mm3": found.stock.volume_mm3,
                "volume_sigma_mm3": found.stock.volume_sigma_mm3,
                "level_of_detection_mm": found.stock.level_mm,
                "pits": [
                    {"middle_mm": pit.middle_mm, "area_mm2": pit.area_mm2, "depth_mm": depth}
                    for pit, depth in zip(found.stock.pits, found.stock.pit_depths_mm, strict=True)
                ],
            },
            "pieces": [
                piece_facts(piece) | {"plan": plan_facts(plan), "refused": found.refusals.get(at)}
                for at, (piece, plan) in enumerate(zip(found.stock.pieces, found.plans, strict=True), start=1)
            ],
        }
        if motion is not None:
            results["motion"] = motion
        shown = "\n".join(f"piece {at}: {plan}" for at, plan in enumerate(found.plans, start=1) if plan is not None)
        values = {"leave_mm": [None if plan is None else plan.leave_mm for plan in found.plans]}
        work.report(str(found), results, values, found.timings_s, shown, questions)
    return 0


def _origin(options: argparse.Namespace) -> dict[str, Any]:
    """Where the good scan of a job is found again."""
    from grindvision.files import sha256

    path = str(Path(options.sample).resolve())
    read_as = {"unit": options.unit, "sample_unit": options.sample_unit, "sample_box": options.sample_box}
    return {"path": path, "sha256": sha256(options.sample), "skin_mm": options.skin, **read_as}


def _keep_out(options: argparse.Namespace) -> np.ndarray | None:
    if options.keep_out is None:
        return None
    from grindvision.clouds import finite_points, read_cloud

    return finite_points(read_cloud(options.keep_out, options.unit), options.keep_out)


def _serials(words: list[str]) -> dict[str, str]:
    pairs = [word.partition("=") for word in words]
    if any(not sign or not name for name, sign, _ in pairs):
        raise InputError(f"--serial {' '.join(words)[:60]}: give NAME=VALUE, as part=A17")
    return {name: value for name, _, value in pairs}
