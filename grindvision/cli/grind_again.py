"""``grindvision grind --again``: a scan after the passes in; the process learnt, what is left, a verdict."""

from __future__ import annotations

import argparse
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from grindvision.cli.report import Run
from grindvision.cli.scans import diagnose_pose, read_pose, read_scans, size_question, where_it_stood
from grindvision.errors import FileError, GrindvisionWarning, InputError

if TYPE_CHECKING:
    import numpy as np

    from grindvision.grinding_files import GrindingJob
    from grindvision.motion.grinding import GrindingPlan
    from grindvision.motion.removal import LearntRemoval
    from grindvision.vision.change.remaining import Remaining
    from grindvision.vision.change.stock import StockPiece
    from grindvision.vision.registration.scan_registration import Registration, StageClock


def run_again(options: argparse.Namespace, serials: dict[str, str]) -> int:
    """Run it; 3 where a tolerance is named and not met."""
    from grindvision.cli.grind import LIBRARIES, grinding_options, write_ways
    from grindvision.cli.grind_robot import PROGRAM_FILES, grind_robot
    from grindvision.cli.pictures import drawing
    from grindvision.clouds import finite_points
    from grindvision.files import sha256
    from grindvision.grinding import STAGES
    from grindvision.grinding_files import PLAN_FILE, read_job, write_job
    from grindvision.vision.registration.scan_registration import StageClock

    draw = drawing("grind_picture")
    if options.tolerance_mm is not None and not 0 < options.tolerance_mm < 1e6:
        raise InputError(f"--tolerance-mm is {options.tolerance_mm}; give a height in mm above zero")
    job = read_job(options.again)
    options.sample = _sample(options, job)
    T_base_scanner = None if options.scanner_pose is None else read_pose(options.scanner_pose)
    robot = grind_robot(options, T_base_scanner)
    del options.clouds
    unit = options.unit or job.sample.get("unit")
    outdated = ("passes.csv", "passes_base.csv", PLAN_FILE, "report.pdf", *PROGRAM_FILES)
    with Run(options, ("sample", "test"), LIBRARIES, len(STAGES) + 3, outdated) as work:
        paths = (options.sample, options.test)
        with work.stage("read"):
            clouds = read_scans(paths, unit)
            sample, new = (finite_points(cloud, path) for cloud, path in zip(clouds, paths, strict=True))
        for doubt in [] if T_base_scanner is None else diagnose_pose(T_base_scanner, new):
            warnings.warn(doubt, GrindvisionWarning, stacklevel=1)
        clock = StageClock(work.finished)
        found, pieces = _measured(job, sample, new, options, clock)
        learnt = _learnt(job, pieces)
        tolerance_mm = options.tolerance_mm or 2 * pieces[0].level_mm
        judged = _judged(pieces, tolerance_mm)
        settings = grinding_options(options, _with_learnt(job, learnt))
        plans = _plans(job, pieces, judged, settings)
        clock.lap("passes")
        message = _message(judged, learnt, options.tolerance_mm)
        with work.stage("write"):
            motion = None
            if any(plan is not None for plan in plans):
                origin = {**job.sample, "path": str(Path(options.sample).resolve())}
                write_job(work.place / PLAN_FILE, found.T_target_source, pieces, tuple(plans), settings, origin)
                motion = write_ways(work.place, plans, T_base_scanner, robot, new)
        facts = {"serials": serials, "inputs": {path: sha256(path) for path in paths}}
        with work.stage("picture"):
            draw(pieces, plans, judged, message, work.warnings, facts, work.place)
        results = {
            "T_sample_test": found.T_target_source,
            "confidence": found.confidence,
            "serials": serials,
            "tolerance_mm": tolerance_mm,
            "met": all(one.met for one in judged),
            "pieces": _facts(pieces, judged, learnt, plans),
            "motion": motion,
        }
        questions = [size_question(("SAMPLE", "NEWSCAN"), clouds)]
        if T_base_scanner is not None:
            questions.append(where_it_stood(T_base_scanner))
        lines = [f"piece {at}: {one}" for at, one in enumerate(judged, start=1)]
        lines += [f"piece {at}: {one}" for at, one in enumerate(learnt, start=1) if one is not None]
        lines += [f"piece {at}, the rest: {one}" for at, one in enumerate(plans, start=1) if one is not None]
        work.report(message, results, {}, clock.laps_s, "\n".join(lines), questions)
    return 3 if options.tolerance_mm is not None and not all(one.met for one in judged) else 0


def _measured(
    job: GrindingJob, sample: np.ndarray, new: np.ndarray, options: argparse.Namespace, clock: StageClock
) -> tuple[Registration, tuple[StockPiece, ...]]:
    """The new scan on the good one, and what stands at the places of the job's pieces."""
    from grindvision.geometry import inverse
    from grindvision.grinding import GrindOptions, compare
    from grindvision.vision.change.stock import measure_again

    asked = GrindOptions(
        seed=options.seed, viewpoint_sample_mm=options.sample_viewpoint, viewpoint_test_mm=options.test_viewpoint
    )
    compared = compare(sample, new, asked, clock)
    found = compared.registration
    for sentence in compared.doubts:
        warnings.warn(sentence, GrindvisionWarning, stacklevel=1)
    T_new_test = inverse(found.T_target_source) @ job.T_sample_test
    pieces = measure_again(found.source, found.target, found.fine, compared.difference, job.places, T_new_test)
    clock.lap("stock")
    return found, pieces


def _facts(
    pieces: tuple[StockPiece, ...],
    judged: list[Remaining],
    learnt: list[LearntRemoval | None],
    plans: list[GrindingPlan | None],
) -> list[dict[str, Any]]:
    """What report.json says of the pieces."""
    from grindvision.cli.grind import piece_facts, plan_facts

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


def _learnt(job: GrindingJob, pieces: tuple[StockPiece, ...]) -> list[LearntRemoval | None]:
    """Preston's coefficient from each piece that was ground; None, with a warning, where it cannot be told."""
    import numpy as np

    from grindvision.motion.removal import learn_removal

    found: list[LearntRemoval | None] = []
    for number, (plan, before, piece) in enumerate(zip(job.plans, job.sigma_mm, pieces, strict=True), start=1):
        if plan is None or not plan.passes:
            found.append(None)
            continue
        noise = piece.datum.noise.covariance_mm2
        alike = 1.0 + float((2 * np.pi * np.arange(len(noise)) * np.clip(noise / max(noise[0], 1e-18), 0, 1)).sum())
        after = np.where(piece.inside & ~piece.hidden, piece.map.heights_mm, np.nan)
        common = float(np.sqrt(2 * piece.datum.variances_mm2[piece.inside].mean()))
        try:
            found.append(learn_removal(plan, after, np.hypot(before, piece.sigma_mm), alike, common))
        except InputError as error:
            warnings.warn(f"piece {number}: {error}", GrindvisionWarning, stacklevel=1)
            found.append(None)
    return found


def _with_learnt(job: GrindingJob, learnt: list[LearntRemoval | None]) -> Any:
    """The job's options with the coefficient that the surest piece told."""
    told = [one for one in learnt if one is not None and not one.at_least]
    if not told:
        return job.options
    return replace(job.options, k_mm2_n=min(told, key=lambda one: one.k_sigma_mm2_n / one.k_mm2_n).k_mm2_n)


def _judged(pieces: tuple[StockPiece, ...], tolerance_mm: float) -> list[Remaining]:
    from grindvision.vision.change.remaining import judge_remaining

    return [judge_remaining(piece, tolerance_mm) for piece in pieces]


def _plans(
    job: GrindingJob, pieces: tuple[StockPiece, ...], judged: list[Remaining], settings: Any
) -> list[GrindingPlan | None]:
    """Passes for what still stands above the tolerance."""
    from grindvision.grinding import workpiece
    from grindvision.motion.grinding import plan_grinding

    plans: list[GrindingPlan | None] = []
    for number, (old, piece, verdict) in enumerate(zip(job.plans, pieces, judged, strict=True), start=1):
        plans.append(None)
        if verdict.over_mm2 == 0:
            continue
        work = workpiece(piece)
        if old is not None:
            work = replace(work, keep=old.work.keep, course_mm=old.work.course_mm)
        try:
            plans[-1] = plan_grinding(work, settings)
        except InputError as error:
            warnings.warn(f"the rest of piece {number} is not ground: {error}", GrindvisionWarning, stacklevel=1)
    return plans


def _message(judged: list[Remaining], learnt: list[LearntRemoval | None], tolerance_mm: float | None) -> str:
    met = sum(one.met for one in judged)
    told = next((str(one) for one in learnt if one is not None), "")
    asked = f"tolerance of {tolerance_mm:g} mm" if tolerance_mm is not None else "twice the level of detection"
    verdict = "met" if met == len(judged) else "not met"
    return f"{asked} {verdict}: {met} of {len(judged)} piece(s); {judged[0]}{'; ' if told else ''}{told}"
