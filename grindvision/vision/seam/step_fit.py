"""Seams where one surface ends over or beside another: the step of a lap joint and the gap of a butt joint.

Both surfaces are fitted along the seam as faces that lead away from it; what is looked for is not where they meet but
where each of them ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from grindvision.records import by_content
from grindvision.vision.seam.face_fit import MIN_NOISE_MM, Scale
from grindvision.vision.seam.root_line import root_line
from grindvision.vision.seam.seam_curve import SeamCurve, build_curve, closed_runs, extended, nearest_stations
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD, smooth_along

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Points of a wall lie between these fractions of the step's height.
WALL_HEIGHTS = 0.2, 0.8
#: A share of few points is uncertain by so many standard errors, reckoned with so many points more, half of each kind.
LEAST_SHARE, ADDED = 2.0, 4
#: The bottom of a gap lies as deep as this percentile of the points in it.
DEEPEST = 90
#: With so many points on the wall per station its place is taken from them, otherwise from where the surfaces end.
MIN_WALL_POINTS = 0.5
#: A step goes on while more than this fraction of what lies beside it is up there: beyond a plate's corner it is gone.
MIN_HIGH = 0.5
#: A step that is there along this part of what a line was prolonged by is followed twice as far in the next pass: few
#: pairs of surfels may show a short part of a long edge.
FOLLOWED = 0.8
#: Passes of fitting and prolonging: at least, and while the seam still grows.
MIN_PASSES, MAX_PASSES = 3, 40
#: Bins in which the heights beside a gap show whether the surfaces fall towards it.
FALL_BINS = 10
#: Rounds of the robust lines, and when a residual no longer counts.
ROUNDS, TUKEY = 4, 4.0


@by_content
@dataclass(frozen=True)
class EdgeFit:
    """Two surfaces beside a seam at S stations of ``curve``; its ``up`` is the lower surface's normal.

    ``root`` (S, 3) mm: on the lower surface under the upper one's edge, or half-way across a gap; ``sigma_mm`` (S,) of
    its distance, ``edge_sigma_mm`` of the edges' places across the seam. ``edges`` (2, S, 3) are where the two surfaces
    end (the upper one first), ``step_mm`` (S,) the first one's height above the second at the seam, ``gap_mm`` (S,) the
    distance between the edges, ``gap_sigma_mm`` its standard deviation. ``normals`` (2, S, 3) are the surfaces',
    ``shown`` (S,) where both are seen, ``noise_mm`` their scatter, ``members`` (K,) the points beside the seam,
    ``between`` (S,) the number of points inside the gap or on the wall, ``way`` (S, 3) leads from the upper surface to
    the lower one. ``fall_rad`` is by how much both surfaces together turn down where they end: next to nothing for two
    plates, a lot for two tubes. ``on_walls`` is the least fraction, for all that their number tells, of the points in a
    gap that lie neither near its surfaces nor near its bottom.
    """

    curve: SeamCurve
    root: Floats
    sigma_mm: Floats
    edge_sigma_mm: float
    edges: Floats
    step_mm: Floats
    gap_mm: Floats
    gap_sigma_mm: float
    normals: Floats
    shown: Flags
    noise_mm: float
    members: Integers
    between: Floats
    way: Floats
    fall_rad: float = 0.0
    on_walls: float = 0.0

    @property
    def length_mm(self) -> float:
        """Length of the root line."""
        return float(np.linalg.norm(np.diff(self.root, axis=0), axis=1).sum())


def fit_step(
    points: Floats, path: Floats, way: Floats, up: Floats, height_mm: float | None, scale: Scale
) -> EdgeFit | None:
    """Fit a step, or a gap, along a rough path; None where no surface ends over another along most of it.

    Args:
        points: cloud (N, 3), mm.
        path: rough seam (M, 3) on the lower surface.
        way: (M, 3) from the upper surface to the lower one.
        up: (M, 3) the surfaces' normals.
        height_mm: rough height of the step; None for a gap between two surfaces of one level.
        scale: lengths of the scan.
    """
    step = max(1.5 * scale.spacing, scale.cell / 2)
    curve = _straightened(path, up, step, 2 * scale.cell)
    side = 1.0 if np.mean((curve.across * way[_nearest(path, curve.stations)]).sum(axis=1)) > 0 else -1.0
    length, growing, reach = 0.0, True, 3 * scale.cell
    for number in range(MAX_PASSES):
        if 0 < number < MAX_PASSES - 1 and growing:
            curve = extended(curve, reach, reach, base_mm=max(12 * scale.cell, 2 * reach))
        found = _edges(points, curve, side, height_mm, scale)
        if found is None:
            return None
        run = np.flatnonzero(found.shown)
        if len(run) < 4:
            return None
        first, last = int(run[0]), int(run[-1]) + 1
        if found.shown[first:last].mean() < 0.5 or (height_mm is not None and not height_mm > scale.spacing / 2):
            return None
        height_mm = None if height_mm is None else float(np.median(found.step_mm[found.shown]))
        grown = (last - first) * curve.step_mm - length
        length += grown
        if number == MAX_PASSES - 1 or (number >= MIN_PASSES and not growing):
            return _part(found, slice(first, last), height_mm is None)
        growing = abs(grown) > scale.cell / 2
        if number > 0 and grown > FOLLOWED * 2 * reach:
            reach *= 2
        lateral = smooth_along(found.across, found.weight, 2 * scale.cell, curve.step_mm, robust=True)
        level = smooth_along(found.level, found.weight, 2 * scale.cell, curve.step_mm, robust=True)
        tilt = smooth_along(found.tilt, found.weight, 4 * scale.cell, curve.step_mm, robust=True)
        stations = curve.stations + lateral[:, None] * curve.across + level[:, None] * curve.up
        turned = curve.up - tilt[:, None] * curve.across
        curve = build_curve(stations[first:last], turned[first:last], curve.step_mm)
    return None


@by_content
@dataclass(frozen=True)
class _Edges:
    """What ``_edges`` found at S stations, in the curve's coordinates; see ``EdgeFit``. ``common`` is the standard
    deviation of the root that all stations share: rows of points along an edge end alike, up to a spacing before it."""

    curve: SeamCurve
    across: Floats
    level: Floats
    tilt: Floats
    weight: Floats
    shown: Flags
    step_mm: Floats
    ends: Floats
    heights: Floats
    tilts: Floats
    sigma: float
    gap_sigma: float
    noise: float
    members: Integers
    between: Integers
    side: float
    fall_rad: float
    on_walls: float
    window: float
    common: float


def _edges(points: Floats, curve: SeamCurve, side: float, height_mm: float | None, scale: Scale) -> _Edges | None:
    index, station, offset = nearest_stations(points, curve, scale.far)
    if len(index) < 20:
        return None
    u = side * (offset * curve.across[station]).sum(axis=1)
    v = (offset * curve.up[station]).sum(axis=1)
    count, window = len(curve), 1.5 * scale.cell / curve.step_mm
    near = 0.5 * scale.cell if height_mm is None else scale.near
    height = height_mm or 0.0
    lines, noises, good, fall = [], [], [], 0.0
    for sign, level in ((-1.0, height), (1.0, 0.0)):
        mine = (sign * u > near) & (np.abs(v - level) < 0.25 * np.abs(u) + 0.3 * max(height, scale.cell / 3))
        if mine.sum() < 12:
            return None
        line, noise, on = _line(station[mine], u[mine], v[mine], count, window)
        lines.append(line)
        noises.append(noise)
        good.append(np.bincount(station[mine][on], minlength=count))
        fall += _fall_rad(np.abs(u[mine]), v[mine] - line[station[mine], 0], scale)
    noise = max(noises)
    upper, lower = (line[station, 0] + line[station, 1] * u for line in lines)
    gap_tolerance = 4 * noise + 0.02 * scale.cell
    if height_mm is not None:
        on_upper = v > upper - 0.2 * height
        fraction = (v - lower) / np.maximum(upper - lower, 1e-6)
        on_lower = fraction < WALL_HEIGHTS[0]
        on_upper &= fraction > WALL_HEIGHTS[1]
        between = (fraction > WALL_HEIGHTS[0]) & (fraction < WALL_HEIGHTS[1]) & (np.abs(u) < 1.2 * scale.cell)
    else:
        middle = u < 0
        on_upper, on_lower = middle & (np.abs(v - upper) < gap_tolerance), ~middle & (np.abs(v - lower) < gap_tolerance)
        between = (np.abs(u) < scale.cell) & (v < np.minimum(upper, lower) - gap_tolerance)
    ends = np.full((2, count), np.nan)
    for row, (on, sign) in enumerate(((on_upper, 1.0), (on_lower, -1.0))):
        ends[row] = sign * _extreme(station[on], sign * u[on], count)
    shown = np.isfinite(ends).all(axis=0)
    for counts in good:
        usual = np.median(counts[counts > 0])
        shown &= counts > 0.15 * usual
    if height_mm is not None:
        beside = (u < -near) & (u > -near - 1.5 * scale.cell)
        high = np.bincount(station[beside & (v - lower > height / 2)], minlength=count)
        shown &= high > MIN_HIGH * np.bincount(station[beside], minlength=count)
    shown = closed_runs(shown, 5)
    if shown.sum() < 4:
        return None
    per_station = np.bincount(station[between], minlength=count)
    on_walls = _on_walls((np.minimum(upper, lower) - v)[between])
    ends, spread, least = _smooth_ends(ends, shown, curve.step_mm, window)
    half = scale.spacing / 2
    common = np.sqrt(max(scale.spacing**2 / 12 - least**2, 0.0) / 2)
    if height_mm is None:
        across = ends.mean(axis=0)
    elif per_station[shown].mean() > MIN_WALL_POINTS:
        across, spread = _wall(station[between], u[between], per_station, count, window)
        common = 0.0
    else:
        hidden = ends[1] - ends[0] > 3 * scale.spacing
        across = np.where(hidden, ends[0] + half, ends.mean(axis=0))
    heights = np.stack([line[:, 0] + line[:, 1] * across for line in lines])
    samples = 2.5 * window
    spread = max(spread, scale.spacing / np.sqrt(12))
    beside = (np.abs(u) < scale.far / 2) & (on_upper | on_lower | between)
    return _Edges(
        curve, side * across, heights[1], side * lines[1][:, 1], np.where(shown, 1.0, 0.0), shown,
        heights[0] - heights[1], side * (ends + [[half], [-half]]), heights,
        side * np.stack([one[:, 1] for one in lines]),
        spread / np.sqrt(samples), spread * np.sqrt(2 / samples), noise, index[beside], per_station, side,
        fall, on_walls, window, common,
    )  # fmt: skip


def _on_walls(depth: Floats) -> float:
    """Fraction of the points of a gap, at depths (K,) below its surfaces, that lie away from these and its bottom: what
    it is at least, for all that so many points tell."""
    if not len(depth):
        return 0.0
    low, high = np.percentile(depth, DEEPEST) * np.array(WALL_HEIGHTS)
    share = (((depth > low) & (depth < high)).sum() + ADDED / 2) / (len(depth) + ADDED)
    return float(max(share - LEAST_SHARE * np.sqrt(share * (1 - share) / (len(depth) + ADDED)), 0.0))


def _line(at: Integers, u: Floats, v: Floats, count: int, window: float) -> tuple[Floats, float, Flags]:
    """Robust lines v = a + b u at every station: coefficients (S, 2), scatter, and the points that count."""
    weights, noise = np.ones(len(u)), 0.0
    line = np.zeros((count, 2))
    for _ in range(ROUNDS):
        sums = np.stack([np.bincount(at, weights * t, count) for t in (np.ones(len(u)), u, u * u, v, u * v)])
        n, su, suu, sv, suv = gaussian_filter1d(sums, window, axis=1, mode="constant", truncate=3.0)
        n = n + 1e-9
        variance = np.maximum(suu - su * su / n, 1e-9 * n)
        line[:, 1] = (suv - su * sv / n) / variance
        line[:, 0] = (sv - line[:, 1] * su) / n
        off = v - line[at, 0] - line[at, 1] * u
        noise = max(float(MAD_TO_STD * np.median(np.abs(off))), MIN_NOISE_MM)
        weights = np.maximum(1 - (off / (TUKEY * noise)) ** 2, 0) ** 2
    return line, noise, weights > 0


def _fall_rad(away: Floats, height: Floats, scale: Scale) -> float:
    """By how much a surface, of heights (K,) at distances (K,) from the seam, falls towards it where it ends, rad.

    Of the medians of bins over the distance: flying pixels at the edge are few in each.
    """
    bins = np.linspace(away.min(), scale.far, FALL_BINS + 1)
    number = np.digitize(away, bins) - 1
    rows = [number == k for k in range(FALL_BINS)]
    middle = np.array([[np.median(away[row]), np.median(height[row])] for row in rows if row.sum() > 8])
    if len(middle) < 5:
        return 0.0
    bend, slope, _ = np.polyfit(middle[:, 0], middle[:, 1], 2)
    return float(np.arctan(slope + 2 * bend * middle[0, 0]))


def _extreme(at: Integers, u: Floats, count: int) -> Floats:
    """Largest u (S,) at every station; NaN where there is no point."""
    result = np.full(count, -np.inf)
    np.maximum.at(result, at, u)
    return np.where(np.isfinite(result), result, np.nan)


def _smooth_ends(ends: Floats, shown: Flags, step: float, window: float) -> tuple[Floats, float, float]:
    """The two surfaces' ends (2, S) smoothed along the seam, and the larger and the smaller scatter of single
    stations."""
    result, scatter = np.empty_like(ends), []
    for row in range(2):
        values = np.where(np.isfinite(ends[row]), ends[row], 0.0)
        weight = np.where(np.isfinite(ends[row]) & shown, 1.0, 0.0)
        result[row] = smooth_along(values, weight, 2 * window * step, step, robust=True)
        off = (ends[row] - result[row])[weight > 0]
        scatter.append(float(MAD_TO_STD * np.median(np.abs(off))))
    return result, max(scatter), min(scatter)


def _wall(at: Integers, u: Floats, per_station: Integers, count: int, window: float) -> tuple[Floats, float]:
    """Place of the wall (S,) from the points on it, and their scatter."""
    weights, place, scatter = np.ones(len(u)), np.zeros(count), 0.0
    for _ in range(ROUNDS):
        sums = np.stack([np.bincount(at, weights, count), np.bincount(at, weights * u, count)])
        n, total = gaussian_filter1d(sums, window, axis=1, mode="constant", truncate=3.0)
        place = total / np.maximum(n, 1e-9)
        off = u - place[at]
        scatter = float(MAD_TO_STD * np.median(np.abs(off)))
        weights = np.maximum(1 - (off / max(TUKEY * scatter, 1e-3)) ** 2, 0) ** 2
    return place, scatter / np.sqrt(max(float(per_station.mean()), 0.3))


def _part(found: _Edges, here: slice, gap: bool) -> EdgeFit:
    curve = found.curve
    part = curve.part(here)
    level = found.heights[:, here].mean(axis=0) if gap else found.level[here]
    displacement = np.column_stack([found.across[here], level])
    promised = np.full(len(part), max(found.sigma, MIN_NOISE_MM))
    line = root_line(part, displacement, found.weight[here], promised, found.window)
    edges = np.stack(
        [
            part.stations + found.ends[k, here, None] * part.across + found.heights[k, here, None] * part.up
            for k in range(2)
        ]
    )
    normals = part.up - found.tilts[:, here, None] * part.across
    normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    width = np.abs(found.ends[1, here] - found.ends[0, here])
    sigma = np.hypot(np.sqrt(2.0) * line.scatter * line.sigma * promised, max(found.common, 1e-3))  # both directions
    return EdgeFit(
        part, line.places, sigma, found.sigma, edges, found.step_mm[here], width, found.gap_sigma, normals,
        found.shown[here], found.noise,
        np.unique(found.members), found.between[here].astype(float), found.side * part.across,
        found.fall_rad, found.on_walls,
    )  # fmt: skip


def _straightened(path: Floats, up: Floats, step: float, length_mm: float) -> SeamCurve:
    curve = build_curve(path, up, step)
    even = np.ones(len(curve))
    line = smooth_along(curve.stations, even, length_mm, curve.step_mm)
    return build_curve(line, smooth_along(curve.up, even, length_mm, curve.step_mm), step)


def _nearest(path: Floats, stations: Floats) -> Integers:
    away = np.linalg.norm(stations[:, None, :] - path[None], axis=2)
    return np.asarray(away.argmin(axis=1), dtype=np.int64)
