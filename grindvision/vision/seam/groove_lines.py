"""A groove's lines once it is fitted: edges and root smoothed along the seam, its ends, and the points between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import inverse, move_points, rotate_vectors, vector_angle
from grindvision.records import by_content
from grindvision.vision.seam.groove_profile import (
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
from grindvision.vision.seam.seam_curve import SeamCurve, Strip
from grindvision.vision.seam.seam_smoothing import MAD_TO_STD, smooth_along, smooth_to_noise
from grindvision.vision.seam.section_shift import section_shifts

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: A section may differ from its neighbours by this fraction of what the first fit left free.
NEIGHBOUR_FRACTION = 0.1
#: A groove is at least so many standard deviations of its points' scatter deep.
MIN_DEPTH_IN_SCATTER = 3.0
#: Points so near to the root, in fractions of the width, tell where the groove ends; there they are half as dense.
CORE_FRACTION, COVERED_FRACTION = 0.08, 0.5
#: Fewer than so many points in two stations tell nothing; then this fraction of the width to both sides is looked at.
MIN_IN_WINDOW, WINDOW_FRACTION = 8, 0.35
#: Behind the ends of a groove points belong to it so near to its section, in standard deviations of the others, where
#: this fraction of those between its edges does.
MAX_OFF_IN_SCATTER, MIN_ON_SECTION = 3.0, 0.8
#: The two ends of a ring point the same way within this angle.
RING_TURN_RAD = np.radians(50)
#: Rounding of a sharp corner, in fractions of the width: enough for derivatives, too little to see.
SHARP = 0.004


@by_content
@dataclass(frozen=True)
class DetectedGroove:
    """One groove: its points and its lines along the seam, in the cloud's frame, mm.

    ``members`` (K,) index the points of the cloud between its edges. At S stations, ``step_mm`` apart: ``root`` the
    line where the walls meet (of a blunt groove the depth-weighted middle), ``left`` and ``right`` the edges, and unit
    ``normals`` of the surface around, all (S, 3).
    ``width_mm`` and ``depth_mm`` (S,) are measured across and along the normals, ``root_deviation_mm`` (S,) is the
    standard deviation of the root's distance, to the side and in height. ``edges_seen`` is the fraction of stations
    with surface on both sides.
    ``ends_mm`` is how far its points show it beyond its first and its last station, both together.
    A ``closed`` groove is a ring: its last station is followed by its first. ``floor_fraction`` is how much of the
    width a flat or rounded root takes.
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
    ends_mm: float = 0.0
    closed: bool = False
    floor_fraction: float = 0.0

    @property
    def length_mm(self) -> float:
        """Length of the groove, all round for a closed one, else as far as its points show it."""
        line = np.concatenate([self.root, self.root[:1]]) if self.closed else self.root
        ends = 0.0 if self.closed else self.ends_mm
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) + ends

    @property
    def volume_mm3(self) -> float:
        """Volume between the walls and the surface around, from the median cross-section."""
        return float(np.median(self.width_mm * self.depth_mm) / 2 * self.length_mm)

    def __str__(self) -> str:
        size = f"{np.median(self.width_mm):.1f} mm wide, {np.median(self.depth_mm):.1f} mm deep"
        return f"groove of {len(self.members):,} points, {size}, {self.length_mm:.0f} mm long"


class FittedSections(NamedTuple):
    """Cross-sections of a valley along its ``curve``: the points beside it (``strip``), gathered into ``sections``, and
    their ``fit`` under a prior (``prior_sigma`` (7,), ``noise``). The groove reaches from station ``first`` to
    ``last``."""

    curve: SeamCurve
    strip: Strip
    sections: Sections
    fit: ProfileFit
    prior_sigma: Floats
    noise: float
    first: int
    last: int


def groove_lines(fitted: FittedSections, T_field_cloud: Floats, spacing_mm: float) -> DetectedGroove | None:
    """Lines and points of a fitted groove, in the cloud's frame.

    The sections are fitted once more, each to its own points alone, but held to what its neighbours say within a
    fraction of the first fit's prior: where only one wall is seen, the other comes from along the seam. What they say
    is then smoothed as their own noise asks for.

    None where the points scatter about the section too much for its depth.
    """
    curve, strip, sections, fit, _, noise, first, last = fitted
    step, at = curve.step_mm, np.arange(len(curve)) * curve.step_mm
    theta = _with_neighbours(fitted)
    width = float(np.median((theta.parameters[:, RIGHT] - theta.parameters[:, LEFT])[first:last]))
    core = np.abs(strip.across - np.interp(strip.along, at, theta.parameters[:, ROOT])) < CORE_FRACTION * width
    covered = _covered(strip.along[core], first, last, step, width)
    lines, heights, smooth = _smooth_lines(theta, sections, covered, step)
    aside, above = section_shifts(strip, smooth, fit.corners, step)
    lines[:, 1] += aside
    heights[:, 1] += above

    def along(values: Floats) -> Floats:
        return np.interp(strip.along, at, values)

    between = (strip.across >= along(smooth[:, LEFT])) & (strip.across <= along(smooth[:, RIGHT]))
    ends = (strip.along >= (first - 0.5) * step) & (strip.along <= (last - 0.5) * step)
    depth = float(np.median(smooth[first:last, DEPTH]))
    sections_here = np.stack([along(smooth[:, parameter]) for parameter in range(7)], axis=1)
    off = strip.up - profile_height(strip.across[:, None], sections_here, fit.corners)[:, 0]
    if not (between & ends).any():
        return None
    scatter = MAD_TO_STD * float(np.median(np.abs(off[between & ends])))
    if depth < MIN_DEPTH_IN_SCATTER * scatter:
        return None
    floor = along(smooth[:, LEVEL]) + along(smooth[:, TILT]) * strip.across - 1.3 * depth - 4 * noise
    fits = between & (np.abs(off) < MAX_OFF_IN_SCATTER * scatter)
    beyond = _oblique_ends(strip.along / step, between, fits, (first, last), width / step)
    members = np.sort(strip.index[(between & ends & (strip.up > floor)) | beyond])
    first, last = covered
    placed = curve.stations[:, None, :] + lines[:, :, None] * curve.across[:, None, :]
    placed = (placed + heights[:, :, None] * curve.up[:, None, :])[first:last]
    normals = (curve.up - smooth[:, TILT, None] * curve.across)[first:last]
    T_cloud_field = inverse(T_field_cloud)
    left, root, right = (move_points(T_cloud_field, placed[:, k]) for k in range(3))
    turns, closed = one_round(root, width)
    ends_mm = _reach_of_ends(strip.along[core], first, last, step, spacing_mm)
    return DetectedGroove(
        members,
        root[:turns],
        left[:turns],
        right[:turns],
        rotate_vectors(T_cloud_field, normals / np.linalg.norm(normals, axis=1, keepdims=True))[:turns],
        (smooth[:, RIGHT] - smooth[:, LEFT])[first:last][:turns],
        smooth[first:last, DEPTH][:turns],
        _root_deviations(theta.deviation[first:last])[:turns],
        step,
        _both_sides_fraction(sections, smooth, first, last),
        ends_mm,
        closed,
        _floor_fraction(fit.corners, width),
    )


def _oblique_ends(place: Floats, between: Flags, fits: Flags, run: tuple[int, int], reach: float) -> Flags:
    """Points (K,) at ``place`` along the seam, in stations, that go on with the groove behind the ends of its run.

    Where a part ends askew, or a camera sees one wall farther round a pipe than the other, one wall goes on alone: as
    long as most points ``between`` the edges still lie on the section (``fits``), at most ``reach`` stations far.
    """
    first, last = run
    beyond = np.zeros(len(place), dtype=bool)
    number = np.floor(place + 0.5).astype(int)
    for end, way in ((first, -1), (last - 1, 1)):
        for station in range(end + way, end + way * (int(reach) + 1), way):
            here = between & (number == station)
            if not here.any() or fits[here].mean() < MIN_ON_SECTION:
                break
            beyond |= here & fits
    return beyond


def _root_deviations(deviation: Floats) -> Floats:
    """Standard deviations (S,) of the root's distance, from those of the sections' parameters (S, 7): to the side, and
    in height, which is the surface's level less the depth."""
    height = deviation[:, DEPTH] ** 2 - deviation[:, LEVEL] ** 2
    return np.sqrt(deviation[:, ROOT] ** 2 + np.maximum(height, 0.0))


def _floor_fraction(corners: Corners, width: float) -> float:
    """How much of a groove's width its flat or rounded root takes; 0 for a sharp one."""
    return 2 * max(corners.floor_mm, corners.root_mm if corners.root_mm > 2 * SHARP * width else 0.0) / width


def one_round(line: Floats, width: float) -> tuple[int, bool]:
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


def weights_of(deviation: Floats) -> Floats:
    """Weights (S,) of values with these standard deviations; none counts far more than the usual one."""
    return 1 / (deviation**2 + (0.3 * np.median(deviation)) ** 2)


def _with_neighbours(fitted: FittedSections) -> ProfileFit:
    """Fit every section again, to its own points alone, with a prior that its neighbours make."""
    curve, strip, sections, fit, prior_sigma, noise, first, last = fitted
    step = curve.step_mm
    theta = fit.parameters
    width = float(np.median((theta[:, RIGHT] - theta[:, LEFT])[first:last]))
    usual = np.empty_like(theta)
    for parameter in range(theta.shape[1]):
        weight = np.zeros(len(theta))
        weight[first:last] = weights_of(fit.deviation[first:last, parameter])
        usual[:, parameter] = smooth_along(theta[:, parameter], weight, width, step, robust=True)
    reach = sections.bin_mm * (sections.weight.shape[1] // 2)
    own = gather_sections(strip, len(theta), step, reach, sections.bin_mm, 0.0)
    return fit_profiles(own, usual, NEIGHBOUR_FRACTION * prior_sigma, fit.corners, noise)


def _smooth_lines(
    fit: ProfileFit, sections: Sections, run: tuple[int, int], step: float
) -> tuple[Floats, Floats, Floats]:
    """Left edge, root and right edge along the seam: places across (S, 3), heights (S, 3), and the sections (S, 7)."""
    first, last = run
    theta = fit.parameters

    def smooth(values: Floats, parameter: int) -> Floats:
        weight = np.zeros(len(values))
        weight[first:last] = weights_of(fit.deviation[first:last, parameter])
        return smooth_to_noise(values, weight, step)[0]

    result = np.empty_like(theta)
    middle, width = (theta[:, LEFT] + theta[:, RIGHT]) / 2, theta[:, RIGHT] - theta[:, LEFT]
    root_height = profile_height(theta[:, ROOT, None], theta, fit.corners)[:, 0]
    own = [theta[:, parameter] for parameter in (LEVEL, TILT, BEND, DEPTH, ROOT)]
    *own, middle, width, root_height = map(
        smooth, [*own, middle, width, root_height], [LEVEL, TILT, BEND, DEPTH, ROOT, ROOT, RIGHT, DEPTH]
    )
    result[:, [LEVEL, TILT, BEND, DEPTH, ROOT]] = np.stack(own, axis=1)
    result[:, LEFT], result[:, RIGHT] = middle - width / 2, middle + width / 2
    blunt = max(fit.corners.root_mm, fit.corners.floor_mm) > 1.5 * SHARP * np.median(width)
    root = smooth(_depth_centres(sections, result, fit.corners, first, last), ROOT) if blunt else result[:, ROOT]
    result[:, ROOT] = np.clip(root, result[:, LEFT] + 0.1 * width, result[:, RIGHT] - 0.1 * width)
    lines = np.stack([result[:, LEFT], result[:, ROOT], result[:, RIGHT]], axis=1)
    heights = profile_height(lines, result, fit.corners)
    heights[:, 1] = root_height
    return lines, heights, result


def _depth_centres(sections: Sections, theta: Floats, corners: Corners, first: int, last: int) -> Floats:
    """Depth-weighted centre (S,) across the seam of the groove between the edges: the line of a blunt groove.

    All places across count alike, however many points show them: a wall that faces the camera shows the more. Where a
    section shows fewer points than sections usually do at that place, beyond the part's outline or in a shadow, the
    fitted section stands in: a wall that is not seen must not leave the centre to the other.
    """
    count = sections.weight.shape[1]
    across = np.broadcast_to((np.arange(count) - count // 2) * sections.bin_mm, sections.weight.shape)
    missing = np.maximum(np.median(sections.weight[first:last], axis=0) - sections.weight, 1e-9)
    moment, total = np.zeros(len(theta)), np.full(len(theta), 1e-9)
    shown = (sections.weight, sections.across, sections.up)
    for weight, place, up in (shown, (missing, across, profile_height(across, theta, corners))):
        inside = (place > theta[:, LEFT, None]) & (place < theta[:, RIGHT, None])
        surface = theta[:, LEVEL, None] + theta[:, TILT, None] * place
        part = weight / (sections.weight + missing)
        depth = part * np.where(inside, np.maximum(surface - up, 0), 0)
        moment, total = moment + (depth * place).sum(axis=1), total + depth.sum(axis=1)
    return moment / total


def _covered(along: Floats, first: int, last: int, step: float, width: float) -> tuple[int, int]:
    """Cut stations off both ends where the root already lies beyond the part: no points on it, or half of the usual.

    They are counted over two stations, which can be finer than the rows of points, or, where these usually hold too few
    to tell, over a longer window. Usual is what stations a little farther in hold; the density may well fall slowly.
    """
    counts = np.bincount(np.maximum(along / step + 0.5, 0).astype(int), minlength=last + 1)
    dense = 2 * np.median(counts[first:last]) >= MIN_IN_WINDOW
    size = 2 if dense else 2 * int(WINDOW_FRACTION * width / step) + 1
    inward = max(int(width / step), 3)

    def thin_stations(counts: Integers, first: int) -> int:
        windows = np.convolve(counts, np.ones(size))[size // 2 :]  # about station k
        thin = 0
        while last - first - thin > 2 * inward:
            farther_in = windows[first + thin + size - 1 :][:inward]
            if windows[first + thin] >= COVERED_FRACTION * np.median(farther_in):
                break
            thin += 1
        return thin

    return first + thin_stations(counts, first), last - thin_stations(counts[::-1], len(counts) - last)


def _reach_of_ends(along: Floats, first: int, last: int, step: float, spacing_mm: float) -> float:
    """How far points near the root reach beyond the first and the last station, mm, both together.

    A point stands for half a spacing to each side, a station for half a step; inside a station's half step it may also
    end short of it.
    """
    start, end = first * step, (last - 1) * step
    here = along[(along >= start - step / 2) & (along <= end + step / 2)]
    reaches = np.array([start - here.min(initial=end), here.max(initial=start) - end]) + spacing_mm / 2
    return float(np.clip(reaches, -step / 2, step / 2).sum())


def _both_sides_fraction(sections: Sections, theta: Floats, first: int, last: int) -> float:
    """Fraction of the stations ``first`` to ``last`` with points of the surface on both sides of the groove."""
    middle, width = (theta[:, LEFT] + theta[:, RIGHT]) / 2, theta[:, RIGHT] - theta[:, LEFT]
    outer = np.abs(sections.across - middle[:, None])
    beside = (outer > width[:, None] / 2) & (outer < 0.75 * width[:, None]) & (sections.weight > 0)
    sides = [np.asarray((beside & side).any(axis=1)) for side in (sections.across < 0, sections.across > 0)]
    return float((sides[0] & sides[1])[first:last].mean())
