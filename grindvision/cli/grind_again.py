"""``grindvision grind --again``: a scan after the passes in; the process learnt, what is left, a verdict."""

from __future__ import annotations

import argparse
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.camera_pose import scanner_pose, where_it_stood
from grindvision.cli.part import doubts_before_grinding, read_datum
from grindvision.cli.report import Run
from grindvision.cli.scans import read_correction, size_question
from grindvision.errors import FileError, GrindvisionWarning, InputError

if TYPE_CHECKING:
    from grindvision.grinding_again import GroundAgain
    from grindvision.grinding_files import GrindingJob
    from grindvision.motion.grinding import GrindingPlan
    from grindvision.motion.removal import LearntRemoval
    from grindvision.vision.change.remaining import Remaining
    from grindvision.vision.change.stock import StockPiece


def run_again(options: argparse.Namespace, serials: dict[str, str]) -> int:
    """Run it; 3 where a tolerance is named and not met."""
    from grindvision.cli.detect import read_sample_and_test
    from grindvision.cli.grind import LIBRARIES, grinding_options
    from grindvision.cli.grind_results import write_ways
    from grindvision.cli.grind_robot import PROGRAM_FILES, grind_robot
    from grindvision.cli.pictures import drawing
    from grindvision.files import sha256
    from grindvision.grinding import STAGES, GrindOptions
    from grindvision.grinding_again import GrindAgainOptions, grind_again
    from grindvision.grinding_files import PLAN_FILE, job_of, read_job, write_job

    draw = drawing("grind_picture")
    if options.tolerance_mm is not None and not 0 < options.tolerance_mm < 1e6:
        raise InputError(f"--tolerance-mm is {options.tolerance_mm}; give a height in mm above zero")
    job = read_job(options.again)
    options.sample = _sample(options, job)
    T_base_scanner = scanner_pose(options)
    robot = grind_robot(options, T_base_scanner)
    del options.clouds
    options.unit = unit = options.unit or job.sample.get("unit")
    options.sample_unit = options.sample_unit or job.sample.get("sample_unit")
    options.sample_box = options.sample_box or job.sample.get("sample_box")
    field = read_correction(options.field_correction, options.test_viewpoint)
    outdated = ("passes.csv", "passes_base.csv", PLAN_FILE, "report.pdf", *PROGRAM_FILES)
    with Run(options, ("sample", "test"), LIBRARIES, len(STAGES) + 3, outdated) as work:
        paths = (options.sample, options.test)
        with work.stage("read"):
            sample, new, clouds = read_sample_and_test(options, field)
        for finding in doubts_before_grinding(options, T_base_scanner, new):
            warnings.warn(finding, GrindvisionWarning, stacklevel=1)
        asked = GrindAgainOptions(
            GrindOptions(
                seed=options.seed,
                viewpoint_sample_mm=options.sample_viewpoint,
                viewpoint_test_mm=options.test_viewpoint,
                datum_mm=read_datum(options.datum, options.sample_unit or unit),
            ),
            options.tolerance_mm,
            lambda before: grinding_options(options, before),
            T_base_scanner,
        )
        found = grind_again(job, sample, new, asked, work.finished)
        pieces, judged, learnt, plans = found.pieces, found.judged, found.learnt, found.plans
        T_sample_test = found.compared.registration.T_target_source
        message = _message(found, options.tolerance_mm)
        with work.stage("write"):
            motion = None
            if any(plan is not None for plan in plans):
                origin = {**job.sample, "path": str(Path(options.sample).resolve()), "sample_box": options.sample_box}
                rest = job_of(T_sample_test, pieces, plans, found.passes, origin, T_base_scanner)
                write_job(work.place / PLAN_FILE, rest, pieces)
                motion = write_ways(work.place, plans, T_base_scanner, robot, new)
        facts = {"serials": serials, "inputs": {path: sha256(path) for path in paths}}
        with work.stage("picture"):
            draw(pieces, plans, judged, message, work.warnings, facts, work.place)
        results = {
            "T_sample_test": T_sample_test,
            "confidence": found.compared.registration.confidence,
            "serials": serials,
            "tolerance_mm": found.tolerance_mm,
            "met": found.met,
            "pieces": _facts(pieces, judged, learnt, plans),
            "motion": motion,
        }
        questions = [size_question(("SAMPLE", "NEWSCAN"), clouds)]
        questions += where_it_stood(T_base_scanner, robot)
        work.report(message, results, {}, found.timings_s, _shown(found), questions)
    return 3 if options.tolerance_mm is not None and not found.met else 0


def _shown(found: GroundAgain) -> str:
    """What the command says of each piece."""
    lines = [f"piece {at}: {one}" for at, one in enumerate(found.judged, start=1)]
    lines += [f"piece {at}: {one}" for at, one in enumerate(found.learnt, start=1) if one is not None]
    lines += [f"piece {at}, the rest: {one}" for at, one in enumerate(found.plans, start=1) if one is not None]
    return "\n".join(lines)


def _facts(
    pieces: tuple[StockPiece, ...],
    judged: tuple[Remaining, ...],
    learnt: tuple[LearntRemoval | None, ...],
    plans: tuple[GrindingPlan | None, ...],
) -> list[dict[str, Any]]:
    """What report.json says of the pieces."""
    from grindvision.cli.grind_results import piece_facts, plan_facts

    return [
        {
            **piece_facts(piece),
            "remaining": vars(verdict) | {"met": verdict.met},
            "learnt": None if told is None else vars(told),
            "plan": plan_facts(plan),
        }
        for piece, verdict, told, plan in zip(pieces, judged, learnt, plans, strict=True)
    ]


def _sample(options: argparse.Namespace, job: GrindingJob) -> str:
    """The path of the good scan that the job was planned with.

    Raises:
        FileError: it is gone, or another one lies there.
    """
    from grindvision.files import sha256

    path = options.sample or str(job.sample["path"])
    if not os.path.isfile(path):
        raise FileError(f"the good scan {path} of this job is gone; say where it is with --sample")
    if sha256(path) != job.sample["sha256"]:
        raise FileError(f"{path}: not the good scan that this job was planned with; give that one with --sample")
    return path


def _message(found: GroundAgain, tolerance_mm: float | None) -> str:
    asked = f"tolerance of {tolerance_mm:g} mm" if tolerance_mm is not None else "twice the level of detection"
    return f"{asked} {found}"
