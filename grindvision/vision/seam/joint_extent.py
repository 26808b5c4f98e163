"""What a joint shows around its root line: the reach of its faces, the rounding and the sharpness of its corner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter

from grindvision.geometry import unit_vectors
from grindvision.vision.seam.face_fit import FaceFit, Faces, Scale, fit_faces, intersections, root_normals
from grindvision.vision.seam.seam_curve import SeamCurve, nearest_stations

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Part of the reach over which a corner is looked at closely.
CLOSE = 0.4
#: Leg lengths end where less than this fraction of the usual number of points lies on the face.
LEG_COVERAGE = 0.3
#: A parabola follows a face that bends, as far as it is fitted, to this part of the bend.
BEND_FOLLOWED = 0.25
#: A camera measures no surface that it sees flatter than this (83 deg of incidence), the cosine; what seems to be one
#: are pixels mixed from a near and a far body, which lie along the rays.
MIN_FACING = 0.12
#: A ring about the root is rounded where the points lie off the faces, in the median, by this much of their scatter
#: and of a cell, and by so many standard deviations of faces carried on so far, whose stations so many cells
#: apart are independent.
ROUNDED_NOISE, ROUNDED_CELLS, ROUNDED_SIGMAS, WINDOW_CELLS = 0.5, 0.015, 3.0, 2.4
#: Faces that bulge by more than this over their reach, in cells, as tubes do, are followed by no parabola far: they are
#: carried on over this part of their reach at most.
MAX_BULGE_CELLS, BENT_ROUNDING = 0.25, 0.22
#: Faces that scatter, beyond a rounding, by more than this times the points' own noise and this part of a cell bend
#: otherwise than the fit, and what lies off them near the root says nothing of a rounding. (Windows of pixels leave
#: less noise from point to point than over a face.)
FOLLOWED, FOLLOWED_CELLS = 1.5, 0.07
#: A blurred corner is left out up to one of these parts of the reach. A face bends towards the other one by so many
#: standard deviations, and beyond the blur by less than this part of that.
BLURRED, BENT_SIGMAS, STILL_BENT = (0.25, 0.45), 3.0, 0.5
#: Interruptions longer than so many stations and up to so many cells are bridged to stretches of so many cells, over
#: which the faces turn as in the median of so many stations before it, within this fraction or this angle.
MIN_HIDDEN, BRIDGED_CELLS, STRETCH_CELLS = 2, 12.0, 2.0
END_STATIONS, ALIKE_FRACTION, ALIKE_RAD = 9, 0.3, np.radians(10.0)
#: A face seen that flat holds less than this fraction of the other one's points.
THIN = 0.5


def leg_lengths(points: Floats, curve: SeamCurve, faces: Faces, sides: FaceFit, scale: Scale) -> Floats:
    """How far each face reaches (2, S), mm, at most 12 cells."""
    reach = 12 * scale.cell
    _, station, offset = nearest_stations(points, curve, reach)
    outward = np.einsum("kij,ij->ki", faces.outward[:, station], offset)
    height = np.einsum("kij,ij->ki", faces.normal[:, station], offset)
    width = max(2.0 * scale.spacing, scale.cell / 3)
    bins = int(reach / width)
    bend = sides.coefficients[..., 2]
    gentle = np.clip(bend, -0.2 / reach, 0.2 / reach)
    legs = np.empty((2, len(curve)))
    for side in range(2):
        fitted = np.minimum(np.abs(outward[side]), scale.far) ** 2
        beyond = outward[side] ** 2 - fitted
        off = height[side] - bend[side][station] * fitted - gentle[side][station] * beyond
        tolerance = 4 * sides.noise[side] + 0.06 * np.abs(outward[side]) + 0.02 * scale.cell
        tolerance += BEND_FOLLOWED * np.abs(bend[side])[station] * fitted
        on = (outward[side] > 0) & (np.abs(off) < tolerance)
        place = station[on] * bins + np.minimum((outward[side][on] / width).astype(int), bins - 1)
        counts = np.bincount(place, minlength=len(curve) * bins).reshape(-1, bins).astype(float)
        counts = gaussian_filter1d(counts, 2.0, axis=0)
        usual = np.median(counts[:, 1 : max(int(2 * scale.cell / width), 2)], axis=1, keepdims=True)
        empty = counts < LEG_COVERAGE * usual
        empty = empty[:, :-1] & empty[:, 1:] if bins > 1 else empty
        empty[:, 0] = False
        legs[side] = np.where(empty.any(axis=1), empty.argmax(axis=1) * width, reach)
        legs[side] = median_filter(legs[side], size=5, mode="nearest")
    return legs


def rounding_mm(points: Floats, curve: SeamCurve, faces: Faces, fitted: FaceFit, scale: Scale) -> float:
    """Radius about the root, mm, within which the points lie off both faces, which ``fitted`` shows as they are taken
    now: a bead, a rounded or a blurred corner.

    The faces are fitted to what lies beyond the widest rounding and carried on to the root: fitted to the rounding as
    well they would bend along with it.
    """
    bulge = -float(np.median(fitted.coefficients[..., 2], axis=1).min()) * scale.far**2
    reach = BENT_ROUNDING * scale.far if bulge > MAX_BULGE_CELLS * scale.cell else scale.far
    scale = replace(scale, rounding=reach)
    sides = fit_faces(points, curve, faces, scale)
    if sides is None or sides.noise.max() > max(FOLLOWED * scale.noise, FOLLOWED_CELLS * scale.cell):
        return 0.0
    displacement, _ = intersections(curve, faces, sides)
    _, station, offset = nearest_stations(points, curve, scale.far)
    shift = displacement[:, :1] * curve.across + displacement[:, 1:] * curve.up
    outward = np.einsum("kij,ij->ki", faces.outward[:, station], offset)
    height = np.einsum("kij,ij->ki", faces.normal[:, station], offset)
    level, slope, bend = np.moveaxis(sides.coefficients[:, station], 2, 0)
    off = height - level - (slope + bend * outward) * outward
    root = np.einsum("kij,ij->ki", faces.outward[:, station], shift[station])
    off = np.where(outward > root - 0.2 * scale.cell, off, np.inf)
    nearer = np.abs(off).argmin(axis=0)
    off = off[nearer, np.arange(len(station))]
    distance = np.linalg.norm(offset - shift[station], axis=1)
    width = max(scale.spacing, scale.far / 24)
    windows = max(curve.length_mm / (WINDOW_CELLS * scale.cell), 1.0)
    carried = float(np.median(np.sqrt(sides.covariance[..., 0, 0]), axis=1).max()) / np.sqrt(windows)
    limit = max(ROUNDED_NOISE * float(sides.noise.max()) + ROUNDED_CELLS * scale.cell, ROUNDED_SIGMAS * carried)
    radius = 0.0
    for ring in range(int(scale.near / width)):
        inside = (distance >= ring * width) & (distance < (ring + 1) * width)
        if inside.sum() > 10 and np.abs(np.median(off[inside])) > limit:
            radius = (ring + 1) * width
    return radius


def blur_mm(points: Floats, curve: SeamCurve, faces: Faces, fitted: FaceFit, scale: Scale) -> float:
    """Distance from the root, mm, up to which a face of a concave corner bends towards the other one and not beyond.

    A camera that matches windows of pixels rounds corners, all the farther on a face that it sees flat, and a bead
    does so as well: a parabola bends along with it, and meets the other face too soon. A face that goes on bending
    farther out is bent.
    """
    bend = np.median(fitted.coefficients[..., 2], axis=1)
    towards = bend > BENT_SIGMAS * fitted.bend_sigma
    for part in BLURRED:
        if part * scale.far > scale.near and towards.any():
            outer = fit_faces(points, curve, faces, replace(scale, rounding=part * scale.far))
            if outer is not None and (np.median(outer.coefficients[..., 2], axis=1) < STILL_BENT * bend)[towards].all():
                return part * scale.far
    return scale.rounding


def sharpness(points: Floats, curve: SeamCurve, faces: Faces, dihedral_rad: float, scale: Scale) -> float:
    """Fraction of the turn that the faces show when only what is near the root is fitted."""
    near = replace(scale, cell=CLOSE * scale.cell, rounding=0.0)
    if near.far < 3 * near.near:
        near = replace(near, cell=3 * near.near / 4.5)
    sides = fit_faces(points, curve, faces, near)
    if sides is None:
        return 1.0
    flat = replace(sides, coefficients=sides.coefficients * [1.0, 1.0, 0.0]) if not any(sides.bent) else sides
    _, slopes = intersections(curve, faces, flat)
    first, second = root_normals(faces, slopes)
    turn = np.arccos(np.clip(np.einsum("si,si->s", first, second), -1, 1))
    return float(np.median(turn)) / max(dihedral_rad, 1e-6)


def facing(stations: Floats, faces: Floats, sides: FaceFit, towards: Floats | None) -> Floats:
    """Cosine (S,) of the angle at which the flatter seen of two faces with normals (2, S, 3) looks ``towards`` (3,).

    It is 1 where nobody knows the scanner's place, and for a face as dense as the other one: a scan merged from several
    views shows such faces, while one camera puts the fewer points on a face the flatter it sees it.
    """
    if towards is None:
        return np.ones(len(stations))
    cosines = np.einsum("ksi,si->ks", faces, unit_vectors(towards - stations))
    points = gaussian_filter1d(sides.coverage, 2.0, axis=1)
    return np.asarray(np.where(points < THIN * points[::-1], cosines, 1.0).min(axis=0))


def main_run(shown: Flags, turn_rad: Floats | None, cell: float) -> tuple[int, int] | None:
    """First and behind the last station of the longest run that shows the seam; interruptions are bridged.

    What lies behind an interruption counts if the faces turn there (S,), rad, as they do before it, over a stretch
    that shows it; on a ring, without angles, it always does. ``cell`` is in stations.
    """
    if shown.sum() < 4:
        return None
    at = np.flatnonzero(shown)
    pieces = np.split(at, np.flatnonzero(np.diff(at) > MIN_HIDDEN) + 1)
    best = int(np.argmax([len(piece) for piece in pieces]))
    first, last = int(pieces[best][0]), int(pieces[best][-1]) + 1
    for piece in pieces[best + 1 :]:
        if not _goes_on(turn_rad, piece, slice(max(last - END_STATIONS, first), last), cell, int(piece[0]) - last):
            break
        last = int(piece[-1]) + 1
    for piece in pieces[:best][::-1]:
        here = slice(first, min(first + END_STATIONS, last))
        if not _goes_on(turn_rad, piece, here, cell, first - int(piece[-1]) - 1):
            break
        first = int(piece[0])
    return (first, last) if last - first >= 4 and shown[first:last].mean() > 0.4 else None


def _goes_on(turn_rad: Floats | None, piece: Integers, end: slice, cell: float, hidden: int) -> bool:
    """Whether stations (K,) behind so many hidden ones show the corner that ends at the stations ``end``."""
    if turn_rad is None:
        return hidden <= BRIDGED_CELLS * cell
    usual = float(np.median(turn_rad[end]))
    alike = abs(float(np.median(turn_rad[piece])) - usual) < max(ALIKE_FRACTION * usual, ALIKE_RAD)
    return hidden <= BRIDGED_CELLS * cell and len(piece) >= STRETCH_CELLS * cell and alike
