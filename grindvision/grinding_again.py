"""From a scan after the passes to a verdict, to what process and wheel really do, and to the passes of the rest.

A wheel that was not touched off runs higher or lower than it is sent, as scanner, hand-eye and arm err together. No
difference of two scans shows that, but the surface that the wheel has cut does: it is learnt here with Preston's
coefficient, and the rest is planned with it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import GrindvisionWarning, InputError
from grindvision.geometry import inverse, move_points, rotate_vectors
from grindvision.grinding import GrindOptions, against_grinding, without_stock, workpiece
from grindvision.grinding_elsewhere import found_elsewhere
from grindvision.grinding_files import GrindingJob
from grindvision.models import Model
from grindvision.motion.grinding import GrindingPlan, plan_grinding
from grindvision.motion.grinding_beside import check_beside, with_free_leads
from grindvision.motion.grinding_options import GrindingOptions
from grindvision.motion.removal import LearntRemoval, learn_removal
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.comparison import Comparison, compare
from grindvision.vision.change.coverage import same_scan
from grindvision.vision.change.remaining import Remaining, judge_remaining
from grindvision.vision.change.stock import StockPiece, measure_again
from grindvision.vision.registration.scan_registration import StageClock
from grindvision.words import counted

Floats = NDArray[np.float64]

STOOD_MM = 1.0
"""A scanner that is no farther from where it stood before errs as it did there."""


@by_content
@dataclass(frozen=True)
class GrindAgainOptions:
    """Settings of ``grind_again``: how the new scan is compared (``compare``; its passes are not used), the
    ``tolerance_mm`` (left out: twice the level of detection), ``passes`` for the rest (left out: the job's, with the
    coefficient that was learnt), ``T_base_scanner`` (4, 4) of the new scan, where it is known."""

    compare: GrindOptions = field(default_factory=GrindOptions)
    tolerance_mm: float | None = None
    passes: Callable[[GrindingOptions], GrindingOptions] = lambda settings: settings
    T_base_scanner: ArrayLike | None = None


@by_content
@dataclass(frozen=True)
class GroundAgain:
    """Result of ``grind_again``, in the frame of the new scan, piece by piece of the job: what stands there now
    (``pieces``), the verdicts against ``tolerance_mm``, what was ``learnt`` (None where nothing could be), and the
    ``plans`` for the rest (None where there is none); ``passes`` are the settings they were made with."""

    compared: Comparison
    pieces: tuple[StockPiece, ...]
    judged: tuple[Remaining, ...]
    learnt: tuple[LearntRemoval | None, ...]
    plans: tuple[GrindingPlan | None, ...]
    passes: GrindingOptions
    tolerance_mm: float
    timings_s: dict[str, float] = field(compare=False)

    @property
    def met(self) -> bool:
        """Whether the tolerance is met everywhere."""
        return all(one.met for one in self.judged)

    def __str__(self) -> str:
        met = sum(one.met for one in self.judged)
        told = next((f"; {one}" for one in self.learnt if one is not None), "")
        return (
            f"{'met' if self.met else 'not met'}: {met} of {counted(len(self.judged), 'piece')}; {self.judged[0]}{told}"
        )


@one_blas_thread()
def grind_again(
    job: GrindingJob,
    sample: ArrayLike | Model,
    new: ArrayLike,
    options: GrindAgainOptions | None = None,
    finished: Callable[[str], None] | None = None,
) -> GroundAgain:
    """Judge a scan made after a job's passes, learn from it, and plan the rest.

    Args:
        job: what was planned and driven.
        sample: the good scan, points (N, 3) in mm, or the model, that the job was planned with.
        new: scan of the ground part, points (M, 3) in mm in its own scanner's frame.
        options: tolerance, passes of the rest, pose of the scanner; see ``GrindAgainOptions``.
        finished: is told the name of each stage when it is done.

    Raises:
        InputError, DegenerateError: as ``grind``; the tolerance is not above zero, or below the level of detection; the
            new scan is the good one.

    Warns:
        GrindvisionWarning: something speaks against the comparison; a piece of which nothing is learnt, or whose rest
            cannot be ground; a scanner that moved and whose pose is not known.
    """
    options = GrindAgainOptions() if options is None else options
    if job.sample.get("skin_mm") is not None:
        raise InputError(
            f"this job takes a skin of {job.sample['skin_mm']:g} mm off the surface as it lay, which the good scan does"
            " not show: compare the scans before and after with `grindvision detect AFTER BEFORE`"
        )
    clock = StageClock(finished)
    compared = compare(sample, new, options.compare, clock)
    for sentence in against_grinding(compared):
        warnings.warn(sentence, GrindvisionWarning, stacklevel=2)
    found = compared.registration
    if same_scan(found.source, found.target, found.fine):
        raise InputError("the new scan is the good scan itself, point by point; give the scan made after the passes")
    T_new_test = inverse(found.T_target_source) @ job.T_sample_test
    pieces = measure_again(found.source, found.target, found.fine, compared.difference, job.places, T_new_test)
    clock.lap("stock")
    learnt = _learnt(job, pieces)
    tolerance_mm = options.tolerance_mm or 2 * pieces[0].level_mm
    judged = tuple(judge_remaining(piece, tolerance_mm) for piece in pieces)
    for sentence in found_elsewhere(compared, pieces, tolerance_mm):
        warnings.warn(sentence, GrindvisionWarning, stacklevel=2)
    passes = options.passes(_with_learnt(job, learnt))
    plans = list[GrindingPlan | None]()
    for number, (piece, old, told, verdict) in enumerate(zip(pieces, job.plans, learnt, judged, strict=True), start=1):
        plans.append(None)
        if verdict.over_mm2 == 0:
            continue
        work = workpiece(piece)
        if old is not None:
            offset, sigma = _offset(job, old, told, piece, T_new_test, options.T_base_scanner)
            work = replace(work, keep=old.work.keep, centreline_mm=old.work.centreline_mm)
            work = replace(work, offset_mm=offset, offset_sigma_mm=sigma)
        try:
            plan = plan_grinding(work, passes)
            beside = without_stock(new, compared.difference)
            check_beside(plan, beside)
            plans[-1] = with_free_leads(plan, beside)
        except InputError as error:
            warnings.warn(f"the rest of piece {number} is not ground: {error}", GrindvisionWarning, stacklevel=2)
    clock.lap("passes")
    return GroundAgain(compared, pieces, judged, learnt, tuple(plans), passes, tolerance_mm, clock.laps_s)


def _learnt(job: GrindingJob, pieces: tuple[StockPiece, ...]) -> tuple[LearntRemoval | None, ...]:
    """What each piece that was ground tells; None, with a warning, where it tells nothing."""
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
            warnings.warn(f"piece {number}: {error}", GrindvisionWarning, stacklevel=3)
            found.append(None)
            continue
        if plan.work.offset_sigma_mm == 0 and (told := found[-1]) is not None and told.refuted:
            warnings.warn(
                f"piece {number}: the wheel ran {abs(told.offset_mm):.2f} +- {told.offset_sigma_mm:.2g} mm"
                f" {'higher' if told.offset_mm > 0 else 'lower'} than where it was touched off: worn, bent aside or"
                " touched off elsewhere; touch it off again before the rest, or give --place-sigma for a new job",
                GrindvisionWarning,
                stacklevel=3,
            )
    return tuple(found)


def _with_learnt(job: GrindingJob, learnt: tuple[LearntRemoval | None, ...]) -> GrindingOptions:
    """The job's options with the coefficient that the surest piece told."""
    told = [one for one in learnt if one is not None and not one.at_least]
    if not told:
        return job.options
    return replace(job.options, k_mm2_n=min(told, key=lambda one: one.k_sigma_mm2_n / one.k_mm2_n).k_mm2_n)


def _offset(
    job: GrindingJob,
    old: GrindingPlan,
    told: LearntRemoval | None,
    piece: StockPiece,
    T_new_test: Floats,
    T_base_scanner: ArrayLike | None,
) -> tuple[float, float]:
    """The wheel's offset over the surface as the new scan shows it, and its standard deviation.

    The new scan shows the same surface elsewhere in the base, as the scanner errs otherwise from another place: where
    both poses are known, by so much the offset differs.
    """
    if old.work.offset_sigma_mm == 0:
        return old.work.offset_mm, 0.0
    offset, sigma = old.work.offset_mm, old.work.offset_sigma_mm
    if told is not None:
        offset, sigma = offset + told.offset_mm, told.offset_sigma_mm
    if job.T_base_scanner is not None and T_base_scanner is not None:
        inside = piece.inside & piece.map.shown
        T_base_before = np.asarray(job.T_base_scanner, dtype=float) @ old.work.heights.T_scan_map
        T_base_now = np.asarray(T_base_scanner, dtype=float) @ piece.map.T_scan_map
        normals = rotate_vectors(T_base_before, piece.map.normals[inside])
        before = move_points(T_base_before, old.work.heights.feet_mm[inside])
        now = move_points(T_base_now, piece.map.feet_mm[inside])
        return offset + float(((now - before) * normals).sum(axis=1).mean()), sigma
    if np.linalg.norm(T_new_test[:3, 3]) > STOOD_MM:
        warnings.warn(
            f"the scanner stands {np.linalg.norm(T_new_test[:3, 3]):.1f} mm from where it stood before, and where it"
            " errs otherwise from there the wheel's learnt offset does not hold; give --scanner-pose in both runs, or"
            " touch the wheel off",
            GrindvisionWarning,
            stacklevel=3,
        )
        sigma = float(np.hypot(sigma, old.work.offset_sigma_mm))
    return offset, sigma
