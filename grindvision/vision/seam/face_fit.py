"""The two faces beside a seam: at every station each is a parabola over the distance from the seam.

Each parabola is fitted robustly to the points of a window along the seam. The faces' intersection, extrapolated from
both sides, does not care for a bead, a tack or a blurred corner right at the seam.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d, gaussian_filter1d

from grindvision.geometry import unit_vectors
from grindvision.records import by_content
from grindvision.vision.seam.face_kernels import biweights, misses, station_sums
from grindvision.vision.seam.seam_curve import SeamCurve, nearest_stations
from grindvision.vision.seam.seam_polynomial import fit_polynomial
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Rounds of lowering the weights of points that stand out; Tukey's biweight gives up beyond so many deviations.
ROUNDS, TUKEY = 5, 4.7
#: Scans without noise have that of their numbers.
MIN_NOISE_MM = 1e-4
#: Where a face is less even than elsewhere, it may scatter so many times as much as usual.
LOCAL = 3.0
#: Points at first belong to a face up to this slope off it.
MAX_SLOPE_OFF = 0.6
#: A face bends if a parabola leaves less than this fraction of what a straight line leaves, or if, once the seam is
#: found, both differ at the root by more than so many times what the noise of the bend does.
CLEARLY_BENT, CLEARLY_APART = 0.9, 3.0
#: The curvature of a face changes along the seam as a polynomial up to this degree. Stations whose variance is so many
#: times the usual one do not count.
MAX_BEND_DEGREE, MAX_VARIANCES = 4, 25.0
#: A rounded corner is left out up to this part of the reach of the fit.
MAX_ROUNDING = 0.45
#: Faces are fitted up to so many cells from the seam.
FAR_CELLS = 4.5


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
        return max(1.5 * self.spacing + 2.0 * self.noise, min(self.rounding, MAX_ROUNDING * self.far))

    @property
    def far(self) -> float:
        """Faces are fitted up to here."""
        return FAR_CELLS * self.cell


@by_content
@dataclass(frozen=True)
class Faces:
    """Two faces at S stations: unit directions along each face away from the seam and normals, (2, S, 3) each."""

    outward: Floats
    normal: Floats

    def part(self, here: slice) -> Faces:
        """The same faces at some of the stations."""
        return Faces(self.outward[:, here], self.normal[:, here])


@by_content
@dataclass(frozen=True)
class FaceFit:
    """Parabolas of both faces at S stations: coefficients (2, S, 3), covariances (2, S, 3, 3), and their points.

    ``bend_sigma`` (2,) is the standard deviation of a face's curvature over all stations, by how it scatters.
    ``single`` (2, S) are the slopes at the seam of the parabolas before their curvature was steadied along it,
    ``round`` parabolas (2, S, 3) and their covariances (2, S, 3, 3) before that, also of a face that is taken as even.
    """

    coefficients: Floats
    covariance: Floats
    noise: Floats
    bent: tuple[bool, bool]
    coverage: Floats
    inside: tuple[Integers, Integers]
    purity: Floats
    bend_sigma: Floats
    single: Floats
    round: tuple[Floats, Floats]

    def part(self, here: slice) -> FaceFit:
        """The same parabolas at some of the stations."""
        return replace(
            self,
            coefficients=self.coefficients[:, here],
            covariance=self.covariance[:, here],
            coverage=self.coverage[:, here],
            purity=self.purity[:, here],
            single=self.single[:, here],
            round=(self.round[0][:, here], self.round[1][:, here]),
        )


def faces_beside(curve: SeamCurve, first: Floats, second: Floats, concave: bool) -> Faces:
    """Directions of both faces in the cross-sections of a curve, from their normals (S, 3)."""
    normals = []
    for normal in (first, second):
        normals.append(unit_vectors(normal - (normal * curve.along).sum(axis=1)[:, None] * curve.along))
    outward = []
    for mine, other in (normals, normals[::-1]):
        way = np.cross(mine, curve.along)
        sign = np.sign((way * other).sum(axis=1)) * (1.0 if concave else -1.0)
        outward.append(way * np.where(sign == 0, 1.0, sign)[:, None])
    return Faces(np.stack(outward), np.stack(normals))


def fit_faces(
    points: Floats, curve: SeamCurve, faces: Faces, scale: Scale, bent_sides: tuple[bool, bool] | None = None
) -> FaceFit | None:
    """Parabolas of both faces at every station, fitted over a window along the seam; ``bent_sides`` says which of the
    faces bend, where that is known."""
    index, station, offset = nearest_stations(points, curve, 1.3 * scale.far)
    if len(index) < 20:
        return None
    outward = np.einsum("kij,ij->ki", faces.outward[:, station], offset)
    height = np.einsum("kij,ij->ki", faces.normal[:, station], offset)
    nearer = outward[0] > outward[1]
    window = window_mm(scale) / curve.step_mm
    count = len(curve)
    results, rounds, bent, inside, coverage, purity, bend_sigma, single = [], [], [], [], [], [], [], []
    for side in range(2):
        mine = (nearer if side == 0 else ~nearer) & (outward[side] > scale.near) & (outward[side] < scale.far)
        mine &= np.abs(height[side]) < MAX_SLOPE_OFF * outward[side] + 3 * scale.noise
        if mine.sum() < 12:
            return None
        at, a, e = station[mine], outward[side][mine], height[side][mine]
        flat = _parabola(at, a, e, count, window, 2)
        round_ = _parabola(at, a, e, count, window, 3)
        rounds.append(round_[:2])
        is_bent = round_[2] < CLEARLY_BENT * flat[2] if bent_sides is None else bent_sides[side]
        coefficients, covariance, noise, weights = round_ if is_bent else flat
        scatter = 0.0
        single.append(coefficients[:, 1].copy())
        if is_bent:
            raw = coefficients[:, 2]
            coefficients, covariance = _steadily_bent(coefficients, covariance, 2 * np.sqrt(np.pi) * window)
            scatter = MAD_TO_STD * float(np.median(np.abs(raw - coefficients[:, 2])))
        bend_sigma.append(scatter * np.sqrt(2 * np.sqrt(np.pi) * window / count))
        results.append((coefficients, covariance, noise))
        bent.append(bool(is_bent))
        near = a < scale.near + 1.5 * scale.cell
        on = weights > 0
        good = np.bincount(at[on & near], minlength=count).astype(float)
        every = np.bincount(at[near], minlength=count).astype(float)
        coverage.append(good)
        purity.append(gaussian_filter1d(good, 1.0) / np.maximum(gaussian_filter1d(every, 1.0), 1e-9))
        inside.append(index[mine][on])
    return FaceFit(
        np.stack([one[0] for one in results]),
        np.stack([one[1] for one in results]),
        np.array([one[2] for one in results]),
        (bent[0], bent[1]),
        np.stack(coverage),
        (inside[0], inside[1]),
        np.stack(purity),
        np.array(bend_sigma),
        np.stack(single),
        (np.stack([one[0] for one in rounds]), np.stack([one[1] for one in rounds])),
    )


def window_mm(scale: Scale) -> float:
    """Standard deviation, mm, of the window along the seam over which faces are fitted."""
    return max(1.2 * scale.cell, 2.0 * scale.spacing)


def intersections(curve: SeamCurve, faces: Faces, sides: FaceFit) -> tuple[Floats, Floats]:
    """Where the faces meet: shift (S, 2) across and up from every station, and the faces' slopes there (2, S)."""
    basis = np.stack([curve.across, curve.up], axis=1)
    outward = np.einsum("sij,ksj->ksi", basis, faces.outward)
    normal = np.einsum("sij,ksj->ksi", basis, faces.normal)
    displacement = np.zeros((len(curve), 2))
    for _ in range(4):
        a = np.einsum("ksi,si->ks", outward, displacement)
        value = sides.coefficients[..., 0] + (sides.coefficients[..., 1] + sides.coefficients[..., 2] * a) * a
        slope = sides.coefficients[..., 1] + 2 * sides.coefficients[..., 2] * a
        rows = normal - slope[..., None] * outward
        right = value - slope * a
        matrix = rows.transpose(1, 0, 2)
        determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
        safe = np.where(np.abs(determinant) < 1e-3, 1e-3, determinant)
        displacement = np.stack(
            [
                (right[0] * matrix[:, 1, 1] - right[1] * matrix[:, 0, 1]) / safe,
                (right[1] * matrix[:, 0, 0] - right[0] * matrix[:, 1, 0]) / safe,
            ],
            axis=1,
        )
    a = np.einsum("ksi,si->ks", outward, displacement)
    return displacement, sides.coefficients[..., 1] + 2 * sides.coefficients[..., 2] * a


def unseen_bend(sides: FaceFit, window: float) -> Floats:
    """How far (2, S), mm, a bend that does not show station by station moves the level of each face at the root, less
    what the noise of the bend alone would.

    The waviness of a plate and of a camera bend a face by less than its noise, alike over many stations. ``window``: of
    the fit along the seam, in stations.
    """
    moved = np.zeros(sides.coefficients.shape[:2])
    for side in np.flatnonzero(~np.array(sides.bent)):
        squared, noise, _ = _by_bend(sides, int(side), window)
        moved[side] = np.sqrt(np.maximum(squared - noise, 0.0))
    return moved


def bent_at_root(sides: FaceFit, window: float) -> tuple[bool, bool]:
    """Which faces bend, also those whose bend moves their level at the root by clearly more than its noise would: over
    few rows of points a bend stands out of that long before it shows in what a straight line leaves.

    Noise counts as much more as the curvatures of the single stations scatter more than promised.
    """
    found = [*sides.bent]
    for side in np.flatnonzero(~np.array(sides.bent)):
        squared, noise, more = _by_bend(sides, int(side), window)
        found[side] = bool(np.median(squared) > CLEARLY_APART**2 * more * np.median(noise))
    return found[0], found[1]


def _by_bend(sides: FaceFit, side: int, window: float) -> tuple[Floats, Floats, float]:
    """Squares (S,) by how much a face's level at the root changes where it is a parabola, the part of the noise of its
    bend in them (S,), and by how much more than promised the square of that noise is."""
    coefficients, covariance = (one[side] for one in sides.round)
    steady, left = _steadily_bent(coefficients, covariance, 2 * np.sqrt(np.pi) * window)
    variance = np.maximum(covariance[:, 2, 2], 1e-300)
    noise = covariance[:, 0, 2] ** 2 / variance - (covariance[:, 0, 0] - left[:, 0, 0])
    scatter = MAD_TO_STD * float(np.median(np.abs(coefficients[:, 2] - steady[:, 2])))
    more = max(scatter**2 / float(np.median(variance)), 1.0)
    return (steady[:, 0] - sides.coefficients[side, :, 0]) ** 2, noise, more


def root_normals(faces: Faces, slopes: Floats) -> Floats:
    """Unit normals (2, S, 3) of the faces at the root."""
    return unit_vectors(faces.normal - slopes[..., None] * faces.outward)


def _parabola(
    at: Integers, a: Floats, e: Floats, count: int, window: float, terms: int
) -> tuple[Floats, Floats, float, Floats]:
    """Coefficients (S, 3) of e over a at every station, covariances (S, 3, 3), scatter, and the points' weights.

    Within the window a face may also rise evenly along the seam, or at the ends, where the window reaches to one side,
    a seam that bends away from the curve would be drawn towards it.
    """
    powers = np.stack([a**k for k in range(5)])
    weights, noise = np.ones(len(a)), 0.0
    coefficients, covariance = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for _ in range(ROUNDS):
        level, right = station_sums(at, powers, e, weights, count)
        right = right[:terms]
        normal = np.empty((count, terms + 1, terms + 1))
        even, rising = _over_window(level, window, 0), _over_window(level[:terms], window, 1)
        for i in range(terms):
            normal[:, i, :terms] = even[i : i + terms].T
            normal[:, i, terms] = normal[:, terms, i] = rising[i]
        normal[:, terms, terms] = _over_window(level[0], window, 2)
        sides = np.concatenate([_over_window(right, window, 0), _over_window(right[:1], window, 1)])
        scale = np.sqrt(np.maximum(np.einsum("sii->si", normal), 1e-12))
        normal = normal / scale[:, :, None] / scale[:, None, :] + 1e-6 * np.eye(terms + 1)
        inverse = (np.linalg.inv(normal) / scale[:, :, None] / scale[:, None, :])[:, :terms]
        coefficients[:, :terms] = np.einsum("sij,js->si", inverse, sides)
        off, squares = misses(at, powers, e, weights, coefficients, terms)
        known = weights > 0
        noise = max(float(MAD_TO_STD * np.median(np.abs(off[known]))) if known.any() else 0.0, MIN_NOISE_MM)
        spread = gaussian_filter1d(np.stack([level[0], squares]), window, axis=1)
        local = np.clip(np.sqrt(spread[1] / np.maximum(spread[0], 1e-9)), noise, LOCAL * noise)
        weights = biweights(at, off, TUKEY * local)
    # A Gaussian window of sigma w stations counts as 2 sqrt(pi) w of them.
    covariance[:, :terms, :terms] = inverse[:, :, :terms] * noise**2 / (np.sqrt(2.0))
    return coefficients, covariance, noise, weights


def _steadily_bent(coefficients: Floats, covariance: Floats, alike: float) -> tuple[Floats, Floats]:
    """Parabolas (S, 3) whose curvature changes along the seam only as far as their scatter tells, with covariances.

    The curvature of a single window carries the noise that neighbouring points share to the root many times enlarged.
    ``alike`` stations are as good as a single one.
    """
    variance = np.maximum(covariance[:, 2, 2], 1e-300)
    known = np.where(covariance[:, 2, 2] < MAX_VARIANCES * np.median(variance), 1 / variance, 0.0)
    steady = fit_polynomial(coefficients[:, 2:], known, alike, (0, MAX_BEND_DEGREE, MAX_BEND_DEGREE))
    share = covariance[:, :, 2] / variance[:, None]
    coefficients = coefficients + share * (steady.line - coefficients[:, 2:])
    kept = min((steady.degree + 1) * alike / len(coefficients), 1.0)
    covariance = covariance - (1 - kept) * variance[:, None, None] * share[:, :, None] * share[:, None, :]
    return coefficients, covariance


def _over_window(sums: ArrayLike, window: float, power: int) -> Floats:
    """Sums (..., S) over a Gaussian window about every station, weighted by the distance along the seam, in stations,
    to this power; nothing lies beyond the ends."""
    reach = int(3.0 * window + 0.5)
    steps = np.arange(-reach, reach + 1)
    bell = np.exp(-0.5 * (steps / window) ** 2)
    return np.asarray(correlate1d(sums, steps**power * bell / bell.sum(), axis=-1, mode="constant"))
