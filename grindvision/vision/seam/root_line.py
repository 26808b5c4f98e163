"""The root line of a corner through the places where its faces meet, station by station: as smooth as the noise asks
for, with its own standard deviation.

Neighbouring stations share the points of their windows, and a camera's errors are alike over some pixels: a line that
is smoothed as if its stations were independent follows the noise, and what it leaves is no measure of its error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from grindvision.geometry import unit_vectors, vector_angle
from grindvision.records import by_content
from grindvision.vision.seam.seam_curve import SeamCurve
from grindvision.vision.seam.seam_polynomial import fit_polynomial
from grindvision.vision.seam.seam_smoothing import GAP, MAD_TO_STD, TUKEY, smooth_along, smooth_to_noise

Floats = NDArray[np.float64]

#: Lines are looked at beside polynomials up to this degree, which follow an arc of half a turn to a thousandth of its
#: radius; a whole turn takes so many degrees more per turn.
MAX_DEGREE, DEGREES_PER_TURN = 5, 8
#: A line that bends more than its polynomial predicts its own gaps better by so many standard errors.
SURE = 2.5
#: At most one in so many stations is left out together when lines are judged by how they bridge gaps.
GAP_FRACTION = 4
#: At least this part of the stations' variance is taken to be left beside a line, however closely it follows them.
LEAST_LEFT = 0.02
#: A deviation told by the median of absolute values is as uncertain as the usual one of so many times as many; at least
#: so many are always counted.
MAD_EFFICIENCY, LEAST_FREE = 0.37, 3.0


@by_content
@dataclass(frozen=True)
class RootLine:
    """A line ``places`` (S, 3) in mm with ``sigma`` (S,), the standard deviation of its place across, in units of that
    of the single stations, and ``scatter``, by how much these scatter more than was promised."""

    places: Floats
    sigma: Floats
    scatter: float


@by_content
@dataclass(frozen=True)
class _Smoothed:
    """A line (S, 3), what the places lie beside it (S, 2); the projection (S, S) onto its polynomial and the lengths,
    mm, to which both directions were smoothed beside that; over how many stations errors are alike at least."""

    line: Floats
    beside: Floats
    left: tuple[Floats, float, float]
    alike: float


def smooth_root(curve: SeamCurve, displacement: Floats, weight: Floats, window: float) -> Floats:
    """The line (S, 3) through the places at ``displacement``, as ``root_line`` takes it."""
    return _smoothed(curve, displacement, weight, window).line


def root_line(curve: SeamCurve, displacement: Floats, weight: Floats, level: Floats, window: float) -> RootLine:
    """The line through the places at ``displacement`` (S, 2), across and up, from a curve's stations.

    Args:
        curve: S stations near the root, which may follow its noise.
        displacement: (S, 2), mm.
        weight: (S,) inverse variances up to a factor, 0 where nothing is known.
        level: (S,) promised standard deviations of the single places, mm.
        window: standard deviation, in stations, of the window along the seam in which each place was found.
    """
    smoothed = _smoothed(curve, displacement, weight, window)
    projection, *lengths = smoothed.left
    beside, shown = smoothed.beside / level[:, None], weight > 0
    alike = max(smoothed.alike, _alike_over(beside, shown))
    number = np.arange(len(curve))
    shared = np.exp(-np.pi * (np.subtract.outer(number, number) / alike) ** 2)
    rest = np.eye(len(curve)) - projection
    variance, squares, promised, free = np.zeros(len(curve)), [], [], 0.0
    for k, length_mm in enumerate(lengths):
        left = rest - smooth_along(rest, weight / weight.max(), length_mm, curve.step_mm)
        kept = np.eye(len(curve)) - left
        variance += np.einsum("ij,ij->i", kept @ shared, kept) / 2
        promised.append(max(float(np.median(np.einsum("ij,ij->i", left @ shared, left)[shown])), LEAST_LEFT))
        squares.append((MAD_TO_STD * np.median(np.abs(beside[shown, k]))) ** 2)
        free += MAD_EFFICIENCY * max(float(shown.sum() / alike - np.trace(kept)), 0.0)
    # A direction in which the line follows every station says nothing of their scatter.
    scatter = max(1.0, float(np.sqrt(np.sum(squares) / np.sum(promised))) * _student(free))
    return RootLine(smoothed.line, np.sqrt(np.clip(variance, 0.0, 1.0)), scatter)


def _student(free: float) -> float:
    """By how much more than a normal distribution's Student's 95 % reach, of a deviation that is known by so many
    independent values."""
    return float(stdtrit(max(free, LEAST_FREE), 0.975) / ndtri(0.975))


def _smoothed(curve: SeamCurve, displacement: Floats, weight: Floats, window: float) -> _Smoothed:
    places = curve.stations + displacement[:, :1] * curve.across + displacement[:, 1:] * curve.up
    # A Gaussian window of sigma w stations makes errors alike over 2 sqrt(pi) w of them.
    alike = 2 * np.sqrt(np.pi) * window
    most = _most(curve, alike)
    polynomial = fit_polynomial(places, weight, alike, (1, most, most))
    line, *ways = _frame(curve, polynomial.line)
    lengths, beside = [], []
    gap = max(GAP, min(int(np.ceil(2 * alike)), len(curve) // GAP_FRACTION))
    for way in ways:
        values = ((places - line) * way).sum(axis=1)
        smooth, length_mm = smooth_to_noise(values, weight, curve.step_mm, SURE, gap)
        line = line + smooth[:, None] * way
        lengths.append(length_mm)
        beside.append(values - smooth)
    left = polynomial.projection, lengths[0], lengths[1]
    return _Smoothed(line, np.stack(beside, axis=1), left, alike)


def _most(curve: SeamCurve, alike: float) -> int:
    """The highest degree: of more than ``MAX_DEGREE`` where the curve turns by more than half a turn."""
    along = curve.along[:: max(round(alike), 1)]
    turn = float(vector_angle(along[:-1], along[1:]).sum())
    return MAX_DEGREE + int(np.ceil(DEGREES_PER_TURN * max(turn / np.pi - 1.0, 0.0) / 2))


def _frame(curve: SeamCurve, line: Floats) -> tuple[Floats, Floats, Floats]:
    """A line (S, 3) beside a curve with its directions across and up, (S, 3) each."""
    along = unit_vectors(np.gradient(line, axis=0))
    up = smooth_along(curve.up, np.ones(len(line)), len(line) * curve.step_mm / 8, curve.step_mm)
    up = unit_vectors(up - (up * along).sum(axis=1)[:, None] * along)
    return line, np.cross(up, along), up


def _alike_over(left: Floats, shown: NDArray[np.bool_]) -> float:
    """Over how many stations what is left (S, 2) is alike: the integral of its correlation up to its first zero."""
    limit = MAD_TO_STD * float(np.median(np.abs(left[shown]))) * TUKEY
    clipped = np.where(shown[:, None], np.clip(left, -limit, limit), 0.0)
    total = float((clipped**2).sum())
    if total <= 0:
        return 1.0
    result = 1.0
    for lag in range(1, len(left) // 2):
        correlation = float((clipped[lag:] * clipped[:-lag]).sum()) / total
        if correlation < 0:
            break
        result += 2 * correlation
    return result
