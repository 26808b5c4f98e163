"""The pose by the rims of faces, where planes and curvature leave a motion hardly known.

Sheets, plates and shafts show where they lie along themselves by their outline, their holes and their steps, which
point-to-plane ICP does not see. What ICP knows is the prior, with its covariance; the rims that both scans show say the
rest. A rim may also be where a scanner saw no farther: such rims agree with nothing, or with too few.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import motion_columns, move_points, rigid, rotate_vectors, small_motion
from grindvision.geometry.hash_grid import CellGrid, build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.kernels import njit
from grindvision.vision.registration.deformable import BLOCKS_ACROSS, TUKEY
from grindvision.vision.registration.free_motions import (
    HARDLY_KNOWN,
    motion_name,
    rms_extent,
    spread_out,
    weakest_motion,
)
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.registration.plane_icp import MIN_FACING, NORMAL_NOISE
from grindvision.vision.surface.rims import REACH_SPACINGS, Rims, find_rims, point_spacing
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.signed_distance import signed_distances

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

SAME_FACE, SAME_WAY = 0.9, 0.85
"""Rims may be the same where their normals and their directions make at most the angles of these cosines."""

REACH_SIGMAS = 2.5
"""Rims are sought within so many standard deviations of the pose by the planes."""

SHRINKS = 0.9
"""The reach becomes smaller by this factor with each step, down to ``REACH_SPACINGS``."""

FARTHEST = 0.08
"""A verified pose is off by no more than this fraction of the extent: poses all along a motion that hardly anything
resists were judged in steps of three quarters of it."""

MIN_MATCHES, MIN_AGREEING = 60, 0.2
"""Fewer matched rim points, or a smaller part of all within a spacing of each other, say nothing."""

MAX_WORSE, SAME_SURFACE = 2.0, 0.1
"""Where rims are right, planes hardly resist: their residuals' spread grows by no more than this factor, or is within
that part of a cell, as a quarter of a spacing makes it on slopes."""

STEPS = 60

ALIKE = 3.0
"""So many neighbouring rim points err alike and count as one."""

FLOOR = 0.2
"""A rim is known to no less than this part of the spacing: within it, its points lie where the pixels happen to."""


INSET = 0.25
"""How deep the outermost points lie within their rims differs from side to side by so much of the spacing, as each is
seen at its own slant: that looks like a translation and shows in no residual."""


@dataclass(frozen=True, eq=False)
class _Matched:
    """Matched rim points: ``places`` (K, 3) of the source in the target's frame, ``ways`` (K, 3) across the rims, and
    ``residuals`` (K,) along these."""

    places: Floats
    ways: Floats
    residuals: Floats


def hold_by_rims(source: Scan, target: Scan, found: FineRegistration, verified: Floats) -> tuple[FineRegistration, str]:
    """``refine_by_rims`` where planes and curvature leave the pose hardly known, and what a person should know of it;
    elsewhere, and where rims do not hold it either, the pose as it was found and no words."""
    points = spread_out(source.surfels.points)
    extent = rms_extent(points)
    before, deviated = weakest_motion(found, points)
    if not HARDLY_KNOWN * extent < before < np.inf:
        return found, ""
    held = refine_by_rims(source, target, found, verified)
    after = np.inf if held is None else weakest_motion(held, points)[0]
    if held is None or after > before:
        return found, ""
    motion = motion_name(deviated, found.T_target_source, points.mean(axis=0), extent)
    return held, (
        f"only the rims of its faces say where the part lies along {motion}: by its planes and curves the pose would be"
        f" known to {before:.2g} mm (one standard deviation), by the rims it is to {after:.2g} mm; look at the picture:"
        " they must be the part's own edges, not where a scan was cut off"
    )


def refine_by_rims(source: Scan, target: Scan, found: FineRegistration, verified: Floats) -> FineRegistration | None:
    """A registration improved by the rims that both scans show; None where these say nothing, or contradict each other.

    The planes' pose counts by its total covariance. That of the result holds for errors that are alike within blocks
    of a twelfth of the extent.

    Args:
        found: the pose by the planes.
        verified: the pose (4, 4) that was verified before; where planes resist little, ICP may have slid far from it,
            and what ends far from it is none.
    """
    spacing = max(point_spacing(source), point_spacing(target))
    reach = REACH_SPACINGS * spacing
    ours, theirs = find_rims(source, reach), find_rims(target, reach)
    sigma, _ = weakest_motion(found, spread_out(source.surfels.points))
    if not np.isfinite(sigma) or min(len(ours), len(theirs)) < MIN_MATCHES:
        return None
    nearby = FARTHEST * rms_extent(source.surfels.points)
    within = max(reach, min(REACH_SIGMAS * sigma, nearby))
    starts = (found.T_target_source, verified)
    most = max(MAX_WORSE * found.rms_mm, SAME_SURFACE * target.surfels.grid.size_mm)
    for planes in (_Planes(source, target, found), _Planes(source, target, found, across=True)):
        fits = [fit for start in starts if (fit := _fitted(ours, theirs, planes, start, within)) is not None]
        if not fits:
            return None
        best = max(fits, key=lambda fit: fit.agreeing)
        if best.agreeing < MIN_AGREEING or _apart(best.registration.T_target_source, verified, ours.points) > nearby:
            return None
        if best.registration.rms_mm <= most:
            return best.registration
    return None


class _Planes:
    """What the planes say: the ``information`` (6, 6) of the pose that they gave, and a step towards them.

    ``across``: what distortion may hide counts along the motion that they know least, and is carried over to the
    result along the others, where rims would pull the faces apart.
    """

    def __init__(
        self, source: Scan, target: Scan, found: FineRegistration, across: bool = False, samples: int = 6_000
    ) -> None:
        every = max(1, len(source.surfels) // samples)
        chosen = np.argsort(source.surfels.grid.keys)[::every]
        self.points, self.normals = source.surfels.points[chosen], source.surfels.normals[chosen]
        self.target, self.found = target.surfels, found
        prior = _along_weakest(found, rms_extent(source.surfels.points)) if across else found.total_covariance
        self.beside = found.total_covariance - prior
        prior = prior + 1e-12 * np.diag(np.diag(prior))
        self.information = np.linalg.pinv(prior, rcond=1e-14, hermitian=True)

    def step(self, pose: Floats) -> tuple[Floats, float, float]:
        """The step (6,) from a pose (4, 4) to where the planes meet, the residuals' spread in mm, and the overlap."""
        size = self.target.grid.size_mm
        moved = move_points(pose, self.points)
        residuals, up, _ = signed_distances(self.target, moved, 2 * size)
        met = ~np.isnan(residuals) & ((rotate_vectors(pose, self.normals) * up).sum(axis=1) > MIN_FACING)
        if met.sum() < MIN_MATCHES:
            return np.zeros(6), np.inf, 0.0
        moved, up, residuals = moved[met], up[met], residuals[met]
        arms = moved - self.found.centre_mm
        rows = np.column_stack([up, np.cross(arms, up)])
        spread = 1.4826 * float(np.median(np.abs(residuals))) + 1e-12
        weights = np.clip(1 - (residuals / (TUKEY * spread)) ** 2, 0, None) ** 2
        information = rows.T @ (rows * weights[:, None])
        extent = (arms**2).sum(axis=1).mean()
        information += NORMAL_NOISE**2 * weights.sum() * np.diag([1, 1, 1, extent, extent, extent])
        return -np.linalg.solve(information, rows.T @ (weights * residuals)), spread, float(met.mean())


def _along_weakest(found: FineRegistration, extent: float) -> Floats:
    """The ``covariance`` (6, 6) of a registration, and of its hidden one the part along the motion that is known
    least, where rotations count at the extent in mm."""
    scale = np.array([1, 1, 1, extent, extent, extent])
    _, motions = np.linalg.eigh(found.total_covariance * np.outer(scale, scale))
    along = motions[:, -1:] @ motions[:, -1:].T * np.outer(1 / scale, scale)
    return np.asarray(found.covariance + along @ found.hidden_covariance @ along.T)


@dataclass(frozen=True, eq=False)
class _Fit:
    """A registration by rims, and the fraction of the source's rim points that lie on one of the target's."""

    registration: FineRegistration
    agreeing: float


def _fitted(ours: Rims, theirs: Rims, planes: _Planes, start: Floats, within: float) -> _Fit | None:
    """The fit from one start; None where too few rims meet."""
    spacing = max(ours.spacing_mm, theirs.spacing_mm)
    reach = REACH_SPACINGS * spacing
    centre, pose = planes.found.centre_mm, start
    for _ in range(STEPS):
        matched = _match(ours, theirs, build_cells(theirs.points, within), pose, within)
        if len(matched.residuals) < MIN_MATCHES:
            return None
        rows = np.einsum("ki,kij->kj", matched.ways, motion_columns(matched.places - centre))
        sizes = np.abs(matched.residuals)
        spread = max(1.4826 * float(np.median(sizes)), FLOOR * spacing)
        weights = np.clip(1 - (sizes / (TUKEY * spread)) ** 2, 0, None) ** 2 / (ALIKE * spread**2)
        pulls = rows * (weights * matched.residuals)[:, None]
        whole = planes.information + (rows * weights[:, None]).T @ rows
        step = np.linalg.solve(whole, planes.information @ planes.step(pose)[0] - pulls.sum(axis=0))
        pose = rigid(None, centre) @ small_motion(step) @ rigid(None, -centre) @ pose
        settled = within <= reach * (1 + 1e-9)
        within = max(SHRINKS * within, reach)
        if settled and np.abs(step[:3]).max() < 1e-3 * spread:
            break
    back = np.linalg.inv(whole)
    own = _block_sums(matched.places, pulls)
    covariance = back @ (planes.information + own.T @ own) @ back
    mistaken = back @ (rows.T @ (weights[:, None] * matched.ways)) * INSET * spacing
    carried = back @ planes.information
    _, rms, overlap = planes.step(pose)
    fine = replace(
        planes.found, T_target_source=pose, rms_mm=rms, overlap=overlap, covariance=covariance,
        hidden_covariance=mistaken @ mistaken.T + carried @ planes.beside @ carried.T, by_rims=True,
    )  # fmt: skip
    return _Fit(fine, float((sizes < spacing).sum() / len(ours)))


def _apart(pose: Floats, other: Floats, points: Floats) -> float:
    """Largest distance in mm between the places of points (N, 3) by two poses (4, 4)."""
    return float(np.linalg.norm(move_points(pose, points) - move_points(other, points), axis=1).max())


def _match(ours: Rims, theirs: Rims, cells: CellGrid, pose: Floats, within: float) -> _Matched:
    """The nearest of ``theirs`` for each rim point of ours that one may be the same as, at a pose (4, 4)."""
    places = move_points(pose, ours.points)
    normals, ways = rotate_vectors(pose, ours.normals), rotate_vectors(pose, ours.outward)
    near = within_radius(cells, places, within)
    at = _nearest_alike(normals, ways, theirs.normals, theirs.outward, near.starts, near.indices, near.squared_mm2)
    met = at >= 0
    mean = theirs.outward[at[met]] + ways[met]
    mean /= np.linalg.norm(mean, axis=1)[:, None]
    # the outermost points lie half a spacing inside of their rim
    inset = 0.5 * (theirs.spacing_mm - ours.spacing_mm)
    residuals = ((places[met] - theirs.points[at[met]]) * mean).sum(axis=1) - inset
    return _Matched(places[met], mean, residuals)


@njit(cache=True, nogil=True)
def _nearest_alike(
    normals: Floats,
    ways: Floats,
    their_normals: Floats,
    their_ways: Floats,
    starts: Integers,
    indices: Integers,
    squared: Floats,
) -> Integers:
    """Of each point's neighbours the nearest (N,) that looks and ends the same way, -1 where none does."""
    found = np.full(len(normals), -1, dtype=np.int64)
    for p in range(len(normals)):
        least = np.inf
        for k in range(starts[p], starts[p + 1]):
            q = indices[k]
            if squared[k] >= least or (normals[p] * their_normals[q]).sum() < SAME_FACE:
                continue
            if (ways[p] * their_ways[q]).sum() > SAME_WAY:
                least = squared[k]
                found[p] = q
    return found


def _block_sums(places: Floats, pulls: Floats) -> Floats:
    """Sums (B, 6) of the ``pulls`` (K, 6) over blocks of space: errors are alike within them."""
    size = float(np.linalg.norm(np.ptp(places, axis=0))) / BLOCKS_ACROSS
    grid = build_cells(places, size)
    return np.array([pulls[members].sum(axis=0) for members in np.split(grid.order, grid.starts[1:-1])])
