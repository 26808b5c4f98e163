"""The two faces of a joint fitted along its seam, and the line in which they meet.

The faces (``face_fit``) are fitted beside a rough path, the path is moved onto their intersection and prolonged while
the seam goes on, and both are done again. Their intersection is the root.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from grindvision.geometry import unit_vectors, vector_angle
from grindvision.records import by_content
from grindvision.vision.seam.face_fit import (
    FaceFit,
    Faces,
    Scale,
    faces_beside,
    fit_faces,
    intersections,
    root_normals,
    unseen_bend,
    window_mm,
)
from grindvision.vision.seam.joint_extent import (
    MIN_FACING,
    blur_mm,
    facing,
    leg_lengths,
    main_run,
    rounding_mm,
    sharpness,
)
from grindvision.vision.seam.narrower_fit import Meeting, bent_where_clear, narrower_move
from grindvision.vision.seam.ring_line import RING_CELLS, is_ring, joined_smoothly, one_round, overlap, wrapped
from grindvision.vision.seam.root_line import root_line, smooth_root
from grindvision.vision.seam.seam_curve import SeamCurve, around, build_curve, closed_runs, extended
from grindvision.vision.seam.seam_smoothing import smooth_along

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Passes of fitting the faces and moving the curve onto their intersection: at least, and while the seam still grows.
MIN_PASSES, MAX_PASSES = 4, 14
#: A line that no longer grows is fitted so many times more: while it grows it is stiff, and its ends are too straight.
PASSES_AT_REST = 1
#: The rounding of the corner is measured after these passes.
ROUNDING_PASSES = 1, 3
#: The points around the curve are gathered anew after so many passes, so many cells to all sides.
NEAR_PASSES, NEAR_CELLS = 3, 21.0
#: While a seam grows its line is stiffer, in cells, so that what bends an end does not lead it astray.
GROWING_CELLS = 2.0
#: A rough line is given up where its faces turn by less after the first passes.
HOPEFUL_RAD, HOPEFUL_DEVIATIONS = np.radians(10.0), 3.0
#: Along a seam that was found the faces still meet in it while they turn by this much, rad, and so many deviations.
MIN_SEEN_DIHEDRAL_RAD, MIN_SHOWN_DEVIATIONS = np.radians(8.0), 2.5
#: Before it is smoothed a line goes on by so many of the smoother's lengths, with the bend over so many at its end.
CONTINUED_LENGTHS, BASE_LENGTHS = 4.0, 8.0
#: Weights of stations in a root line are between these parts of the usual one: each shows some place of the root.
LEAST_WEIGHT, MOST_WEIGHT = 0.04, 4.0
#: Faces that meet flatter than this, the sine, are not weighed as flatter ones.
MIN_SINE = 0.05
#: Fractions of the usual number of points near the seam below which a station, and with so many to each side, does not
#: show a face: pixels mixed behind its end are few, and a single one makes no station.
MIN_COVERAGE, MIN_COVERAGE_AROUND, COVERAGE_STATIONS = 0.15, 0.18, 2.0


@by_content
@dataclass(frozen=True)
class JointFit:
    """A seam between two faces, at S stations of ``curve``.

    ``root`` (S, 3) in mm, ``sigma_mm`` (S,) the standard deviation of its distance off, ``normals`` (S, 3)
    half-way between the faces' normals, which are ``faces.normal``; ``dihedral_rad`` (S,) the angle between these, with
    ``dihedral_sigma_rad`` (S,); ``legs_mm`` (2, S) how far each face reaches; ``shown`` (S,) where both faces are seen.
    ``noise_mm`` (2,) is the scatter of the points about the faces, ``bend_per_mm`` (2,) their curvature across the
    seam with its standard deviation, ``members`` (K,) the points on them, ``sharpness`` the fraction of the turn that
    is there close to the root already: 1 for two faces, less for a surface that bends. ``facing`` (S,) is the cosine of
    the angle at which the flatter seen face is seen, see ``facing``; ``missed_mm`` (S,) what faces fitted to less of
    themselves move the root by, which is done as far as it is no noise: see ``narrower_move``; ``swayed_mm`` (S,) is
    the same for faces fitted right up to the root, which take in the rounding of a corner, and whose is
    ``bend_per_mm``; ``unseen_mm`` (S,) is what bends still move the root by: those that do not show, see
    ``unseen_bend``, and what is left of those that do.
    """

    curve: SeamCurve
    root: Floats
    sigma_mm: Floats
    normals: Floats
    faces: Faces
    dihedral_rad: Floats
    dihedral_sigma_rad: Floats
    legs_mm: Floats
    shown: Flags
    noise_mm: Floats
    bend_per_mm: Floats
    bend_sigma_per_mm: Floats
    members: Integers
    sharpness: float
    facing: Floats
    missed_mm: Floats
    swayed_mm: Floats
    unseen_mm: Floats
    closed: bool = False

    @property
    def length_mm(self) -> float:
        """Length of the root line."""
        line = np.concatenate([self.root, self.root[:1]]) if self.closed else self.root
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def fit_joint(
    points: Floats,
    path: Floats,
    normals: tuple[Floats, Floats],
    concave: bool,
    scale: Scale,
    towards: Floats | None = None,
) -> JointFit | None:
    """Fit the faces on both sides of a rough path; None where no two faces meet along most of it.

    Args:
        points: cloud (N, 3), mm.
        path: rough seam (M, 3) in order.
        normals: of the two faces along the path, (M, 3) each, facing the scanner.
        concave: whether the corner is concave, seen from the scanner.
        scale: lengths of the scan.
        towards: where the scanner stands (3,), if that is known: a face ends where it turns away from there.
    """
    fit = _fit_along(points, path, normals, (concave, is_ring(path, scale)), scale, towards)
    if fit is None or fit.closed:
        return fit
    turns = one_round(fit.root, RING_CELLS * scale.cell)
    if turns is None:
        return fit
    sides = (fit.faces.normal[0, :turns], fit.faces.normal[1, :turns])
    ring = _fit_along(points, fit.root[:turns], sides, (concave, True), scale, towards)
    return ring if ring is not None and ring.closed else fit


def _fit_along(
    points: Floats,
    path: Floats,
    normals: tuple[Floats, Floats],
    way: tuple[bool, bool],
    scale: Scale,
    towards: Floats | None,
) -> JointFit | None:
    """As ``fit_joint``; ``way``: is the corner concave, is the path a ring."""
    concave, closed = way
    step = max(1.5 * scale.spacing, scale.cell / 2)
    bisector = unit_vectors(normals[0] + normals[1])
    count = overlap(path, scale) if closed else 0
    path, bisector = wrapped(path, count), wrapped(bisector, count)
    sides = tuple(wrapped(one, count) for one in normals)
    curve = build_curve(path, bisector, step)
    curve = _smooth(curve, scale.cell, curve.stations, curve.up)
    place = cKDTree(path).query(curve.stations)[1]
    faces = faces_beside(curve, sides[0][place], sides[1][place], concave)
    length, growing, at_rest = 0.0, True, 0
    cloud, members = points, np.arange(len(points))
    for number in range(MAX_PASSES):
        if number % NEAR_PASSES == 0:
            members = around(cloud, curve.stations, NEAR_CELLS * scale.cell)
            points = cloud[members]
        if 0 < number < MAX_PASSES - 2 and growing and not closed:
            curve, faces = prolonged(curve, faces, 3 * scale.cell)
        fitted = fit_faces(points, curve, faces, scale)
        if fitted is None:
            return None
        displacement, slopes = intersections(curve, faces, fitted)
        shown = shown_stations(fitted, displacement, scale, closed) & turned_stations(faces, slopes, fitted, concave)
        shown &= facing(curve.stations, root_normals(faces, slopes), fitted, towards) > MIN_FACING
        if number == 1 and not _hopeful(faces, slopes, fitted, shown):
            return None
        turn = None if closed else vector_angle(*root_normals(faces, slopes))
        run = main_run(shown, turn, scale.cell / step)
        if run is None:
            return None
        here = slice(run[0], run[1])
        grown = (run[1] - run[0]) * curve.step_mm - length
        length += grown
        last = number == MAX_PASSES - 1 or (number >= MIN_PASSES and at_rest >= PASSES_AT_REST)
        growing = abs(grown) > 0.5 * scale.cell
        at_rest = 0 if growing else at_rest + 1
        if number in ROUNDING_PASSES:
            scale = replace(scale, rounding=rounding_mm(points, curve, faces, fitted, scale))
        if concave and at_rest == 1:
            scale = replace(scale, rounding=blur_mm(points, curve, faces, fitted, scale))
        curve, faces, fitted = _cut(curve, faces, fitted, here)
        displacement, slopes, shown = displacement[here], slopes[:, here], shown[here]
        if last:
            result = _result(points, curve, faces, fitted, (shown, closed), scale, towards)
            return replace(result, members=members[result.members])
        weight = np.where(shown, 1.0, 0.0)
        stiffness = (GROWING_CELLS if growing else 1.0) * scale.cell
        length_mm = stiffness if growing else stiffness / 2
        if growing:
            lateral = [smooth_along(displacement[:, k], weight, length_mm, step, robust=True) for k in range(2)]
            stations = curve.stations + lateral[0][:, None] * curve.across + lateral[1][:, None] * curve.up
        else:
            # A curve that follows the noise from pass to pass drifts away along it.
            known = _levels(faces, fitted, slopes, shown)[0]
            stations = smooth_root(curve, displacement, known, window_mm(scale) / curve.step_mm)
        turned = [smooth_along(root_normals(faces, slopes)[k], weight, 2 * scale.cell, step) for k in range(2)]
        curve = _smooth(curve, stiffness / 2, stations, unit_vectors(turned[0] + turned[1]))
        place = cKDTree(stations).query(curve.stations)[1]
        faces = faces_beside(curve, turned[0][place], turned[1][place], concave)
    return None


def _hopeful(faces: Faces, slopes: Floats, sides: FaceFit, shown: Flags) -> bool:
    """Whether the turn may come to stand out once the curve lies where the faces meet."""
    if not shown.any():
        return False
    first, second = root_normals(faces, slopes)
    turn = np.arccos(np.clip(np.einsum("si,si->s", first, second), -1, 1))[shown]
    sigma = np.median(np.sqrt(sides.covariance[..., 1, 1].sum(axis=0))[shown])
    return bool(np.percentile(turn, 80) > HOPEFUL_RAD and np.median(turn) > HOPEFUL_DEVIATIONS * sigma)


def shown_stations(sides: FaceFit, displacement: Floats, scale: Scale, ring: bool = False) -> Flags:
    """Stations (S,) at which both faces have points near the seam that fit them; they meet near the curve. The ends of
    a ``ring`` share their points."""
    good = np.ones(len(displacement), dtype=bool)
    reach = 2 * max(int(scale.cell / max(1.5 * scale.spacing, scale.cell / 2)), 1) + 1
    for side in range(2):
        counts = sides.coverage[side]
        usual = np.median(counts[counts > 0]) if (counts > 0).any() else 1.0
        around_it = gaussian_filter1d(counts, COVERAGE_STATIONS, mode="nearest")
        there = (counts > MIN_COVERAGE * usual) & (ring | (around_it > MIN_COVERAGE_AROUND * usual))
        good &= closed_runs(there, reach) & (sides.purity[side] > 0.5)
    return good & (np.linalg.norm(displacement, axis=1) < 2.0 * scale.cell)


def turned_stations(faces: Faces, slopes: Floats, sides: FaceFit, concave: bool) -> Flags:
    """Stations (S,) at which the faces still meet in a corner of the same sign, also by what each shows on its own."""
    sign = 1.0 if concave else -1.0
    steady = sign * np.einsum("si,si->s", faces.outward[0], root_normals(faces, slopes)[1])
    first, second = root_normals(faces, sides.single)
    single = sign * np.einsum("si,si->s", np.cross(np.cross(faces.normal[0], faces.outward[0]), first), second)
    deviation = np.sqrt(sides.covariance[..., 1, 1].sum(axis=0))
    least = np.sin(MIN_SEEN_DIHEDRAL_RAD)
    return (steady > np.maximum(least, MIN_SHOWN_DEVIATIONS * deviation)) & (single > least)


def _result(
    points: Floats,
    curve: SeamCurve,
    faces: Faces,
    sides: FaceFit,
    fitted: tuple[Flags, bool],
    scale: Scale,
    towards: Floats | None,
) -> JointFit:
    shown, closed = fitted
    sides = bent_where_clear(points, curve, faces, sides, scale)
    displacement, slopes = intersections(curve, faces, sides)
    normals = root_normals(faces, slopes)
    weight, level, turns = _levels(faces, sides, slopes, shown)
    window = window_mm(scale) / curve.step_mm
    line = root_line(curve, displacement, weight, level, window)
    sine = np.maximum(np.sin(turns), MIN_SINE)
    bent = narrower_move(points, curve, faces, sides, Meeting(displacement, weight, sine), scale)
    bent = replace(bent, noise=line.scatter * bent.noise)
    near, swayed = sides, bent
    if scale.rounding > 0:
        whole = replace(scale, rounding=0.0)
        near = fit_faces(points, curve, faces, whole) or sides
        meeting = Meeting(intersections(curve, faces, near)[0], weight, sine)
        swayed = narrower_move(points, curve, faces, near, meeting, whole)
    root = line.places + bent.missed[:, :1] * curve.across + bent.missed[:, 1:] * curve.up
    turn = smooth_along(turns, np.where(shown, 1.0, 1e-6), 2 * scale.cell, curve.step_mm, robust=True)
    even = np.where(shown, 1.0, 1e-6)
    out = unit_vectors(np.stack([smooth_along(normals[k], even, 2 * scale.cell, curve.step_mm) for k in (0, 1)]))
    turned = Faces(unit_vectors(faces.outward + slopes[..., None] * faces.normal), out)
    moved = replace(curve, stations=root)
    legs = leg_lengths(points, moved, turned, sides, scale)
    sharp_fraction = sharpness(points, curve, faces, float(np.median(turn[shown])), scale)
    sigma = np.maximum(np.sqrt(2.0) * line.scatter * line.sigma * level, 0.02 * scale.spacing)  # in both directions
    unseen = np.hypot(np.linalg.norm(unseen_bend(sides, window), axis=0) / sine, bent.sigma)
    result = JointFit(
        moved, root, sigma, unit_vectors(out[0] + out[1]), turned, turn,
        line.scatter * np.sqrt(sides.covariance[..., 1, 1].sum(axis=0)), legs, shown, sides.noise,
        2 * np.median(near.coefficients[..., 2], axis=1), 2 * near.bend_sigma,
        np.unique(np.concatenate(sides.inside)), sharp_fraction, facing(root, out, sides, towards),
        np.linalg.norm(bent.moved, axis=1), np.linalg.norm(swayed.moved, axis=1), unseen, closed,
    )  # fmt: skip
    return _unwrapped(result, scale) if closed else result


def _levels(faces: Faces, sides: FaceFit, slopes: Floats, shown: Flags) -> tuple[Floats, Floats, Floats]:
    """Of S stations the weights in a root line, the promised standard deviations across it, mm, and the angles between
    the faces, rad, (S,) each."""
    normals = root_normals(faces, slopes)
    turn = np.arccos(np.clip(np.einsum("si,si->s", normals[0], normals[1]), -1, 1))
    level = np.sqrt(sides.covariance[..., 0, 0].sum(axis=0)) / np.maximum(np.sin(turn), MIN_SINE)
    weight = np.where(shown, 1 / np.maximum(level, 1e-9) ** 2, 0.0)
    usual = np.median(weight[shown])
    return np.where(shown, np.clip(weight, LEAST_WEIGHT * usual, MOST_WEIGHT * usual), 0.0), level, turn


def _cut(curve: SeamCurve, faces: Faces, sides: FaceFit, here: slice) -> tuple[SeamCurve, Faces, FaceFit]:
    return curve.part(here), faces.part(here), sides.part(here)


def _smooth(curve: SeamCurve, length_mm: float, stations: Floats, up: Floats) -> SeamCurve:
    """A curve through stations (S, 3), smoothed; continued with its bend before, or it would end straight."""
    raw = build_curve(stations, up, curve.step_mm)
    reach_mm = CONTINUED_LENGTHS * length_mm
    longer = extended(raw, reach_mm, reach_mm, base_mm=BASE_LENGTHS * length_mm)
    added = int(reach_mm / raw.step_mm)
    even, here = np.ones(len(longer)), slice(added, len(longer) - added)
    line, up = (smooth_along(one, even, length_mm, longer.step_mm)[here] for one in (longer.stations, longer.up))
    return build_curve(line, up, curve.step_mm)


def prolonged(curve: SeamCurve, faces: Faces, reach_mm: float) -> tuple[SeamCurve, Faces]:
    """A curve and its faces carried on by ``reach_mm`` at both ends."""
    longer = extended(curve, reach_mm, reach_mm, base_mm=4 * reach_mm)
    place = cKDTree(curve.stations).query(longer.stations)[1]
    outward, normal = faces.outward[:, place], faces.normal[:, place]
    normal = unit_vectors(normal - np.einsum("ksi,si->ks", normal, longer.along)[..., None] * longer.along)
    outward = outward - np.einsum("ksi,si->ks", outward, longer.along)[..., None] * longer.along
    outward = unit_vectors(outward - np.einsum("ksi,ksi->ks", outward, normal)[..., None] * normal)
    return longer, Faces(outward, normal)


def _unwrapped(fit: JointFit, scale: Scale) -> JointFit:
    """One round of a ring that was fitted with its ends lying over each other."""
    away = np.linalg.norm(fit.root - fit.root[0], axis=1)
    far = int(np.argmax(away > 3 * scale.cell))
    back = far + int(np.argmin(away[far:]))
    if far == 0 or away[back] > 2 * scale.cell:
        return replace(fit, closed=False)
    here = slice(0, back)
    root = joined_smoothly(fit.root[here], scale.cell, fit.curve.step_mm)
    return replace(
        fit, curve=replace(fit.curve.part(here), stations=root), root=root,
        sigma_mm=fit.sigma_mm[here], normals=fit.normals[here], faces=fit.faces.part(here),
        dihedral_rad=fit.dihedral_rad[here], dihedral_sigma_rad=fit.dihedral_sigma_rad[here],
        legs_mm=fit.legs_mm[:, here], shown=fit.shown[here], facing=fit.facing[here],
        missed_mm=fit.missed_mm[here], swayed_mm=fit.swayed_mm[here], unseen_mm=fit.unseen_mm[here],
    )  # fmt: skip
