"""One groove along a valley: sections fitted station by station, the line moved onto them and prolonged to its ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, label

from grindvision.geometry import inverse, move_points, turn_vectors, vector_angle
from grindvision.vision.groove_profile import (
    BEND,
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
from grindvision.vision.seam_curve import SeamCurve, Strip, build_curve, extended, lay_straight, smooth_along
from grindvision.vision.valley import Valley

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: A groove's width is at least so many point spacings.
LEAST_POINTS_ACROSS = 4.0
#: Walls fall at least so steeply: depth over half the width (17 degrees).
LEAST_WALL_SLOPE = 0.3
#: A groove is at least so many widths long.
LEAST_LENGTH = 2.0
#: A station belongs to the groove while its depth is above this share of the median depth.
LEAST_DEPTH_SHARE = 0.5
#: The profile must fit the points to this share of the depth.
WORST_FIT_SHARE = 0.12
#: The surface beside the groove stays so near to the curve that was laid through it: share of the depth, and slope.
WORST_LEVEL_SHARE, WORST_TILT = 0.6, 0.4
#: The root lies so near to the middle, in shares of the width, and a section's width so near to the groove's.
WORST_SKEW, WORST_WIDTH_RATIO = 0.3, 1.6
#: A groove is at least so many standard deviations of its points' scatter deep.
LEAST_DEPTH_IN_SCATTER = 3.0
#: The middle of the last station at an end holds at least this share of the usual number of points.
COVERED_SHARE = 0.75
#: The two ends of a ring point the same way within this angle.
RING_TURN_RAD = np.radians(50)
#: Rounding of a sharp corner, in shares of the width: enough for derivatives, too little to see.
SHARP = 0.004
#: Passes of fitting and prolonging at most.
_PASSES = 10


@dataclass(frozen=True)
class DetectedGroove:
    """One groove: its points and its lines along the seam, in the cloud's frame, mm.

    ``members`` (K,) index the points of the cloud between its edges. At S stations, ``step_mm`` apart: ``root`` the
    line where the walls meet (of a blunt groove the depth-weighted middle), ``left`` and ``right`` the edges, and unit
    ``normals`` of the surface around, all (S, 3).
    ``width_mm`` and ``depth_mm`` (S,) are measured across and along the normals, ``root_deviation_mm`` (S,) is the
    standard deviation of the root across the seam. ``edges_seen`` is the share of stations with surface on both sides.
    A ``closed`` groove is a ring: its last station is followed by its first.
    """

    members: Integers
    root: Floats
    left: Floats
    right: Floats
    normals: Floats
    width_mm: Floats
    depth_mm: Floats
    root_deviation_mm: Floats
    step_mm: float
    edges_seen: float
    closed: bool = False

    @property
    def length_mm(self) -> float:
        """Length of the root line, all round for a closed groove."""
        line = np.concatenate([self.root, self.root[:1]]) if self.closed else self.root
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())

    @property
    def volume_mm3(self) -> float:
        """Volume between the walls and the surface around, from the median cross-section."""
        return float(np.median(self.width_mm * self.depth_mm) / 2 * self.length_mm)

    def __str__(self) -> str:
        size = f"{np.median(self.width_mm):.1f} mm wide, {np.median(self.depth_mm):.1f} mm deep"
        return f"groove of {len(self.members):,} points, {size}, {self.length_mm:.0f} mm long"


def fit_groove(cloud: Floats, T_field_cloud: Floats, valley: Valley, spacing_mm: float) -> DetectedGroove | None:
    """Fit edges and root along a valley; None where no V-groove fits it."""
    width = 1.3 * max(valley.width_mm, LEAST_POINTS_ACROSS * spacing_mm)
    depth = valley.depth_mm
    noise = 0.05 * depth
    step = max(1.5 * spacing_mm, width / 12)
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
        spread = np.array([depth / 2, 0.5, 0.3 * depth / reach**2, depth, width / 2, width / 3, width / 2])
        if number == 1:
            corners = _corners(sections, start, spread, width, noise)
        fit = fit_profiles(sections, start, spread, corners, noise)
        inside = _stations_inside(fit, sections, width, depth, 1.0 if number > 1 else 2.5)
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
        curve = _part(_recentred(curve, fit, first, last, width), first, last)
        turns, ring = _one_round(curve.stations, width)
        curve = _part(curve, 0, turns) if ring else curve
    return _finished(cloud, T_field_cloud, curve, strip, sections, fit, (first, last), noise)


def _part(curve: SeamCurve, first: int, last: int) -> SeamCurve:
    return build_curve(curve.stations[first:last], curve.up[first:last], curve.step_mm)


def _is_groove(width: float, depth: float, length: float, spacing: float) -> bool:
    return (
        width >= LEAST_POINTS_ACROSS * spacing
        and depth >= LEAST_WALL_SLOPE * width / 2
        and length >= LEAST_LENGTH * width
    )


def _corners(sections: Sections, start: Floats, spread: Floats, width: float, noise: float) -> Corners:
    """Floor and rounding that fit a sample of the sections best; a sharp V unless something else clearly helps."""
    pick = np.linspace(0, len(start) - 1, min(16, len(start))).astype(int)
    sample = Sections(sections.across[pick], sections.up[pick], sections.weight[pick], sections.bin_mm)

    def misfit(corners: Corners) -> float:
        return float(np.median(fit_profiles(sample, start[pick], spread, corners, noise).noise_mm))

    chosen = Corners(SHARP * width, SHARP * width)
    best = misfit(chosen)
    for corner in ("floor_mm", "root_mm", "edge_mm"):
        for share in (0.08, 0.16, 0.24, 0.32):
            trial = replace(chosen, **{corner: share * width})
            value = misfit(trial)
            if value < 0.93 * best:
                best, chosen = value, trial
    return chosen


def _stations_inside(
    fit: ProfileFit, sections: Sections, width: float, depth: float, looseness: float
) -> tuple[int, int] | None:
    """Longest run of stations (first, behind last) that show the groove; short gaps are bridged.

    ``looseness`` widens the limits while the curve is not yet well placed.
    """
    theta = fit.parameters
    widths = theta[:, RIGHT] - theta[:, LEFT]
    between = (sections.across > theta[:, LEFT, None]) & (sections.across < theta[:, RIGHT, None])
    points = np.where(between, sections.weight, 0).sum(axis=1)
    seen = points > 0.25 * np.median(points[points > 0]) if (points > 0).any() else points > 0
    deep = theta[:, DEPTH] > LEAST_DEPTH_SHARE * depth
    fitting = fit.noise_mm < WORST_FIT_SHARE * np.maximum(theta[:, DEPTH], 1e-9)
    sure = fit.deviation[:, DEPTH] < LEAST_DEPTH_SHARE * theta[:, DEPTH]
    near = (np.abs(theta[:, LEVEL]) < looseness * WORST_LEVEL_SHARE * depth) & (
        np.abs(theta[:, TILT]) < looseness * WORST_TILT
    )
    place = (theta[:, ROOT] - theta[:, LEFT]) / widths
    shapely = (np.abs(place - 0.5) < WORST_SKEW) & (
        np.abs(np.log(widths / width)) < looseness * np.log(WORST_WIDTH_RATIO)
    )
    shown = seen & deep & fitting & sure & near & shapely
    if not shown.any():
        return None
    bridged = binary_closing(np.pad(shown, 9), np.ones(9))[9:-9]
    names, count = label(bridged)
    run = np.flatnonzero(names == 1 + np.argmax([(names == name).sum() for name in range(1, count + 1)]))
    if shown[run].mean() < 0.6 or len(run) < 4:
        return None
    return int(run[0]), int(run[-1]) + 1


def _smooth(
    fit: ProfileFit,
    first: int,
    last: int,
    values: Floats,
    parameter: int,
    length: float,
    step: float,
    robust: bool = True,
) -> Floats:
    """Smooth values (S,) along the seam, weighted by how sure the fit is; stations outside the groove do not count."""
    floor = 0.3 * np.median(fit.deviation[first:last, parameter])
    weight = np.zeros(len(values))
    weight[first:last] = 1 / (fit.deviation[first:last, parameter] ** 2 + floor**2)
    return smooth_along(values, weight, length, step, robust=robust)


def _recentred(curve: SeamCurve, fit: ProfileFit, first: int, last: int, width: float) -> SeamCurve:
    """Move the curve onto the surface above the root and turn its up direction onto the surface's normal."""
    theta, step = fit.parameters, curve.step_mm
    middle = (theta[:, LEFT] + theta[:, RIGHT]) / 2
    shift = _smooth(fit, first, last, middle, ROOT, width / 2, step, robust=False)
    level = _smooth(fit, first, last, theta[:, LEVEL], LEVEL, width / 2, step, robust=False)
    tilt = _smooth(fit, first, last, theta[:, TILT], TILT, width, step, robust=False)
    stations = curve.stations + shift[:, None] * curve.across + (level + tilt * shift)[:, None] * curve.up
    return SeamCurve(stations, step, curve.along, curve.across, curve.up - tilt[:, None] * curve.across)


def _finished(
    cloud: Floats,
    T_field_cloud: Floats,
    curve: SeamCurve,
    strip: Strip,
    sections: Sections,
    fit: ProfileFit,
    run: tuple[int, int],
    noise: float,
) -> DetectedGroove | None:
    """Smooth the fitted lines along the seam, take the points between the edges, and return to the cloud's frame.

    None where the points scatter about the section too much for its depth.
    """
    first, last = run
    theta, step = fit.parameters, curve.step_mm
    width = float(np.median((theta[:, RIGHT] - theta[:, LEFT])[first:last]))
    widths = _smooth(fit, first, last, theta[:, RIGHT] - theta[:, LEFT], RIGHT, 2 * width, step)
    middle = _smooth(fit, first, last, (theta[:, LEFT] + theta[:, RIGHT]) / 2, ROOT, width / 2, step)
    if max(fit.corners.root_mm, fit.corners.floor_mm) > SHARP * width * 1.5:
        theta = theta.copy()
        theta[:, ROOT] = _depth_centres(sections, theta)
    smooth = np.empty_like(theta)
    for parameter, length in ((LEVEL, 0.3), (TILT, 0.5), (BEND, 2.0), (DEPTH, 0.5), (ROOT, 0.5)):
        smooth[:, parameter] = _smooth(fit, first, last, theta[:, parameter], parameter, length * width, step)
    smooth[:, LEFT], smooth[:, RIGHT] = middle - widths / 2, middle + widths / 2
    smooth[:, ROOT] = np.clip(smooth[:, ROOT], smooth[:, LEFT] + 0.1 * width, smooth[:, RIGHT] - 0.1 * width)
    lines = np.stack([smooth[:, LEFT], smooth[:, ROOT], smooth[:, RIGHT]], axis=1)
    heights = profile_height(lines, smooth, fit.corners)
    at = np.arange(len(curve)) * step

    def along(values: Floats) -> Floats:
        return np.interp(strip.along, at, values)

    between = (strip.across >= along(smooth[:, LEFT])) & (strip.across <= along(smooth[:, RIGHT]))
    ends = (strip.along >= (first - 0.5) * step) & (strip.along <= (last - 0.5) * step)
    depth = float(np.median(smooth[first:last, DEPTH]))
    inside = between & ends
    sections_here = np.stack([along(smooth[:, parameter]) for parameter in range(7)], axis=1)[inside]
    off = strip.up[inside] - profile_height(strip.across[inside, None], sections_here, fit.corners)[:, 0]
    if len(off) == 0 or depth < LEAST_DEPTH_IN_SCATTER * 1.4826 * np.median(np.abs(off)):
        return None
    floor = along(smooth[:, LEVEL]) + along(smooth[:, TILT]) * strip.across - 1.3 * depth - 4 * noise
    members = np.sort(strip.index[inside & (strip.up > floor)])
    placed = curve.stations[:, None, :] + lines[:, :, None] * curve.across[:, None, :]
    core = between & (np.abs(strip.across - along(smooth[:, ROOT])) < width / 5)
    first, last = _covered(strip.along[core], first, last, step, width)
    placed = (placed + heights[:, :, None] * curve.up[:, None, :])[first:last]
    normals = (curve.up - smooth[:, TILT, None] * curve.across)[first:last]
    T_cloud_field = inverse(T_field_cloud)
    left, root, right = (move_points(T_cloud_field, placed[:, k]) for k in range(3))
    outer = np.abs(sections.across - middle[:, None])
    beside = (outer > widths[:, None] / 2) & (outer < 0.75 * widths[:, None]) & (sections.weight > 0)
    both = ((beside & (sections.across < 0)).any(axis=1) & (beside & (sections.across > 0)).any(axis=1))[first:last]
    turns, closed = _one_round(root, width)
    return DetectedGroove(
        members,
        root[:turns],
        left[:turns],
        right[:turns],
        turn_vectors(T_cloud_field, normals / np.linalg.norm(normals, axis=1, keepdims=True))[:turns],
        widths[first:last][:turns],
        smooth[first:last, DEPTH][:turns],
        fit.deviation[first:last, ROOT][:turns],
        step,
        float(both.mean()),
        closed,
    )


def _depth_centres(sections: Sections, theta: Floats) -> Floats:
    """Depth-weighted centre (S,) across the seam of the points between the edges: the line of a blunt groove."""
    surface = theta[:, LEVEL, None] + theta[:, TILT, None] * sections.across
    inside = (sections.across > theta[:, LEFT, None]) & (sections.across < theta[:, RIGHT, None])
    depth = sections.weight * np.where(inside, np.maximum(surface - sections.up, 0), 0)
    return (depth * sections.across).sum(axis=1) / np.maximum(depth.sum(axis=1), 1e-9)


def _covered(along: Floats, first: int, last: int, step: float, width: float) -> tuple[int, int]:
    """Cut stations off both ends where the middle of the groove already lies beyond the part.

    A station there holds few points against those a little farther in; the density may well fall slowly along the seam.
    """
    # Stations can be finer than the rows of points; two of them together always hold about the same number.
    counts = np.bincount(np.clip(along / step + 0.5, 0, last).astype(int), minlength=last + 1)
    pairs = counts[:-1] + counts[1:]
    inward = max(int(width / step), 3)
    while last - first > 2 * inward and pairs[first] < COVERED_SHARE * np.median(pairs[first + 1 : first + inward]):
        first += 1
    while last - first > 2 * inward and pairs[last - 2] < COVERED_SHARE * np.median(pairs[last - inward : last - 2]):
        last -= 1
    return first, last


def _one_round(line: Floats, width: float) -> tuple[int, bool]:
    """How many stations of a line (S, 3) make one round of a ring, and whether it is one.

    A ring's line comes back to its start, or stops shortly before it and points there.
    """
    away = np.linalg.norm(line - line[0], axis=1)
    far = np.flatnonzero(away > 2 * width)
    back = np.flatnonzero(away < width / 2)
    back = back[back > far[0]] if len(far) else back[:0]
    if len(back):
        back = back[: int(np.argmax(np.diff(back, append=len(line) + 2) > 1)) + 1]
        return int(back[np.argmin(away[back])]), True
    reach = min(10, len(line) - 1)
    start, end, gap = line[reach] - line[0], line[-1] - line[-1 - reach], line[0] - line[-1]
    meets = len(far) > 0 and away[-1] < 1.5 * width
    onward = vector_angle(start, end) < RING_TURN_RAD and vector_angle(gap, end) < RING_TURN_RAD
    return len(line), bool(meets and onward)
