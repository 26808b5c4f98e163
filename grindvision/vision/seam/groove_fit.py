"""One groove along a valley: sections fitted station by station, the line moved onto them and prolonged to its ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial import cKDTree

from grindvision.geometry import inverse, move_points
from grindvision.vision.seam.groove_lines import (
    SHARP,
    DetectedGroove,
    FittedSections,
    groove_lines,
    one_round,
    weights_of,
)
from grindvision.vision.seam.groove_profile import (
    DEPTH,
    LEFT,
    LEVEL,
    RIGHT,
    ROOT,
    TILT,
    Corners,
    ProfileFit,
    Sections,
    fit_profiles,
    gather_sections,
    profile_height,
)
from grindvision.vision.seam.seam_curve import SeamCurve, build_curve, closed_runs, extended, lay_straight
from grindvision.vision.seam.seam_smoothing import smooth_along
from grindvision.vision.seam.valley import Valley

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: A groove's width is at least so many point spacings.
MIN_POINTS_ACROSS = 4.0
#: Walls fall at least so steeply: depth over half the width (11 degrees).
MIN_WALL_SLOPE = 0.2
#: Where less than this fraction of the length shows the surface on both sides, walls must be this steep: the outline of
#: a gently bent surface looks like one wall.
MIN_BOTH_SIDES, ONE_SIDED_WALL_SLOPE = 0.3, 0.5
#: A groove is at least so many widths long.
MIN_LENGTH = 2.0
#: A station belongs to the groove while its depth is above this fraction of the median depth.
MIN_DEPTH_FRACTION = 0.5
#: Between two parts of a groove its edges may go on above a tack weld, where this fraction of the depth is left.
TACKED_DEPTH_FRACTION = 0.2
#: A section's misfit is at most so many times the usual one; below the first fraction of the depth it is always good
#: enough, above the second never.
MAX_FIT_RATIO, MIN_FIT_FRACTION, MAX_FIT_FRACTION = 3.0, 0.03, 0.12
#: The surface beside the groove stays so near to the curve that was laid through it: fraction of the depth, and slope.
MAX_LEVEL_FRACTION, MAX_TILT = 0.6, 0.4
#: The root lies so near to the middle, in fractions of the width, and a section's width so near to the groove's.
MAX_SKEW, MAX_WIDTH_RATIO = 0.3, 1.6
#: The root of a groove with one upright wall lies below its edge.
MAX_SKEW_OF_BEVEL = 0.5
#: Floors (half of them) and roundings tried, in fractions of the width, on so many sections at most; a shape is taken
#: if what it misses is less than this fraction of what a simpler one does.
CORNER_FRACTIONS, MAX_SECTIONS_TRIED, CLEARLY_BETTER = (0.08, 0.16, 0.24, 0.32, 0.4), 32, 0.85
#: Passes of fitting and prolonging at most.
_PASSES = 10


def fit_groove(
    cloud: Floats,
    T_field_cloud: Floats,
    valley: Valley,
    spacing_mm: float,
    known: Sequence[DetectedGroove] = (),
    bevel: bool = False,
) -> DetectedGroove | None:
    """Fit edges and root along a valley; None where no V-groove fits it, or with ``bevel`` one with an upright wall.

    It ends where it meets one of the ``known`` grooves: the arms of a crossing are grooves of their own, however narrow
    the groove between them.
    """
    width = 1.3 * max(valley.width_mm, MIN_POINTS_ACROSS * spacing_mm)
    depth = valley.depth_mm
    noise = 0.05 * depth
    step = _step(width, spacing_mm)
    path = build_curve(valley.path, np.array([0.0, 0.0, 1.0]), step)
    curve = build_curve(smooth_along(path.stations, np.ones(len(path)), width / 2, step), path.up, step)
    margin = int(width / step)
    if len(curve) > 4 * margin + 4:
        curve = _part(curve, margin, len(curve) - margin)
    length, ring = 0.0, False
    corners = Corners(SHARP * width, SHARP * width)
    for number in range(_PASSES):
        if not ring:
            curve = extended(curve, 1.5 * width, 1.5 * width, base_mm=3 * width)
        reach = 1.2 * width
        strip = lay_straight(cloud, T_field_cloud, curve, reach, 2.2 * depth, 1.2 * depth)
        sections = gather_sections(strip, len(curve), curve.step_mm, reach, width / 24, width / 5)
        start = np.tile([0, 0, 0, depth, -width / 2, 0, width / 2], (len(curve), 1))
        prior_sigma = np.array([depth / 2, 0.5, 0.3 * depth / reach**2, depth, width / 2, width / 3, width / 2])
        if number in (1, 2):
            corners = _corners(sections, start, prior_sigma, width, noise)
        fit = fit_profiles(sections, start, prior_sigma, corners, noise)
        free = ~_taken(move_points(inverse(T_field_cloud), curve.stations), known)
        skew = MAX_SKEW_OF_BEVEL if bevel else MAX_SKEW
        inside = _stations_inside(fit, sections, width, depth, (1.0 if number > 1 else 2.5, skew), free)
        if inside is None:
            return None
        first, last = inside
        good = fit.parameters[first:last]
        width = float(np.median(good[:, RIGHT] - good[:, LEFT]))
        depth = float(np.median(good[:, DEPTH]))
        if not _is_groove(width, depth, (last - first) * curve.step_mm, spacing_mm):
            return None
        noise = float(np.clip(2 * np.median(fit.noise_mm[first:last]), 0.01 * depth, 0.1 * depth))
        grown = (last - first) * curve.step_mm - length
        length += grown
        if (number >= 2 and (ring or abs(grown) < 2 * curve.step_mm)) or number == _PASSES - 1:
            break
        curve = _recentred(curve, fit, first, last, width, _step(width, spacing_mm))
        turns, ring = one_round(curve.stations, width)
        curve = _part(curve, 0, turns) if ring else curve
    fitted = FittedSections(curve, strip, sections, fit, prior_sigma, noise, first, last)
    groove = groove_lines(fitted, T_field_cloud, spacing_mm)
    if groove is None or (groove.edges_seen < MIN_BOTH_SIDES and depth < ONE_SIDED_WALL_SLOPE * width / 2):
        return None
    return groove


def _part(curve: SeamCurve, first: int, last: int) -> SeamCurve:
    return build_curve(curve.stations[first:last], curve.up[first:last], curve.step_mm)


def _taken(stations: Floats, known: Sequence[DetectedGroove]) -> Flags:
    """Which of the stations (S, 3), in the cloud's frame, lie between the edges of known grooves."""
    taken = np.zeros(len(stations), dtype=bool)
    for groove in known:
        away, nearest = cKDTree((groove.left + groove.right) / 2).query(stations)
        taken |= away < groove.width_mm[nearest] / 2
    return taken


def _step(width: float, spacing: float) -> float:
    return max(1.5 * spacing, width / 12)


def _is_groove(width: float, depth: float, length: float, spacing: float) -> bool:
    return width >= MIN_POINTS_ACROSS * spacing and depth >= MIN_WALL_SLOPE * width / 2 and length >= MIN_LENGTH * width


def _corners(sections: Sections, start: Floats, prior_sigma: Floats, width: float, noise: float) -> Corners:
    """Floor and rounding that fit the sections best; a sharp V unless something else clearly helps.

    What a wrong shape misses lies at the same place in all sections; their residuals are averaged there, so that noise
    hides no rounding.
    """
    pick = np.linspace(0, len(start) - 1, min(MAX_SECTIONS_TRIED, len(start))).astype(int)
    sample = Sections(sections.across[pick], sections.up[pick], sections.weight[pick], sections.bin_mm)

    def misfit(corners: Corners) -> float:
        fit = fit_profiles(sample, start[pick], prior_sigma, corners, noise)
        off = sample.up - profile_height(sample.across, fit.parameters, corners)
        usual = fit.noise_mm < 2 * np.median(fit.noise_mm)
        weight = np.where(usual[:, None], sample.weight, 0)
        total = np.maximum(weight.sum(axis=0), 1e-9)
        return float(np.sqrt((total * ((weight * off).sum(axis=0) / total) ** 2).sum() / total.sum()))

    chosen = Corners(SHARP * width, SHARP * width)
    best = misfit(chosen)
    for corner in ("floor_mm", "root_mm", "edge_mm"):
        for fraction in CORNER_FRACTIONS:
            trial = replace(chosen, **{corner: fraction * width})
            value = misfit(trial)
            if value > best:
                break
            if value < CLEARLY_BETTER * best:
                best, chosen = value, trial
    return chosen


def _stations_inside(
    fit: ProfileFit, sections: Sections, width: float, depth: float, limits: tuple[float, float], free: Flags
) -> tuple[int, int] | None:
    """Longest run of stations (first, behind last) that show the groove; short gaps and tack welds are bridged.

    Stations that are not ``free`` (S,) end it. ``limits`` are a looseness, which widens all limits while the curve is
    not yet well placed, and how far off the middle the root may lie.
    """
    looseness, worst_skew = limits
    theta = fit.parameters
    widths = theta[:, RIGHT] - theta[:, LEFT]
    between = (sections.across > theta[:, LEFT, None]) & (sections.across < theta[:, RIGHT, None])
    points = np.where(between, sections.weight, 0).sum(axis=1)
    seen = points > 0.25 * np.median(points[points > 0]) if (points > 0).any() else points > 0
    deep, tacked = (theta[:, DEPTH] > fraction * depth for fraction in (MIN_DEPTH_FRACTION, TACKED_DEPTH_FRACTION))
    usual = float(np.median(fit.noise_mm[seen & deep])) if (seen & deep).any() else 0.0
    worst = np.clip(MAX_FIT_RATIO * usual, MIN_FIT_FRACTION * depth, MAX_FIT_FRACTION * depth)
    fitting = fit.noise_mm < worst
    sure = fit.deviation[:, DEPTH] < MIN_DEPTH_FRACTION * theta[:, DEPTH]
    near = (np.abs(theta[:, LEVEL]) < looseness * MAX_LEVEL_FRACTION * depth) & (
        np.abs(theta[:, TILT]) < looseness * MAX_TILT
    )
    place = (theta[:, ROOT] - theta[:, LEFT]) / widths
    shapely = (np.abs(place - 0.5) < worst_skew) & (
        np.abs(np.log(widths / width)) < looseness * np.log(MAX_WIDTH_RATIO)
    )
    edged = seen & sure & near & shapely & free
    shown = edged & deep & fitting
    if not shown.any():
        return None
    bridged = closed_runs(shown, 9) & free
    tacked &= edged
    names, _ = label(bridged | tacked)
    run = np.flatnonzero((names == np.argmax(np.bincount(names[bridged]))) & bridged)
    run = np.arange(run[0], run[-1] + 1)
    if (shown | tacked)[run].mean() < 0.6 or shown[run].mean() < 0.4 or len(run) < 4:
        return None
    return int(run[0]), int(run[-1]) + 1


def _recentred(curve: SeamCurve, fit: ProfileFit, first: int, last: int, width: float, step_mm: float) -> SeamCurve:
    """Stations ``first`` to ``last`` moved onto the surface above the root, up turned onto its normal, at a new step.

    Positions and directions are smoothed as they stand, not only their changes: a kink, once in the curve, would
    otherwise turn the sections there and come back worse in the next pass.
    """
    theta, step = fit.parameters[first:last], curve.step_mm

    def smooth(values: Floats, parameter: int, length: float) -> Floats:
        weight = weights_of(fit.deviation[first:last, parameter])
        return smooth_along(values, weight, length, step)

    displacement = smooth((theta[:, LEFT] + theta[:, RIGHT]) / 2, ROOT, width / 2)
    level, tilt = smooth(theta[:, LEVEL], LEVEL, width / 2), smooth(theta[:, TILT], TILT, width)
    here = slice(first, last)
    across, up = curve.across[here], curve.up[here]
    stations = curve.stations[here] + displacement[:, None] * across + (level + tilt * displacement)[:, None] * up
    # Continued with its bend before it is smoothed: a smoothed line would end straight, above a pipe's groove.
    raw = build_curve(stations, up - tilt[:, None] * across, step)
    longer = extended(raw, 2 * width, 2 * width, base_mm=3 * width)
    here = slice(int(2 * width / step), len(longer) - int(2 * width / step))
    even = np.ones(len(longer))
    stations, up = (smooth_along(line, even, width / 2, step)[here] for line in (longer.stations, longer.up))
    return build_curve(stations, up, step_mm)
