"""Registration of a scan with a model: the pose is sought on its whole surface, then refined on what the scanner saw.

A closed model has a back. Where both are compared as clouds, the back is nearer than the front wherever the pose is a
little off, and half of the model lies where the scan shows nothing. Here the facets tell the outside, and rays from
the scanner's place which of them it could see at the pose that was found.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import AmbiguousError, DegenerateError, InputError, UnitError
from grindvision.geometry import check_points, move_points
from grindvision.geometry.bounds import bounds
from grindvision.models import Model
from grindvision.vision.registration.layered_scans import allow_for_layers
from grindvision.vision.registration.pair_diagnostics import MAX_SIZE_RATIO, PairNames
from grindvision.vision.registration.pose_findings import LEFT_HANDED, warn_of_findings
from grindvision.vision.registration.rim_fit import hold_by_rims
from grindvision.vision.registration.scan_registration import (
    CERTAIN,
    MIN_POINTS,
    Registration,
    StageClock,
    propose,
    refine,
    without_strays,
)
from grindvision.vision.registration.verification import VerifiedPose, choose_pose
from grindvision.vision.surface.facets import Facets
from grindvision.vision.surface.model_surface import ModelSurface, model_surface, scan_seen_from, whole_scan
from grindvision.vision.surface.normals import seen_along
from grindvision.vision.surface.scan import Resolution, Scan, choose_resolution, prepare_scan

Floats = NDArray[np.float64]

UNITS_MM = {"cm": 10.0, "in": 25.4, "m": 1000.0}

FITS = (0.1, 1.15)
"""A scan of one part is between these fractions of its model's size, wherever the two are in one unit."""

MUCH_LARGER = 2.0
"""A scan with its surroundings may well be so many times larger than the model."""


MAX_FLIPPED_FRACTION = 1e-4
"""Fraction of a model's area that was wound inside out from which on a person should know; slivers are not told."""


@dataclass(frozen=True, eq=False)
class ModelRegistration:
    """Result of ``register_to_model``: the ``registration``, whose target is the model as the scanner saw it, and the
    ``surface`` of the whole model."""

    registration: Registration
    surface: ModelSurface

    def __str__(self) -> str:
        return f"{self.registration}; model: {self.surface}"


def register_to_model(
    source: ArrayLike,
    model: Model,
    viewpoint_mm: ArrayLike | None,
    rng: np.random.Generator,
    clock: StageClock,
    names: PairNames,
) -> ModelRegistration:
    """Find the pose that brings a scan (N, 3) in mm onto a model of the part; as ``register_pair`` otherwise.

    Args:
        viewpoint_mm: the scanner (3,) in the frame of the source; guessed when left out.

    Raises:
        InputError, DegenerateError, AmbiguousError: as ``register_pair``. UnitError: the scan and the model differ in
            size as units do.
    """
    source = without_strays(check_points(source, f"{names.source} points", MIN_POINTS), names.source)
    surface = model_surface(model.vertices, model.triangles)
    check_unit_of_model(source, surface, names)
    resolution = choose_resolution(source)
    whole = whole_scan(surface, resolution)
    try:
        prepared, coarse = _first_alignment(source, whole, resolution, viewpoint_mm, rng, clock)
    except DegenerateError as refusal:
        if not isinstance(refusal, AmbiguousError) and _fits_mirrored(source, whole, resolution, viewpoint_mm, rng):
            raise InputError(
                f"no pose was found in which the {names.source} scan fits the {names.target} model as it is, but one in"
                f" which its mirror image does: if one of the two was {LEFT_HANDED}, export it again, or say"
                " --mirrored; or does the scan show the mirrored twin of the part?"
            ) from None
        if question := other_unit(*_sizes(source, surface), names):
            raise type(refusal)(f"{refusal}; {question}") from None
        raise
    clock.lap("verification")
    draws = rng.spawn(1)[0]
    target = model_at_pose(prepared, whole, surface, resolution, coarse.registration.T_target_source)
    fine = refine(prepared, target, coarse, draws)
    fine, held = hold_by_rims(prepared, target, fine, coarse.registration.T_target_source)
    warn_of_findings(prepared, coarse, fine, names, held)
    fine = allow_for_layers(fine, {names.source: prepared})
    clock.lap("icp")
    return ModelRegistration(Registration(prepared, target, coarse, fine, clock.laps_s), surface)


def model_at_pose(
    source: Scan, whole: Scan, surface: ModelSurface, resolution: Resolution, T_target_source: Floats
) -> Scan:
    """What the source's scanner could see of a model at a pose (4, 4), all of it where the scanner's place is not
    known."""
    eye = _eye(source, T_target_source)
    return whole if eye is None else scan_seen_from(surface, resolution, eye)


def check_unit_of_model(source: Floats, surface: ModelSurface, names: PairNames) -> None:
    """Refuse a scan (N, 3) that is many times larger or smaller than the model of its part.

    Raises:
        UnitError: it is; the units by which the two would fit are named.
    """
    scan, model = _sizes(source, surface)
    if 1 / MAX_SIZE_RATIO <= scan / model <= MAX_SIZE_RATIO:
        return
    raise UnitError(
        f"the {names.source} is {scan:.4g} mm across, the {names.target} model {model:.4g} mm:"
        f" {other_unit(scan, model, names) or 'one of the files has another unit, or shows more than the part'};"
        " export both in one unit, cropped to the part"
    )


def other_unit(scan_mm: float, model_mm: float, names: PairNames) -> str:
    """In words, by which units of one of the two files a scan and a model of such sizes would fit; empty where none
    does or they fit as they are."""
    ratio = scan_mm / model_mm
    if FITS[0] <= ratio <= MUCH_LARGER:
        return ""
    option, name, small = ("--sample-unit", names.target, model_mm) if ratio > 1 else ("--unit", names.source, scan_mm)
    fitting = [unit for unit, scale in UNITS_MM.items() if FITS[0] <= ratio * scale ** np.sign(1 - ratio) <= FITS[1]]
    if not fitting:
        return ""
    sizes = " or ".join(f"{unit} ({small * UNITS_MM[unit]:.4g} mm across then)" for unit in fitting)
    return f"are the numbers of the {name} in {sizes}? Then say {option} {fitting[0]}"


def diagnose_model(facets: Facets) -> tuple[str, ...]:
    """In words, what of a model's mesh a person should know of before trusting the comparison."""
    said = []
    if facets.turned == len(facets):
        said.append(
            f"all {len(facets):,} facets of the model were wound inside out and were turned; if it was exported"
            " left-handed, its shape is a mirror image: then say --mirrored with the axis that counts the wrong way"
        )
    elif facets.flipped_mm2 > MAX_FLIPPED_FRACTION * facets.area_mm2:
        said.append(
            f"{facets.turned:,} of the model's {len(facets):,} facets were wound inside out, against their neighbours"
            " or into the part, and were turned; mend the export if these are not slips of the mesh"
        )
    if not facets.sided:
        said.append(
            "the model is open and does not tell which side of it is outside; the side on which the test scan fits was"
            " taken"
        )
    return tuple(said)


def _sizes(source: Floats, surface: ModelSurface) -> tuple[float, float]:
    """Diagonals in mm of the scan (N, 3) and of the model."""
    return float(np.linalg.norm(np.subtract(*bounds(np.ascontiguousarray(source))))), surface.facets.diagonal_mm


def _first_alignment(
    source: Floats,
    whole: Scan,
    resolution: Resolution,
    viewpoint_mm: ArrayLike | None,
    rng: np.random.Generator,
    clock: StageClock,
    insist: bool = True,
) -> tuple[Scan, VerifiedPose]:
    """The scan made ready, and its verified pose on the whole model; ``insist``: see ``choose_pose``."""
    prepared = prepare_scan(source, resolution, viewpoint_mm)
    clock.lap("features")
    proposing, choosing = rng.spawn(2)
    prepared, poses = propose(prepared, whole, proposing)
    clock.lap("coarse")
    return prepared, choose_pose(prepared, whole, poses, choosing, insist=insist)


def _fits_mirrored(
    source: Floats, whole: Scan, resolution: Resolution, viewpoint_mm: ArrayLike | None, rng: np.random.Generator
) -> bool:
    """Whether the mirror image of the source (N, 3) fits the model, and not by chance."""
    mirror = np.array([1.0, -1.0, 1.0])
    eye = None if viewpoint_mm is None else np.asarray(viewpoint_mm, dtype=float) * mirror
    try:
        _, pose = _first_alignment(source * mirror, whole, resolution, eye, rng, StageClock(), insist=False)
    except DegenerateError:
        return False
    return pose.confidence >= CERTAIN


def _eye(source: Scan, T_target_source: Floats) -> Floats | None:
    """Where the source's scanner stood (3,), in the target's frame: far off in the direction from which the source can
    be seen at one glance, where the place is not known; None where there is none."""
    if source.viewpoint_mm is not None:
        return move_points(T_target_source, source.viewpoint_mm)
    voxels = source.voxels
    direction = seen_along(voxels.points, voxels.normals, 2.5 * voxels.grid.size_mm)
    if direction is None:
        return None
    if (voxels.normals @ direction).sum() < 0:
        direction = -direction
    far = 20 * float(np.linalg.norm(np.ptp(voxels.points, axis=0)))
    return move_points(T_target_source, voxels.points.mean(axis=0) + far * direction)
