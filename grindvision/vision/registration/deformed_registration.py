"""Registration of a part that is deformed against its good one: where no rigid pose fits, pose and field together.

The rigid registration goes first, and what it accepts stays as it is. What it refuses as no fit may be a bent part, or
another one; a field is flexible enough to bring nearly anything near. So it counts only where it leaves little of the
difference, stretches the part little, and both scans then agree wherever both scanners could see, as those of one part
do; and where no other pose does as well with a field of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import AmbiguousError, DegenerateError, InputError, UnitError
from grindvision.geometry import inverse, move_points
from grindvision.geometry.hash_grid import build_cells, random_order
from grindvision.models import Model
from grindvision.records import by_content
from grindvision.vision.registration.agreement import Agreement
from grindvision.vision.registration.deformation import Deformation
from grindvision.vision.registration.deformation_fit import DeformationFit, fit_deformation
from grindvision.vision.registration.field_misfit import FieldMisfit, field_misfit
from grindvision.vision.registration.free_surface import UNRESISTED
from grindvision.vision.registration.model_registration import model_at_pose, register_to_model
from grindvision.vision.registration.pair_diagnostics import PairNames
from grindvision.vision.registration.pose_candidates import Candidate, PoseJudge
from grindvision.vision.registration.rivals import weak_motions, with_rivals
from grindvision.vision.registration.scan_registration import (
    Registration,
    StageClock,
    Viewpoints,
    propose,
    register_pair,
)
from grindvision.vision.registration.verification import MIN_OVERLAP, VerifiedPose
from grindvision.vision.surface.model_surface import ModelSurface, model_surface, whole_scan
from grindvision.vision.surface.scan import Scan, choose_resolution, prepare_pair, prepare_scan
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SURFELS = 4000
"""So many surfels of the test scan tell the field."""

TRIED = 3
"""So many distinct poses are tried with a field of their own."""

MIN_EXPLAINED = 0.8
"""Least fraction of the squared difference that a deformation takes up; another part leaves more."""

MIN_AGREEMENT = 0.75
"""Least fraction of what both scanners could see that agrees with the field."""

MIN_BETTER, NEARER = 0.3, 1.5
"""Least gain over a rigid pose of the fraction of the surface within so many standard deviations of what the field
leaves: where most of a part agrees rigidly, the rest is not bent."""

MAX_SPREAD = 0.006
"""Largest standard deviation of what the field leaves, as a fraction of the part's half-length."""

MAX_STRETCH = 0.15
"""Largest change of the volume anywhere on the part: metal that is bent keeps it nearly."""

MAX_SIZE = 0.08
"""Largest displacement as a fraction of the part's half-length."""

CLEARLY = 1.5
"""Another pose with a field of its own is ruled out where it leaves so many times the spread."""

MAX_HARD = 0.02
"""Share of surfels in front of what the other scanner saw, or in its holes, from which a rigid pose is refused, too: a
field brings the surfaces together wherever they lie, and no farther."""

HALF, NEARLY_ALL = 0.5, 0.9
"""Fractions of the common surface in agreement that count for nothing and for all of the confidence."""

WITHIN = 0.03
"""Surfaces that are nearer to each other than this part of the test scan's extent count as the same while poses are
sought: so much a part may be bent."""

SPREADS = 3.0
"""Surfaces that are nearer to each other than so many standard deviations of what the field leaves agree."""


@by_content
@dataclass(frozen=True)
class DeformedPart:
    """How a test part is deformed against the sample, frame of the test scan.

    ``field``: where its points lay on the unbent part, less the pose, which is the best rigid fit; at its surfels
    ``points`` (N, 3) how far ``sizes_mm`` (N,) the part is displaced along its outward normal, and the standard
    deviation ``sigma_mm`` (N,) of the bent surface, by the field and by the ``misfit`` that it leaves. ``explained``:
    fraction of the squared difference after a rigid registration that the field takes up, ``left_mm`` the standard
    deviation of what it leaves; ``held_out_mm``: that over blocks of surface left out of the fit, by order of the
    field, 0 for none.
    """

    field: Deformation
    points: Floats
    sizes_mm: Floats
    sigma_mm: Floats
    explained: float
    left_mm: float
    held_out_mm: dict[int, float]
    misfit: FieldMisfit

    @property
    def max_mm(self) -> float:
        """Largest displacement along the normal."""
        return float(np.abs(self.sizes_mm).max())

    @property
    def rms_mm(self) -> float:
        """Root of its mean square."""
        return float(np.sqrt((self.sizes_mm**2).mean()))

    @property
    def max_at_mm(self) -> Floats:
        """Where (3,) it is largest."""
        return np.asarray(self.points[int(np.argmax(np.abs(self.sizes_mm)))])

    def place_variances(self, points: Floats, normals: Floats) -> Floats:
        """Variances (N,) in mm2 of the bent surface along normals (N, 3) at points (N, 3), by the field and by what it
        leaves there more than elsewhere."""
        return self.field.variances(points, normals) + self.misfit.beyond_usual(points)

    def facts(self) -> dict[str, object]:
        """Size, place and certainty as numbers, for a report."""
        return {
            "max_mm": self.max_mm,
            "max_at_mm": self.max_at_mm,
            "rms_mm": self.rms_mm,
            "sigma_mm": float(np.median(self.sigma_mm)),
            "explained": self.explained,
            "left_mm": self.left_mm,
            "order": self.field.order,
            "held_out_mm": {str(order): spread for order, spread in self.held_out_mm.items()},
        }

    def diagnose(self) -> tuple[str, ...]:
        """In words, that the part is deformed, and what that means for what stands out."""
        return (
            f"the part is {self}: what stands out is measured above the sample bent like it, whose surface is known to"
            f" {np.median(self.sigma_mm):.2g} mm (one standard deviation); no rigid pose fits",
        )

    def __str__(self) -> str:
        x, y, z = self.max_at_mm
        return (
            f"deformed against the sample by up to {self.max_mm:.2g} mm, about ({x:.0f}, {y:.0f}, {z:.0f}) mm, and"
            f" {self.rms_mm:.2g} mm rms; a smooth field of order {self.field.order} explains {self.explained:.0%} of"
            f" the difference and leaves {self.left_mm:.2g} mm"
        )


@dataclass(frozen=True, eq=False)
class DeformedRegistration:
    """A ``registration`` whose target is the sample bent as the test part is, and how that is ``deformed``; None where
    the parts agree by a rigid pose, with the target as it is. ``surface``: of the model, where the sample is one."""

    registration: Registration
    deformed: DeformedPart | None
    surface: ModelSurface | None


def register_deformed(
    source: ArrayLike,
    target: ArrayLike | Model,
    viewpoints_mm: Viewpoints,
    rng: np.random.Generator,
    clock: StageClock,
    names: PairNames,
) -> DeformedRegistration:
    """Register a scan (N, 3) with another one (M, 3) or a model; where no rigid pose fits, by pose and field.

    Args:
        viewpoints_mm: the scanners of source and target, that of a model is left aside.

    Raises:
        InputError, DegenerateError, AmbiguousError: as ``register_pair`` and ``register_to_model``, where no
            deformation explains the difference.
    """
    try:
        if isinstance(target, Model):
            to_model = register_to_model(source, target, viewpoints_mm[0], rng, clock, names)
            return DeformedRegistration(to_model.registration, None, to_model.surface)
        return DeformedRegistration(register_pair(source, target, viewpoints_mm, rng, clock, names), None, None)
    except AmbiguousError:
        raise
    except (DegenerateError, InputError) as refusal:  # a mirror image may be the nearest rigid fit of a bent part
        if isinstance(refusal, UnitError):
            raise
        try:
            return _by_field(np.asarray(source, dtype=float), target, viewpoints_mm, rng.spawn(1)[0], clock)
        except DegenerateError as no_field:
            if not isinstance(refusal, DegenerateError):
                raise refusal from None
            raise type(refusal)(f"{refusal}; nor is it one smoothly deformed part: {no_field}") from None


def _by_field(
    source: Floats, target: ArrayLike | Model, viewpoints_mm: Viewpoints, rng: np.random.Generator, clock: StageClock
) -> DeformedRegistration:
    """Pose and field of a pair that no rigid pose brings together.

    Raises:
        DegenerateError: another part, by what is said at the top.
    """
    proposing, judging, choosing = rng.spawn(3)
    surface: ModelSurface | None = None
    if isinstance(target, Model):
        surface = model_surface(target.vertices, target.triangles)
        resolution = choose_resolution(source)
        good = whole_scan(surface, resolution)
        scan = prepare_scan(source, resolution, viewpoints_mm[0])
    else:
        scan, good = prepare_pair(source, np.asarray(target, dtype=float), viewpoints_mm)
    scan, poses = propose(scan, good, proposing)
    judge = PoseJudge(scan, good, judging, SURFELS)
    judge.within_mm = max(judge.within_mm, WITHIN * judge.extent)
    candidates = judge.settled(judge.refined_all(poses))
    if not candidates:
        raise DegenerateError("no pose brings the two near each other")
    candidates = judge.ranked(with_rivals(judge, candidates[0], candidates))[:TRIED]
    if weak_motions(judge, candidates[0], UNRESISTED).size:
        raise DegenerateError("nothing fixes the part where it can slide, and its deformation would not be known")
    chosen = np.sort(random_order(scan.surfels.grid.keys, choosing)[:SURFELS])
    fits = _fits(scan, good, candidates, chosen)
    best = fits[0]
    rivals = [fit for fit in fits if judge.differ(fit.registration.T_target_source, best.registration.T_target_source)]
    if surface is not None:
        shown = model_at_pose(scan, good, surface, resolution, best.registration.T_target_source)
        best, good = _fits(scan, shown, [Candidate(best.registration, 0.0)], chosen)[0], shown
    bent = bent_scan(good, best.registration.T_target_source, best.field)
    found = _checked(best, scan, bent, judging.spawn(1)[0])
    ratio = min((other.spread_mm / best.spread_mm for other in rivals), default=np.inf)
    if ratio < CLEARLY:
        raise DegenerateError(f"another pose fits nearly as well with a deformation of its own ({ratio:.2f} times off)")
    verified = VerifiedPose(best.registration, found, Agreement(0.0, 0.0), _confidence(found, ratio))
    clock.lap("icp")
    normals = scan.surfels.normals[chosen]
    sizes = -(best.field.displacements(best.points) * normals).sum(axis=1)
    misfit = field_misfit(best.points, best.after_mm, best.field.scale_mm / best.field.order)
    sigma = np.sqrt(best.field.variances(best.points, normals) + misfit.variances(best.points))
    deformed = DeformedPart(
        best.field, best.points, sizes, sigma, best.explained, best.spread_mm, best.held_out_mm, misfit
    )
    registration = Registration(scan, bent, verified, best.registration, clock.laps_s)
    return DeformedRegistration(registration, deformed, surface)


def _confidence(found: Agreement, ratio: float) -> float:
    """A mark from 0 to 1 for the agreement and for how clearly (``ratio`` of the spreads) the next pose is ruled out:
    no probability, as rigid poses have it, since no error model says how parts are deformed."""
    agreeing = float(np.clip((found.fraction_of_overlap - HALF) / (NEARLY_ALL - HALF), 0, 1))
    return agreeing * (1 - 0.5 * (CLEARLY / ratio) ** 2)


def _fits(scan: Scan, good: Scan, candidates: Sequence[Candidate], chosen: Integers) -> list[DeformationFit]:
    """Pose and field from each of several poses, the one that leaves least first.

    Raises:
        DegenerateError: none of them can be fitted.
    """
    points, normals = scan.surfels.points[chosen], scan.surfels.normals[chosen]
    found, refusals = [], []
    for one in candidates:
        try:
            found.append(fit_deformation(points, normals, good.surfels, one.found))
        except DegenerateError as refusal:
            refusals.append(refusal)
    if not found:
        raise refusals[0]
    return sorted(found, key=lambda fit: fit.spread_mm)


def _checked(fit: DeformationFit, scan: Scan, bent: Scan, rng: np.random.Generator) -> Agreement:
    """Agreement of the scan with the good part bent as the field says.

    Raises:
        DegenerateError: the two are another part, or the field folds or tears it.
    """
    half = fit.field.scale_mm
    # less the motion nearest to it, so that it counts for nothing how far the best rigid fit slides along the surface
    bending = fit.field.less_motion(fit.field.nearest_motion(fit.points)).displacements(fit.points)
    largest = float(np.linalg.norm(bending, axis=1).max())
    if fit.order == 0:
        raise DegenerateError("no field predicts surface that it was not fitted to better than a rigid pose")
    if largest > MAX_SIZE * half:
        raise DegenerateError(
            f"it would have to be deformed by {largest:.3g} mm, {largest / half:.0%} of its half-length"
        )
    stretch = float(np.abs(fit.field.stretches(fit.points) - 1).max())
    if stretch > MAX_STRETCH:
        raise DegenerateError(f"it would have to be stretched or folded, its volume changing by {stretch:.0%}")
    rigid, with_field = (np.mean(np.abs(left) < NEARER * fit.spread_mm) for left in (fit.before_mm, fit.after_mm))
    if with_field - rigid < MIN_BETTER:
        raise DegenerateError(
            f"{rigid:.0%} of the surface agrees at a rigid pose, and only {with_field:.0%} with a field"
        )
    if fit.explained < MIN_EXPLAINED or fit.spread_mm > MAX_SPREAD * half:
        raise DegenerateError(
            f"the best smooth field explains {fit.explained:.0%} of the difference and leaves {fit.spread_mm:.2g} mm"
        )
    judge = PoseJudge(scan, bent, rng, SURFELS)
    judge.within_mm = max(judge.within_mm, SPREADS * fit.spread_mm)
    found = judge.agreement(fit.registration.T_target_source)
    if found.overlap < MIN_OVERLAP or found.fraction_of_overlap < MIN_AGREEMENT:
        raise DegenerateError(f"with the best smooth field {found} within {judge.within_mm:.2g} mm")
    hard = judge.evidence(fit.registration.T_target_source, None).hard
    if hard > MAX_HARD:
        raise DegenerateError(f"with the best smooth field {hard:.1%} would stand in front of what the other shows")
    return found


def bent_scan(scan: Scan, T_target_source: Floats, field: Deformation) -> Scan:
    """The target scan bent as a field in the frame of the source says, so that the source lies on it rigidly.

    Raises:
        DegenerateError: the field folds its surface.
    """
    back = inverse(T_target_source)

    def moved(points: Floats) -> Floats:
        return move_points(T_target_source, field.bent(move_points(back, points)))

    def surfels(one: Surfels) -> Surfels:
        places = field.bent(move_points(back, one.points))
        # a normal is square to tangents, which the gradient of p + v(p) takes to the unbent part
        along = (np.eye(3) + field.gradients(places)).transpose(0, 2, 1) @ (one.normals @ back[:3, :3].T)[..., None]
        lengths = np.linalg.norm(along[..., 0], axis=1, keepdims=True)
        normals = along[..., 0] / np.where(lengths > 0, lengths, 1.0) @ T_target_source[:3, :3].T
        grid = build_cells(move_points(T_target_source, places), one.grid.size_mm)
        return replace(one, grid=grid, normals=normals)

    return replace(
        scan, points=moved(scan.points), surfels=surfels(scan.surfels), voxels=surfels(scan.voxels), bent=True
    )
