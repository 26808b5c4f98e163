"""Path points along the ridge of a bead (ours, in place of section 3.6's boxes).

The bead's rough centreline comes from ``bead_centreline``. The ridge is where the height over the good surface is
greatest across the bead: the top of a quartic fitted across, which uneven sampling does not pull aside as it does a
centroid, and which fits round, bell-shaped and lopsided beads as well as a parabola.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError, NoPathError, TooSmallError
from grindvision.geometry.curves import Curve
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.bead_sections import Sections, sums_of_sections
from grindvision.vision.change.centreline import bead_centreline
from grindvision.vision.change.pieces import Cluster
from grindvision.words import rounded

Floats = NDArray[np.float64]

MIN_SECTION = 12
"""A station with fewer points has no cross-section."""

SHAPE_WIDTHS = 5.0
"""Over so many widths to either side a bead keeps the shape of its cross-section well enough for it to be averaged."""

TOP_FRACTION = 0.05
"""The ridge is the middle of what lies within this share of the top's height: a flat top has no vertex of its own."""

POWERS = np.arange(1, 5)
"""Of the distance across, in widths: the terms of a cross-section; where one flank is not shown, the first two."""

FARTHEST = 0.36
"""So many widths from the centreline the ridge may lie; what seems farther is a flank without a top."""

ACROSS = np.linspace(-FARTHEST, FARTHEST, 101)
ACROSS_POWERS = ACROSS[:, None] ** POWERS

MIN_FLANK = 0.05
"""A flank is shown when such a fraction of the points lies on it."""

CREST_QUANTILE, MIN_CREST_CELLS = 0.7, 4.0
"""The crest of a piece whose sections have no ridge (fins, edges) is the mean of the points above this quantile; it
must be so many cells long."""

ON_TOP = 0.75
"""Within a cell of a path point a piece is at least so high, of its largest height across it there."""

FIN_CELLS = 0.25
"""A piece whose feet lie within so many cells of its centreline is a fin and has no cross-section."""

FACE_MM, FACE_TOP, FACE_FRACTION = 12.0, 0.6, 0.75
"""A piece so wide, of whose points such a fraction stands higher than such a share of its peak, is a face, no bead."""


@by_content
@dataclass(frozen=True)
class BeadPath:
    """Path of one bead, frame of the test scan.

    ``points`` (n, 3) on the ridge and unit ``normals`` (n, 3) of the good surface there, pointing off the part;
    ``ridge`` (M, 3) the whole curve; ``closed`` whether it comes back to its start; ``length_mm``, ``width_mm`` at half
    height, ``height_mm`` of the ridge over the good surface (median).
    """

    points: Floats
    normals: Floats
    ridge: Floats
    closed: bool
    length_mm: float
    width_mm: float
    height_mm: float

    def __str__(self) -> str:
        shape = "closed" if self.closed else "open"
        size = f"{self.length_mm:.1f} mm long, {self.width_mm:.1f} wide, {self.height_mm:.2f} high"
        return f"{shape} bead, {size}: {len(self.points)} points"

    def tool_axes(self) -> Floats:
        """Directions (n, 3) in which the tool points: opposite to the normals."""
        return -self.normals


@one_blas_thread()
def trace_bead(cluster: Cluster, points: int = 6) -> BeadPath:
    """Follow the ridge of a bead and place ``points`` on it, each in the middle of an equal part of its length.

    An open bead is walked from its end with the smaller x; a closed one from its point of smallest x, counterclockwise
    about its normal.

    Raises:
        InputError: fewer than one point. TooSmallError: too few points to follow. NoPathError: a face, or no path that
            stays on the piece's own points. DegenerateError: the bead branches.
    """
    if points < 1:
        raise InputError(f"{points} path points asked for; at least 1 is needed")
    curve, closed, width = bead_centreline(cluster)
    _refuse_face(cluster, width)
    centreline = Curve(curve, closed)
    for follow in (_follow_sections, _follow_crest):
        try:
            path = _placed(cluster, *follow(cluster, centreline, width), closed, width, points)
        except TooSmallError:
            if follow is _follow_crest:
                raise
            continue
        on_piece = lies_on(cluster, path.points) and lies_on(cluster, path.ridge, 2.0)
        if on_piece and lies_on_top(cluster, path):
            return path
    raise NoPathError(
        f"it stands {cluster.peak_mm:.2f} mm out over {rounded(cluster.area_mm2)} mm2 but shows no ridge: every path"
        " along it would leave its points; it may be flash or an edge that is seen from one side only, scan it"
        " from above"
    )


def lies_on(cluster: Cluster, places: ArrayLike, cells: float = 1.0) -> bool:
    """Whether each of the places (M, 3) has a point of the piece within so many cells."""
    size = cluster.spacing_mm
    at, _ = nearest(build_cells(cluster.points, size), np.asarray(places, dtype=float), cells * size)
    return bool(np.isfinite(places).all() and (at >= 0).all())


def lies_on_top(cluster: Cluster, path: BeadPath) -> bool:
    """Whether the piece is about as high at each path point as anywhere across it there: sections of which one flank
    alone is shown have no top, and the ridge stays on the flank."""
    size = cluster.spacing_mm
    for place in path.points:
        away = np.linalg.norm(path.ridge - place, axis=1)
        at = int(np.clip(np.argmin(away), 1, len(path.ridge) - 2))
        along = path.ridge[at + 1] - path.ridge[at - 1]
        offsets = cluster.points - place
        distances = np.linalg.norm(offsets, axis=1)
        across = (np.abs(offsets @ along) < size * np.linalg.norm(along)) & (distances < max(path.width_mm, 2 * size))
        near = distances < size
        if near.any() and cluster.signed_mm[near].max() < ON_TOP * cluster.signed_mm[across].max():
            return False
    return True


def _refuse_face(cluster: Cluster, width: float) -> None:
    """Refuse to draw a line along what stands out as a face.

    Raises:
        NoPathError: it does.
    """
    heights = cluster.signed_mm
    if width > FACE_MM and (heights > FACE_TOP * cluster.peak_mm).mean() > FACE_FRACTION:
        raise NoPathError(
            f"a face of {rounded(cluster.area_mm2)} mm2 stands out by {np.median(heights):.2f} mm; it has no ridge that"
            " a path could follow, take it off as a face"
        )


def _placed(
    cluster: Cluster, feet: Floats, normals: Floats, heights: Floats, closed: bool, width: float, points: int
) -> BeadPath:
    """The path over a ridge of given feet (M, 3), normals (M, 3) and heights (M,)."""
    ridge = Curve(feet + heights[:, None] * normals, closed)
    start, end = (0.0, ridge.length_mm) if closed else _ends(cluster, ridge)
    at = start + (end - start) * ((np.arange(points) + (0.0 if closed else 0.5)) / points)
    dense = ridge.at(np.linspace(start, end, max(int((end - start) / (0.1 * width)), 2 * points, 20)))
    across = cluster.area_mm2 / max(end - start, 1e-9)
    return BeadPath(
        ridge.at(at),
        ridge.smooth(normals, at),
        dense,
        closed,
        float(end - start),
        float(min(across, 10 * width)),
        float(np.median(heights)),
    )


def _follow_sections(cluster: Cluster, centreline: Curve, width: float) -> tuple[Floats, Floats, Floats]:
    """Ridge by the cross-sections, the centreline drawn to it twice: feet (M, 3), normals (M, 3), heights (M,)."""
    for _ in range(2):
        centreline = Curve(_smoothed(_ridge(cluster, centreline, width)[0], centreline.closed), centreline.closed)
    return _ridge(cluster, centreline, width)


def _follow_crest(cluster: Cluster, centreline: Curve, width: float) -> tuple[Floats, Floats, Floats]:
    """Crest over stations along the centreline: the mean of the highest points about each; as ``_follow_sections``."""
    reach = max(width, 2 * cluster.spacing_mm)
    s = centreline.arc_of(cluster.points)
    count = max(int(np.ceil(centreline.length_mm / reach)), 2)
    crests, normals, heights = [], [], []
    for arc in np.linspace(0.0, centreline.length_mm, count + (not centreline.closed), endpoint=not centreline.closed):
        away = np.abs(s - arc)
        near = np.flatnonzero((np.minimum(away, centreline.length_mm - away) if centreline.closed else away) < reach)
        if len(near) < 4:
            continue
        high = near[cluster.signed_mm[near] >= np.quantile(cluster.signed_mm[near], CREST_QUANTILE)]
        up = cluster.normals[high].sum(axis=0)
        length = np.linalg.norm(up)
        if length > 0.5 * len(high):
            crests.append(cluster.points[high].mean(axis=0))
            normals.append(up / length)
            heights.append(cluster.signed_mm[high].mean())
    if len(crests) < 3 or np.linalg.norm(crests[-1] - crests[0]) < MIN_CREST_CELLS * cluster.spacing_mm:
        raise TooSmallError("the bead is too small or too thinly sampled to follow its ridge; scan it denser")
    tops, up, above = np.array(crests), np.array(normals), np.array(heights)
    return _smoothed(tops, centreline.closed) - above[:, None] * up, up, above


def _ridge(cluster: Cluster, stations: Curve, width: float) -> tuple[Floats, Floats, Floats]:
    """Ridge over stations along the curve: feet (M, 3) on the good surface, its normals (M, 3), ridge heights (M,).

    Points are taken in the curve's own coordinates: arc length s, distance b across, height h over the good surface.
    Around each station h = g(b - t) + c0 + c1 s + c2 s^2 + c3 s b is fitted. The section g, a quartic, is pooled over
    ``SHAPE_WIDTHS`` along the bead, the station's own is its shift t across: often one flank is in shadow, and the
    slope of the other alone cannot tell a ridge farther off from a rounder one. The ridge is the middle of g's top.
    """
    feet = cluster.points - cluster.signed_mm[:, None] * cluster.normals
    s_all = stations.arc_of(feet)
    near = np.clip(s_all, 0, stations.length_mm)
    offsets = feet - stations.at(near)
    sides = np.cross(cluster.normals, stations.tangents(near))
    b_all = (offsets * sides).sum(axis=1) / np.linalg.norm(sides, axis=1)
    if np.quantile(np.abs(b_all), 0.9) < FIN_CELLS * cluster.spacing_mm:
        raise TooSmallError("the piece is a fin, thinner than the scan can show; scan it denser")
    count = max(int(np.ceil(stations.length_mm / (0.35 * width))), 4)
    arcs = np.linspace(0.0, stations.length_mm, count + (not stations.closed), endpoint=not stations.closed)
    around_mm = stations.length_mm if stations.closed else np.inf
    sections = sums_of_sections(s_all, b_all, cluster.signed_mm, cluster.normals, offsets, arcs, width, around_mm)
    enough = sections.counts >= MIN_SECTION
    if enough.sum() < 2:
        raise TooSmallError("the bead is too small or too thinly sampled to follow its ridge; scan it denser")
    arcs, sections = arcs[enough], sections.at(enough)
    laterals, heights = _ridges(sections, _pooled_shapes(sections, arcs, stations, SHAPE_WIDTHS * width), width)
    tangents, places = stations.tangents(arcs), stations.at(arcs)
    normals = sections.up - (sections.up * tangents).sum(axis=1, keepdims=True) * tangents
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depths = (sections.offset * normals).sum(axis=1, keepdims=True)
    places = places + depths * normals + laterals[:, None] * np.cross(normals, tangents)
    return places, normals, heights


def _ridges(sections: Sections, shapes: Floats, width: float) -> tuple[Floats, Floats]:
    """Where across the ridges lie (M,), and their heights (M,), given the sections' shapes (M, 4)."""
    normal, right = sections.normal, sections.right
    free = np.tile(np.eye(8)[:, :5], (len(normal), 1, 1))
    free[:, [0, 4, 5, 6], 4] = -POWERS * shapes  # a shift adds -g'(b)
    left = right - (normal[:, :, 4:] @ shapes[:, :, None])[:, :, 0]
    free_rows = free.transpose(0, 2, 1)
    found = np.linalg.pinv(free_rows @ normal @ free, rcond=1e-12) @ (free_rows @ left[:, :, None])
    heights = found[:, 0] + shapes @ ACROSS_POWERS.T
    tops = _middles_of_tops(ACROSS, heights)
    laterals = np.clip(tops + found[:, 4, 0], -FARTHEST, FARTHEST)
    return laterals * width, np.array([np.interp(top, ACROSS, one) for top, one in zip(tops, heights, strict=True)])


def _middles_of_tops(across: Floats, heights: Floats) -> Floats:
    """Middles (M,) of the places (K,) whose heights (M, K) come within ``TOP_FRACTION`` of the highest of a row."""
    rows, highest = np.arange(len(heights)), heights.max(axis=1)
    level = highest - TOP_FRACTION * np.abs(highest)
    high = heights >= level[:, None]
    last_place = len(across) - 1
    ends = []
    for last, step in ((high.argmax(axis=1), -1), (last_place - high[:, ::-1].argmax(axis=1), 1)):
        inside = (last + step >= 0) & (last + step <= last_place)
        beyond = heights[rows, np.clip(last + step, 0, last_place)]
        drop = np.where(inside, heights[rows, last] - beyond, 1.0)
        way = np.where(inside, (heights[rows, last] - level) / drop, 0.0)
        ends.append(across[last] + way * (across[1] - across[0]) * step)
    return (ends[0] + ends[1]) / 2


def _pooled_shapes(sections: Sections, arcs: Floats, stations: Curve, reach: float) -> Floats:
    """Shapes (M, 4) of the cross-sections, each fitted to all of them, the nearer ones first."""
    equations, rights = _shape_equations(sections)
    away = np.abs(arcs - arcs[:, None])
    if stations.closed:
        away = np.minimum(away, stations.length_mm - away)
    weights = np.clip(1 - (away / reach) ** 3, 0, None) ** 3
    weights /= weights.sum(axis=1, keepdims=True)
    equations, rights = np.tensordot(weights, equations, 1), weights @ rights
    shapes, shown = np.zeros(rights.shape), (weights @ sections.flanks > MIN_FLANK).all(axis=1)
    for some, terms in ((shown, len(POWERS)), (~shown, 2)):
        inverses = np.linalg.pinv(equations[some, :terms, :terms], rcond=1e-9)
        shapes[some, :terms] = (inverses @ rights[some, :terms, None])[:, :, 0]
    shapes[~shown & (shapes[:, 1] >= 0)] = 0.0  # no ridge shows; the centreline stays where it is
    return shapes


def _shape_equations(sections: Sections) -> tuple[Floats, Floats]:
    """Normal equations (M, 4, 4) and (M, 4) of the sections' shapes, whatever the other terms are."""
    normal, right = sections.normal, sections.right
    others = np.linalg.pinv(normal[:, :4, :4], rcond=1e-12) @ normal[:, :4, 4:]
    rights = right[:, 4:] - (others.transpose(0, 2, 1) @ right[:, :4, None])[:, :, 0]
    return normal[:, 4:, 4:] - normal[:, 4:, :4] @ others, rights


def _smoothed(places: Floats, closed: bool) -> Floats:
    """Places (M, 3) averaged with their neighbours in the ratio 1 : 2 : 1; ends of an open curve stay."""
    before, after = np.roll(places, 1, axis=0), np.roll(places, -1, axis=0)
    mean = (before + 2 * places + after) / 4
    if not closed:
        mean[[0, -1]] = places[[0, -1]]
    return mean


def _ends(cluster: Cluster, ridge: Curve) -> tuple[float, float]:
    """Arc lengths between which the bead stands at least half as high as its ridge."""
    high = cluster.signed_mm > 0.5 * cluster.peak_mm
    arcs = ridge.arc_of(cluster.points[high])
    return float(np.quantile(arcs, 0.005)), float(np.quantile(arcs, 0.995))
