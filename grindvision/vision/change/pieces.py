"""Connected pieces of what stands out of the good part: those that a path can follow, and specks that are too small."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import CellGrid, build_cells, cell_key, find_slot
from grindvision.geometry.neighbours import nearest
from grindvision.kernels import njit
from grindvision.records import by_content
from grindvision.vision.surface.clustering import euclidean_clusters
from grindvision.vision.surface.scan import Scan
from grindvision.vision.surface.signed_distance import signed_distances
from grindvision.vision.surface.surfels import Surfels
from grindvision.words import rounded

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

MIN_FOOTPRINT, MIN_FREE = 0.4, 0.5
"""A piece whose feet cover fewer cells of the good surface than this fraction of its own is a wall seen in one scan,
unless such a fraction of it stands where the sample's scanner saw through."""

MIN_DENSITY = 0.4
"""A piece whose cells hold fewer points than this fraction of the usual number is made of stray points."""

MIN_VOLUME = 0.05
"""A piece of less than this fraction of the largest one's volume is a speck."""

MIN_SPECK = 4
"""A speck stands out by twice the level of detection over so many surfels."""

RING_CELLS, SAME_FACE = (1.5, 6.0), 0.8
"""Surfels between so many cells from a piece whose normals make at most the angle of this cosine with the piece's are
the surface around it."""

AXIS_CELLS, ALIKE_HEIGHT = 0.75, 0.5
"""Two pieces are parts of one bead where both look along about the same direction, the lower is so much of the other's
height at least, the way between is no longer than they are together, and no test surfel within so many cells of that
way shows the good surface there: a gap of a scan cuts a bead."""

FLOATING_CELLS = 3.0
"""A piece of which nothing comes nearer to the good surface than so many cells does not belong to the part."""


@by_content
@dataclass(frozen=True)
class Cluster:
    """One connected piece of difference, in the frame of the test scan.

    ``points`` (N, 3) of the test scan, ``signed_mm`` (N,) above the good surface, whose unit ``normals`` (N, 3) are
    given beside; ``spacing_mm``: the cell size at which it was found; ``area_mm2``, ``volume_mm3``, ``peak_mm``.
    """

    points: Floats
    signed_mm: Floats
    normals: Floats
    spacing_mm: float
    area_mm2: float
    volume_mm3: float
    peak_mm: float

    def __str__(self) -> str:
        size = f"{rounded(self.area_mm2)} mm2, {self.peak_mm:.2f} mm high, {rounded(self.volume_mm3)} mm3"
        return f"{len(self.points):,} points, {size}"


@by_content
@dataclass(frozen=True)
class Speck:
    """What stands out but is too small for a piece, or ``floating`` off the part: its middle (3,) in mm, frame of the
    test scan, and its size."""

    middle_mm: Floats
    area_mm2: float
    height_mm: float
    floating: bool = False

    def __str__(self) -> str:
        place = ", ".join(f"{value:.0f}" for value in self.middle_mm)
        floating = ", touching nothing of the part" if self.floating else ""
        return f"{rounded(self.area_mm2, 2)} mm2, {self.height_mm:.2g} mm high, about ({place}) mm{floating}"


class Standing(NamedTuple):
    """What stands out: indices ``chosen`` (K,) of the test scan's surfels, and of all of these (M,): ``free``, whether
    they stand where the sample's scanner saw through, ``aside``, whether the sample's normals do not lead there,
    ``signed`` distances, ``normals`` (M, 3), ``level`` of detection, and the level ``alone`` of what covers all that
    was seen of a face.
    """

    chosen: Integers
    free: Flags
    aside: Flags
    signed: Floats
    normals: Floats
    level: Floats
    alone: Floats


class _Found(NamedTuple):
    """A connected piece of what stands out: its surfels' indices ``members``, how many of them stand out clearly, and
    the sum of their distances."""

    piece: Cluster
    members: Integers
    strong: int
    volume: float


def find_pieces(
    source: Scan, surface: Surfels, standing: Standing, min_surfels: int
) -> tuple[tuple[Cluster, ...], tuple[Speck, ...]]:
    """Connected pieces of at least ``min_surfels`` and specks, each largest volume first.

    Args:
        source: the test scan.
        surface: the good part in the frame of the test scan.
        standing: what stands out.
        min_surfels: that a piece, with those that may be of the same bead, has at twice the level of detection.
    """
    chosen, signed = standing.chosen, standing.signed
    if len(chosen) == 0:
        return (), ()
    size = surface.grid.size_mm
    places = source.surfels.points[chosen]
    labels = euclidean_clusters(places, 2 * size)
    number = int(labels.max()) + 1
    strong = np.bincount(labels, signed[chosen] > 2 * standing.level[chosen], number)
    dense = np.bincount(labels, source.surfels.counts[chosen], number) / np.bincount(labels, minlength=number)
    dense_enough = dense >= MIN_DENSITY * np.median(source.surfels.counts)
    volumes = np.bincount(labels, signed[chosen], number)
    found: list[_Found] = []
    for label in np.argsort(-volumes, kind="stable"):
        if strong[label] < min(MIN_SPECK, min_surfels) or not dense_enough[label]:
            continue
        members = chosen[labels == label]
        counted = _strong(source, members, standing, size)
        if counted < min(MIN_SPECK, min_surfels):
            continue
        piece = _piece(source, surface, members, standing)
        if piece is not None:
            found.append(_Found(piece, members, counted, float(volumes[label])))
    shown = _shown_with_others(found, source, standing)
    pieces: list[Cluster] = []
    specks: list[Speck] = []
    largest = 0.0
    for one, together in zip(found, shown, strict=True):
        floating = bool(np.quantile(one.piece.signed_mm, 0.02) > FLOATING_CELLS * size)
        if together >= min_surfels and one.volume >= MIN_VOLUME * largest and not floating:
            largest = max(largest, one.volume)
            pieces.append(one.piece)
        else:
            middle = source.surfels.points[one.members].mean(axis=0)
            specks.append(Speck(middle, one.piece.area_mm2, one.piece.peak_mm, floating))
    return tuple(pieces), tuple(specks)


def _shown_with_others(found: list[_Found], source: Scan, standing: Standing) -> list[int]:
    """How many surfels of each piece, and of those of which it may be a part of one bead, stand out clearly."""
    shown = [one.strong for one in found]
    for a, one in enumerate(found):
        for b in range(a):
            if _may_be_one(one, found[b], source, standing):
                shown[a] += found[b].strong
                shown[b] += one.strong
    return shown


def _may_be_one(one: _Found, other: _Found, source: Scan, standing: Standing) -> bool:
    """Whether two pieces may be parts of one bead of which the scans do not show what lies between."""
    peaks = sorted((one.piece.peak_mm, other.piece.peak_mm))
    ups = [part.piece.normals.mean(axis=0) for part in (one, other)]
    ups = [up / np.linalg.norm(up) for up in ups]
    if peaks[0] < ALIKE_HEIGHT * peaks[1] or ups[0] @ ups[1] < SAME_FACE:
        return False
    places, size = source.surfels.points, one.piece.spacing_mm
    ours, theirs = places[one.members], places[other.members]
    ahead = theirs.mean(axis=0) - ours.mean(axis=0)
    ahead /= np.linalg.norm(ahead)
    start, end = (ours @ ahead).max(), (theirs @ ahead).min()
    if end - start > np.ptp(ours @ ahead) + np.ptp(theirs @ ahead):
        return False
    offsets = places - (ours.mean(axis=0) + theirs.mean(axis=0)) / 2
    side = np.cross(ahead, ups[0] + ups[1])
    aside = np.abs(offsets @ side) / np.linalg.norm(side)
    along = places @ ahead
    between = (along > start) & (along < end) & (aside < AXIS_CELLS * size)
    high = np.abs(offsets @ (ups[0] + ups[1])) / 2 < max(FLOATING_CELLS * size, 2 * peaks[1])
    with np.errstate(invalid="ignore"):
        bare = standing.signed < standing.level
    return not bool((between & high & bare).any())


def _strong(source: Scan, members: Integers, standing: Standing, size: float) -> int:
    """How many surfels of a piece stand out by twice the level of detection, of the surface around the piece or, where
    that is not shown, by the level of what is ``alone``.

    A scanner's smooth errors move a face as a whole, which is no bead: they are alike in a piece and around it.
    """
    signed = standing.signed
    own = signed[members]
    absolute = int((own > 2 * standing.alone[members]).sum())
    places = source.surfels.points
    near, far = (cells * size for cells in RING_CELLS)
    at, away = nearest(build_cells(places[members], far), places, far)
    up = standing.normals[members].sum(axis=0)
    facing = standing.normals @ up > SAME_FACE * np.linalg.norm(up)
    ring = (at >= 0) & (away > near) & facing & np.isfinite(signed) & ~standing.aside
    if ring.sum() < MIN_SPECK:
        return absolute
    around = max(float(np.median(signed[ring])), 0.0)
    return max(absolute, int((own - around > 2 * standing.level[members]).sum()))


def _piece(source: Scan, surface: Surfels, members: Integers, standing: Standing) -> Cluster | None:
    """The scan's own points in the cells of a piece, with their signed distances; None where it is a wall."""
    flags = np.zeros(len(source.surfels), dtype=bool)
    flags[members] = True
    points = source.points[_points_of(source, flags)]
    size = surface.grid.size_mm
    distances, up, _ = signed_distances(surface, points, 2 * size, trusted=True)
    owner = members[nearest(build_cells(source.surfels.points[members], size), points, 4 * size)[0]]
    high = np.isnan(distances) | standing.aside[owner]
    if high.any():
        at = owner[high]
        up[high] = standing.normals[at]
        beyond = ((points[high] - source.surfels.points[at]) * up[high]).sum(axis=1)
        distances[high] = standing.signed[at] + beyond
    out = distances > 0
    feet = points[out] - distances[out, None] * up[out]
    if len(feet) < 3:
        return None
    footprint = len(build_cells(feet, size).starts) - 1
    if footprint < MIN_FOOTPRINT * len(members) and standing.free[members].mean() < MIN_FREE:
        return None
    area = len(members) * size**2 / 1.5
    peak = float(np.quantile(distances[out], 0.98))
    volume = area * float(np.mean(standing.signed[members]))
    return Cluster(points[out], distances[out], up[out], size, area, volume, peak)


def _points_of(source: Scan, flags: Flags) -> Integers:
    """Indices of the points of the surfels with a flag: those in their cells, and of a bent scan those nearest."""
    grid = source.surfels.grid
    if not source.bent:
        return _points_in_cells(source.points, flags, grid)
    at, _ = nearest(grid, source.points, 2 * grid.size_mm)
    return np.flatnonzero((at >= 0) & flags[at])


@njit(cache=True, nogil=True)
def _points_in_cells(points: Floats, flags: Flags, grid: CellGrid) -> Integers:
    """Indices of the points (N, 3) that lie in the cells with a flag."""
    table_keys, table_cells = grid.table_keys, grid.table_cells
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
    found = np.empty(len(points), dtype=np.int64)
    count = 0
    last, wanted = np.int64(-1), np.bool_(False)
    for p in range(len(points)):
        i = int((points[p, 0] - origin[0]) * per_mm)
        j = int((points[p, 1] - origin[1]) * per_mm)
        k = int((points[p, 2] - origin[2]) * per_mm)
        key = cell_key(i, j, k)
        if key != last:  # neighbours in a scan's row share a cell
            last, wanted = key, flags[table_cells[find_slot(table_keys, key)]]
        if wanted:
            found[count] = p
            count += 1
    return found[:count].copy()
