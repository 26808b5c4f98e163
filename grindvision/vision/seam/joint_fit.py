"""The two faces of a joint fitted along its seam, and the line in which they meet.

In the cross-section at every station each face is a parabola over the distance from the seam, fitted robustly to the
points of a window along the seam. Their intersection is the root; extrapolated from both sides, it does not care for a
bead, a tack or a blurred corner right at the seam.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, gaussian_filter1d, median_filter
from scipy.spatial import cKDTree

from grindvision.records import by_content
from grindvision.vision.seam.seam_curve import SeamCurve, build_curve, extended
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD, smooth_along, smooth_to_noise

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Rounds of lowering the weights of points that stand out; Tukey's biweight gives up beyond so many deviations.
ROUNDS, TUKEY = 5, 4.7
#: Passes of fitting the faces and moving the curve onto their intersection: at least, and while the seam still grows.
MIN_PASSES, MAX_PASSES = 4, 14
#: Along a seam that was found the faces still meet in it while they turn by this much, rad, and so many deviations.
MIN_SHOWN_TURN_RAD, MIN_SHOWN_DEVIATIONS = np.radians(4.0), 2.0
#: Scans without noise have that of their numbers.
MIN_NOISE_MM = 1e-4
#: Where a face is less even than elsewhere, it may scatter so many times as much as usual.
LOCAL = 3.0
#: Points at first belong to a face up to this slope off it.
MAX_SLOPE_OFF = 0.6
#: Part of the reach over which a corner is looked at closely.
CLOSE = 0.4
#: Share of the usual number of points near the seam below which a station does not show a face.
MIN_COVERAGE = 0.15
#: A face bends if a parabola leaves less than this share of what a straight line leaves.
CLEARLY_BENT = 0.9
#: Leg lengths end where less than this share of the usual number of points lies on the face.
LEG_COVERAGE = 0.3


@dataclass(frozen=True)
class Scale:
    """Lengths of a fit, mm: ``spacing`` of points, ``cell`` of the surfels, ``noise`` of the points."""

    spacing: float
    cell: float
    noise: float
    rounding: float = 0.0

    @property
    def near(self) -> float:
        """Faces are fitted from here on: what is nearer may be a bead or a blurred corner."""
        return max(1.5 * self.spacing + 2.0 * self.noise, min(self.rounding, 0.4 * self.far))

    @property
    def far(self) -> float:
        """Faces are fitted up to here."""
        return 4.5 * self.cell


@by_content
@dataclass(frozen=True)
class Faces:
    """Two faces at S stations: unit directions along each face away from the seam and normals, (2, S, 3) each."""

    outward: Floats
    normal: Floats


@by_content
@dataclass(frozen=True)
class JointFit:
    """A seam between two faces, at S stations of ``curve``.

    ``root`` (S, 3) in mm, ``sigma_mm`` (S,) the standard deviation of its place across the seam; ``normals`` (S, 3)
    half-way between the faces' normals, which are ``faces.normal``; ``turn_rad`` (S,) the angle between these, with
    ``turn_sigma_rad`` (S,); ``legs_mm`` (2, S) how far each face reaches; ``shown`` (S,) where both faces are seen.
    ``noise_mm`` (2,) is the scatter of the points about the faces, ``bend_per_mm`` (2,) their curvature across the
    seam, ``members`` (K,) the points on them, ``sharpness`` the share of the turn that is there close to the root
    already: 1 for two faces, less for a surface that bends.
    """

    curve: SeamCurve
    root: Floats
    sigma_mm: Floats
    normals: Floats
    faces: Faces
    turn_rad: Floats
    turn_sigma_rad: Floats
    legs_mm: Floats
    shown: Flags
    noise_mm: Floats
    bend_per_mm: Floats
    members: Integers
    sharpness: float
    closed: bool = False

    @property
    def length_mm(self) -> float:
        """Length of the root line."""
        line = np.concatenate([self.root, self.root[:1]]) if self.closed else self.root
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


@by_content
@dataclass(frozen=True)
class _Sides:
    """Parabolas of both faces at S stations: coefficients (2, S, 3), covariances (2, S, 3, 3), and their points."""

    coefficients: Floats
    covariance: Floats
    noise: Floats
    bent: tuple[bool, bool]
    coverage: Floats
    inside: tuple[Integers, Integers]
    purity: Floats


def fit_joint(
    points: Floats, path: Floats, normals: tuple[Floats, Floats], concave: bool, scale: Scale
) -> JointFit | None:
    """Fit the faces on both sides of a rough path; None where no two faces meet along most of it.

    Args:
        points: cloud (N, 3), mm.
        path: rough seam (M, 3) in order.
        normals: of the two faces along the path, (M, 3) each, facing the scanner.
        concave: whether the corner is concave, seen from the scanner.
        scale: lengths of the scan.
    """
    step = max(1.5 * scale.spacing, scale.cell / 2)
    bisector = _unit(normals[0] + normals[1])
    closed = _is_ring(path, scale)
    path = _wrapped(path, 6) if closed else path
    bisector = _wrapped(bisector, 6) if closed else bisector
    sides = tuple(_wrapped(one, 6) if closed else one for one in normals)
    curve = build_curve(path, bisector, step)
    curve = _smooth(curve, scale.cell, curve.stations, curve.up)
    place = cKDTree(path).query(curve.stations)[1]
    faces = _faces(curve, sides[0][place], sides[1][place], concave)
    length, growing = 0.0, True
    for number in range(MAX_PASSES):
        if 0 < number < MAX_PASSES - 2 and growing and not closed:
            curve, faces = _prolonged(curve, faces, 3 * scale.cell)
        fitted = _fit_sides(points, curve, faces, scale)
        if fitted is None:
            return None
        shift, slopes = _intersections(curve, faces, fitted)
        shown = _shown(fitted, shift, scale) & _turned(faces, slopes, fitted, concave)
        run = _main_run(shown, int(12 * scale.cell / step))
        if run is None:
            return None
        here = slice(run[0], run[1])
        grown = (run[1] - run[0]) * curve.step_mm - length
        length += grown
        last = number == MAX_PASSES - 1 or (number >= MIN_PASSES and not growing)
        growing = abs(grown) > 0.5 * scale.cell
        if number == 1:
            scale = replace(scale, rounding=_rounding(points, curve, faces, fitted, shift, scale))
        curve, faces, fitted = _cut(curve, faces, fitted, here)
        shift, slopes, shown = shift[here], slopes[:, here], shown[here]
        if last:
            return _result(points, curve, faces, fitted, (shift, slopes, shown, closed), scale)
        weight = np.where(shown, 1.0, 0.0)
        lateral = [smooth_along(shift[:, k], weight, scale.cell, step, robust=True) for k in range(2)]
        stations = curve.stations + lateral[0][:, None] * curve.across + lateral[1][:, None] * curve.up
        turned = [smooth_along(_turned_normals(faces, slopes)[k], weight, 2 * scale.cell, step) for k in range(2)]
        curve = _smooth(curve, scale.cell / 2, stations, _unit(turned[0] + turned[1]))
        place = cKDTree(stations).query(curve.stations)[1]
        faces = _faces(curve, turned[0][place], turned[1][place], concave)
    return None


def _fit_sides(points: Floats, curve: SeamCurve, faces: Faces, scale: Scale) -> _Sides | None:
    """Parabolas of both faces at every station, fitted over a window along the seam."""
    index, station, offset = nearest_stations(points, curve, 1.3 * scale.far)
    if len(index) < 20:
        return None
    outward = np.einsum("kij,ij->ki", faces.outward[:, station], offset)
    height = np.einsum("kij,ij->ki", faces.normal[:, station], offset)
    nearer = outward[0] > outward[1]
    window = max(1.2 * scale.cell, 2.0 * scale.spacing) / curve.step_mm
    count = len(curve)
    results, bent, inside, coverage, purity = [], [], [], [], []
    for side in range(2):
        mine = (nearer if side == 0 else ~nearer) & (outward[side] > scale.near) & (outward[side] < scale.far)
        mine &= np.abs(height[side]) < MAX_SLOPE_OFF * outward[side] + 3 * scale.noise
        if mine.sum() < 12:
            return None
        at, a, e = station[mine], outward[side][mine], height[side][mine]
        flat = _parabola(at, a, e, count, window, 2)
        round_ = _parabola(at, a, e, count, window, 3)
        is_bent = round_[2] < CLEARLY_BENT * flat[2]
        coefficients, covariance, noise, weights = round_ if is_bent else flat
        results.append((coefficients, covariance, noise))
        bent.append(bool(is_bent))
        near = a < scale.near + 1.5 * scale.cell
        on = weights > 0
        good = np.bincount(at[on & near], minlength=count).astype(float)
        every = np.bincount(at[near], minlength=count).astype(float)
        coverage.append(good)
        purity.append(gaussian_filter1d(good, 1.0) / np.maximum(gaussian_filter1d(every, 1.0), 1e-9))
        inside.append(index[mine][on])
    return _Sides(
        np.stack([one[0] for one in results]),
        np.stack([one[1] for one in results]),
        np.array([one[2] for one in results]),
        (bent[0], bent[1]),
        np.stack(coverage),
        (inside[0], inside[1]),
        np.stack(purity),
    )


def _parabola(
    at: Integers, a: Floats, e: Floats, count: int, window: float, terms: int
) -> tuple[Floats, Floats, float, Floats]:
    """Coefficients (S, 3) of e over a at every station, covariances (S, 3, 3), scatter, and the points' weights."""
    powers = np.stack([a**k for k in range(5)])
    weights, noise = np.ones(len(a)), 0.0
    coefficients, covariance = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for _ in range(ROUNDS):
        sums = np.stack([np.bincount(at, weights * power, count) for power in powers])
        right = np.stack([np.bincount(at, weights * e * a**k, count) for k in range(terms)])
        sums, right = (gaussian_filter1d(one, window, axis=1, mode="constant", truncate=3.0) for one in (sums, right))
        normal = np.stack([[sums[i + j] for j in range(terms)] for i in range(terms)]).transpose(2, 0, 1)
        scale = np.sqrt(np.maximum(np.einsum("sii->si", normal), 1e-12))
        normal = normal / scale[:, :, None] / scale[:, None, :] + 1e-6 * np.eye(terms)
        inverse = np.linalg.inv(normal) / scale[:, :, None] / scale[:, None, :]
        coefficients[:, :terms] = np.einsum("sij,js->si", inverse, right)
        off = e - sum(coefficients[at, k] * powers[k] for k in range(terms))
        known = weights > 0
        noise = max(float(MAD_TO_STD * np.median(np.abs(off[known]))) if known.any() else 0.0, MIN_NOISE_MM)
        spread = gaussian_filter1d(
            np.stack([np.bincount(at, weights, count), np.bincount(at, weights * off**2, count)]), window, axis=1
        )
        local = np.clip(np.sqrt(spread[1] / np.maximum(spread[0], 1e-9)), noise, LOCAL * noise)
        weights = np.maximum(1 - (off / np.maximum(TUKEY * local[at], 1e-9)) ** 2, 0) ** 2
    # A Gaussian window of sigma w stations counts as 2 sqrt(pi) w of them.
    covariance[:, :terms, :terms] = inverse * noise**2 / (np.sqrt(2.0))
    return coefficients, covariance, noise, weights


def nearest_stations(points: Floats, curve: SeamCurve, reach_mm: float) -> tuple[Integers, Integers, Floats]:
    """Points (K,) within ``reach_mm`` of a curve, the station of each, and its offset (K, 3) across the curve.

    Points before the first or behind the last station are left out.
    """
    low, high = curve.stations.min(axis=0) - reach_mm, curve.stations.max(axis=0) + reach_mm
    index = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    away, station = cKDTree(curve.stations).query(points[index], distance_upper_bound=reach_mm)
    kept = np.isfinite(away)
    index, station = index[kept], station[kept]
    offset = points[index] - curve.stations[station]
    ahead = (offset * curve.along[station]).sum(axis=1)
    kept = np.abs(ahead) <= 0.75 * curve.step_mm
    offset = offset - ahead[:, None] * curve.along[station]
    return index[kept], station[kept], offset[kept]


def _intersections(curve: SeamCurve, faces: Faces, sides: _Sides) -> tuple[Floats, Floats]:
    """Where the faces meet: shift (S, 2) across and up from every station, and the faces' slopes there (2, S)."""
    basis = np.stack([curve.across, curve.up], axis=1)
    outward = np.einsum("sij,ksj->ksi", basis, faces.outward)
    normal = np.einsum("sij,ksj->ksi", basis, faces.normal)
    shift = np.zeros((len(curve), 2))
    for _ in range(4):
        a = np.einsum("ksi,si->ks", outward, shift)
        value = sides.coefficients[..., 0] + (sides.coefficients[..., 1] + sides.coefficients[..., 2] * a) * a
        slope = sides.coefficients[..., 1] + 2 * sides.coefficients[..., 2] * a
        rows = normal - slope[..., None] * outward
        right = value - slope * a
        matrix = rows.transpose(1, 0, 2)
        determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
        safe = np.where(np.abs(determinant) < 1e-3, 1e-3, determinant)
        shift = np.stack(
            [
                (right[0] * matrix[:, 1, 1] - right[1] * matrix[:, 0, 1]) / safe,
                (right[1] * matrix[:, 0, 0] - right[0] * matrix[:, 1, 0]) / safe,
            ],
            axis=1,
        )
    a = np.einsum("ksi,si->ks", outward, shift)
    return shift, sides.coefficients[..., 1] + 2 * sides.coefficients[..., 2] * a


def _shown(sides: _Sides, shift: Floats, scale: Scale) -> Flags:
    """Stations (S,) at which both faces have points near the seam that fit them, and meet near the curve."""
    good = np.ones(len(shift), dtype=bool)
    reach = 2 * max(int(scale.cell / max(1.5 * scale.spacing, scale.cell / 2)), 1) + 1
    for side in range(2):
        counts = sides.coverage[side]
        usual = np.median(counts[counts > 0]) if (counts > 0).any() else 1.0
        good &= closed_runs(counts > MIN_COVERAGE * usual, reach) & (sides.purity[side] > 0.5)
    return good & (np.linalg.norm(shift, axis=1) < 2.0 * scale.cell)


def closed_runs(flags: Flags, size: int) -> Flags:
    """Flags (S,) with gaps shorter than ``size`` filled; the ends stay where they are."""
    return np.asarray(binary_closing(np.pad(flags, size), np.ones(size))[size:-size])


def _turned(faces: Faces, slopes: Floats, sides: _Sides, concave: bool) -> Flags:
    """Stations (S,) at which the faces still meet in a corner of the same sign."""
    _, second = _turned_normals(faces, slopes)
    side = np.einsum("si,si->s", faces.outward[0], second) * (1.0 if concave else -1.0)
    deviation = np.sqrt(sides.covariance[..., 1, 1].sum(axis=0))
    return side > np.maximum(np.sin(MIN_SHOWN_TURN_RAD), MIN_SHOWN_DEVIATIONS * deviation)


def _rounding(points: Floats, curve: SeamCurve, faces: Faces, sides: _Sides, shift: Floats, scale: Scale) -> float:
    """Radius about the root, mm, within which the points miss both faces: a bead, a rounded or a blurred corner."""
    _, station, offset = nearest_stations(points, curve, scale.far)
    offset = offset - shift[station, :1] * curve.across[station] - shift[station, 1:] * curve.up[station]
    outward = np.einsum("kij,ij->ki", faces.outward[:, station], offset)
    height = np.einsum("kij,ij->ki", faces.normal[:, station], offset)
    slope = sides.coefficients[:, station, 1]
    bend = sides.coefficients[:, station, 2]
    off = np.abs(height - (slope + bend * outward) * outward)
    off = np.where(outward > -0.2 * scale.cell, off, np.inf).min(axis=0)
    distance = np.linalg.norm(offset, axis=1)
    width = max(scale.spacing, scale.far / 24)
    limit = 2.5 * float(sides.noise.max()) + 0.01 * scale.cell
    radius = 0.0
    for ring in range(int(0.6 * scale.far / width)):
        inside = (distance >= ring * width) & (distance < (ring + 1) * width)
        if inside.sum() > 10 and np.median(off[inside]) > limit:
            radius = (ring + 1) * width
    return radius


def _turned_normals(faces: Faces, slopes: Floats) -> Floats:
    """Unit normals (2, S, 3) of the faces at the root."""
    return _unit(faces.normal - slopes[..., None] * faces.outward)


def _result(
    points: Floats,
    curve: SeamCurve,
    faces: Faces,
    sides: _Sides,
    fitted: tuple[Floats, Floats, Flags, bool],
    scale: Scale,
) -> JointFit:
    shift, slopes, shown, closed = fitted
    normals = _turned_normals(faces, slopes)
    turn = np.arccos(np.clip(np.einsum("si,si->s", normals[0], normals[1]), -1, 1))
    sine = np.maximum(np.sin(turn), 0.05)
    level = np.sqrt(sides.covariance[..., 0, 0].sum(axis=0)) / sine
    turn_sigma = np.sqrt(sides.covariance[..., 1, 1].sum(axis=0))
    weight = np.where(shown, 1 / np.maximum(level, 1e-9) ** 2, 0.0)
    weight = np.minimum(weight, 4 * np.median(weight[shown]))
    smooth = np.stack([smooth_to_noise(shift[:, k], weight, curve.step_mm)[0] for k in range(2)], axis=1)
    smooth = smooth_along(smooth, np.ones(len(smooth)), scale.cell, curve.step_mm)
    # What neighbouring stations scatter about the smooth line, against what the fits promise.
    off = np.linalg.norm(shift - smooth, axis=1)[shown] / np.sqrt(2)
    inflation = max(1.0, float(MAD_TO_STD * np.median(off) / max(np.median(level[shown]), 1e-9)))
    root = curve.stations + smooth[:, :1] * curve.across + smooth[:, 1:] * curve.up
    turn = smooth_along(turn, np.where(shown, 1.0, 1e-6), 2 * scale.cell, curve.step_mm, robust=True)
    even = np.where(shown, 1.0, 1e-6)
    facing = np.stack([smooth_along(normals[k], even, 2 * scale.cell, curve.step_mm) for k in (0, 1)])
    facing = _unit(facing)
    turned = Faces(_unit(faces.outward + slopes[..., None] * faces.normal), facing)
    moved = replace(curve, stations=root)
    legs = _legs(points, moved, turned, sides, scale)
    sharpness = _sharpness(points, curve, faces, float(np.median(turn[shown])), scale)
    result = JointFit(
        moved, root, np.maximum(inflation * level, 0.02 * scale.spacing), _unit(facing[0] + facing[1]), turned, turn,
        inflation * turn_sigma, legs, shown, sides.noise, 2 * np.median(sides.coefficients[..., 2], axis=1),
        np.unique(np.concatenate(sides.inside)), sharpness, closed,
    )  # fmt: skip
    return _unwrapped(result, scale) if closed else result


def _sharpness(points: Floats, curve: SeamCurve, faces: Faces, turn_rad: float, scale: Scale) -> float:
    """Share of the turn that the faces show when only what is near the root is fitted."""
    near = replace(scale, cell=CLOSE * scale.cell, rounding=0.0)
    if near.far < 3 * near.near:
        near = replace(near, cell=3 * near.near / 4.5)
    sides = _fit_sides(points, curve, faces, near)
    if sides is None:
        return 1.0
    flat = replace(sides, coefficients=sides.coefficients * [1.0, 1.0, 0.0]) if not any(sides.bent) else sides
    _, slopes = _intersections(curve, faces, flat)
    first, second = _turned_normals(faces, slopes)
    turn = np.arccos(np.clip(np.einsum("si,si->s", first, second), -1, 1))
    return float(np.median(turn)) / max(turn_rad, 1e-6)


def _legs(points: Floats, curve: SeamCurve, faces: Faces, sides: _Sides, scale: Scale) -> Floats:
    """How far each face reaches (2, S), mm, at most 12 cells."""
    reach = 12 * scale.cell
    _, station, offset = nearest_stations(points, curve, reach)
    outward = np.einsum("kij,ij->ki", faces.outward[:, station], offset)
    height = np.einsum("kij,ij->ki", faces.normal[:, station], offset)
    width = max(2.0 * scale.spacing, scale.cell / 3)
    bins = int(reach / width)
    bend = sides.coefficients[..., 2]
    legs = np.empty((2, len(curve)))
    for side in range(2):
        off = height[side] - np.clip(bend[side], -0.2 / reach, 0.2 / reach)[station] * outward[side] ** 2
        tolerance = 4 * sides.noise[side] + 0.06 * np.abs(outward[side]) + 0.02 * scale.cell
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


def _faces(curve: SeamCurve, first: Floats, second: Floats, concave: bool) -> Faces:
    """Directions of both faces in the cross-sections of a curve, from their normals (S, 3)."""
    normals = []
    for normal in (first, second):
        normals.append(_unit(normal - (normal * curve.along).sum(axis=1)[:, None] * curve.along))
    outward = []
    for mine, other in (normals, normals[::-1]):
        way = np.cross(mine, curve.along)
        sign = np.sign((way * other).sum(axis=1)) * (1.0 if concave else -1.0)
        outward.append(way * np.where(sign == 0, 1.0, sign)[:, None])
    return Faces(np.stack(outward), np.stack(normals))


def _main_run(shown: Flags, bridge: int) -> tuple[int, int] | None:
    """First and behind the last station of the longest run that shows the seam; interruptions are bridged."""
    if shown.sum() < 4:
        return None
    at = np.flatnonzero(shown)
    breaks = np.flatnonzero(np.diff(at) > max(bridge, 1) + 1)
    starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(at) - 1]])
    sizes = ends - starts
    best = int(np.argmax(sizes))
    first, last = int(at[starts[best]]), int(at[ends[best]]) + 1
    return (first, last) if last - first >= 4 and shown[first:last].mean() > 0.4 else None


def _cut(curve: SeamCurve, faces: Faces, sides: _Sides, here: slice) -> tuple[SeamCurve, Faces, _Sides]:
    part = SeamCurve(curve.stations[here], curve.step_mm, curve.along[here], curve.across[here], curve.up[here])
    less = replace(
        sides,
        coefficients=sides.coefficients[:, here],
        covariance=sides.covariance[:, here],
        coverage=sides.coverage[:, here],
        purity=sides.purity[:, here],
    )
    return part, Faces(faces.outward[:, here], faces.normal[:, here]), less


def _smooth(curve: SeamCurve, length_mm: float, stations: Floats, up: Floats) -> SeamCurve:
    even = np.ones(len(stations))
    line = smooth_along(stations, even, length_mm, curve.step_mm)
    return build_curve(line, smooth_along(up, even, length_mm, curve.step_mm), curve.step_mm)


def _prolonged(curve: SeamCurve, faces: Faces, reach_mm: float) -> tuple[SeamCurve, Faces]:
    longer = extended(curve, reach_mm, reach_mm, base_mm=4 * reach_mm)
    place = cKDTree(curve.stations).query(longer.stations)[1]
    outward = faces.outward[:, place]
    normal = faces.normal[:, place]
    normal = _unit(normal - np.einsum("ksi,si->ks", normal, longer.along)[..., None] * longer.along)
    outward = outward - np.einsum("ksi,si->ks", outward, longer.along)[..., None] * longer.along
    outward = _unit(outward - np.einsum("ksi,ksi->ks", outward, normal)[..., None] * normal)
    return longer, Faces(outward, normal)


def _is_ring(path: Floats, scale: Scale) -> bool:
    """Whether a path (M, 3) comes back to where it began."""
    if len(path) < 8:
        return False
    away = np.linalg.norm(path - path[0], axis=1)
    return bool(away[-1] < 2.5 * scale.cell and away.max() > 4 * scale.cell)


def _wrapped(line: Floats, count: int) -> Floats:
    return np.concatenate([line[-count:], line, line[:count]])


def _unwrapped(fit: JointFit, scale: Scale) -> JointFit:
    """One round of a ring that was fitted with its ends lying over each other."""
    root = fit.root
    away = np.linalg.norm(root - root[0], axis=1)
    far = int(np.argmax(away > 3 * scale.cell))
    back = far + int(np.argmin(away[far:]))
    if far == 0 or away[back] > 2 * scale.cell:
        return replace(fit, closed=False)
    here = slice(0, back)
    curve = fit.curve
    part = SeamCurve(curve.stations[here], curve.step_mm, curve.along[here], curve.across[here], curve.up[here])
    return replace(
        fit, curve=part, root=root[here], sigma_mm=fit.sigma_mm[here], normals=fit.normals[here],
        faces=Faces(fit.faces.outward[:, here], fit.faces.normal[:, here]), turn_rad=fit.turn_rad[here],
        turn_sigma_rad=fit.turn_sigma_rad[here], legs_mm=fit.legs_mm[:, here], shown=fit.shown[here],
    )  # fmt: skip


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))
