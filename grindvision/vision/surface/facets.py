"""Facets of a model made sound: without degenerate ones, wound alike where they join, their normals outwards.

Which side is outside is told by rays: from the outer side of a surface more ways lead to the open than from the inner
one, for closed solids, open shells and cracked meshes alike. Where both sides see as much of the open (a single
sheet), the winding is taken for what it says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from grindvision.errors import DegenerateError
from grindvision.records import by_content
from grindvision.triangles import double_areas, sound, spread_points
from grindvision.vision.surface.ray_casting import RayTree, blocked, ray_tree

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

SAME_VERTEX = 1e-6
"""Vertices nearer to each other than this fraction of the diagonal are one."""

DIRECTIONS, ASKED_POINTS, ASKED_RAYS, ASKED_PIECES = 24, 40, 100_000, 500
"""Rays per place, places per connected piece, rays in all, and pieces (the largest) whose outside is told by rays."""

COS_ASKED = 0.2
"""Cosine of the angle to the normal from which on rays tell the two sides of a surface apart."""

MIN_LEAD = 0.05
"""One side is outside where its fraction of free ways is larger by so much."""

CLOSED_RIM = 0.05
"""A surface whose rim is shorter than this fraction of the root of its area is closed but for cracks."""


@by_content
@dataclass(frozen=True)
class Facets:
    """Triangles in mm: ``corners`` (T, 3, 3), outward unit ``normals`` (T, 3), ``areas_mm2`` (T,).

    ``degenerate``: how many had no area and were left out; ``turned``: how many were wound inside out, of an area of
    ``flipped_mm2``; ``closed``: whether they bound a solid; ``sided``: whether it was told which side is outside, of
    most of their area.
    """

    corners: Floats
    normals: Floats
    areas_mm2: Floats
    degenerate: int
    turned: int
    flipped_mm2: float
    closed: bool
    sided: bool

    @property
    def area_mm2(self) -> float:
        """Area of all facets."""
        return float(self.areas_mm2.sum())

    @property
    def diagonal_mm(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.corners.reshape(-1, 3), axis=0)))

    def __len__(self) -> int:
        return len(self.corners)

    def __str__(self) -> str:
        degenerate = f", {self.degenerate} degenerate left out" if self.degenerate else ""
        turned = f", {self.turned} inside out turned" if self.turned else ""
        return f"{len(self):,} facets ({'closed' if self.closed else 'open'}{degenerate}{turned})"


def sound_facets(vertices: Floats, triangles: Integers) -> tuple[Facets, RayTree]:
    """Facets of a mesh of vertices (V, 3) and triangles (T, 3), and the tree that casts rays at them.

    Raises:
        DegenerateError: no triangle has an area.
    """
    good = sound(vertices[triangles])
    if not good.any():
        raise DegenerateError(f"none of the model's {len(triangles)} triangles has an area; export the mesh again")
    corners = vertices[triangles[good]]
    tree = ray_tree(corners)
    crosses = double_areas(corners)
    lengths = np.linalg.norm(crosses, axis=1)
    normals, areas = crosses / lengths[:, None], lengths / 2
    pairs, opposed, rim = _joined(corners)
    piece, turned = _wound_alike(pairs, opposed, areas)
    lead = _outer_lead(tree, corners, np.where(turned[:, None], -normals, normals), areas, piece)
    turned ^= lead[piece] < -MIN_LEAD
    told = np.abs(lead[piece]) >= MIN_LEAD
    return Facets(
        np.where(turned[:, None, None], corners[:, ::-1], corners),
        np.where(turned[:, None], -normals, normals),
        areas,
        int((~good).sum()),
        int(turned.sum()),
        float(areas[turned].sum()),
        bool(rim < CLOSED_RIM * np.sqrt(areas.sum())),
        bool(areas[told].sum() > 0.5 * areas.sum()),
    ), tree


def _joined(corners: Floats) -> tuple[Integers, Flags, float]:
    """Pairs (P, 2) of triangles that share an edge which no third has, whether the two are wound against each other
    (P,), and the length in mm of all edges that are a single triangle's."""
    count = len(corners)
    places = corners.reshape(-1, 3)
    size = SAME_VERTEX * float(np.linalg.norm(np.ptp(places, axis=0)))
    cells = np.round((places - places.min(axis=0)) / size).astype(np.int64)
    _, vertex = np.unique(cells @ np.array([1 << 42, 1 << 21, 1]), return_inverse=True)
    ends = vertex.reshape(count, 3)
    begin, end = ends.ravel(), np.roll(ends, -1, axis=1).ravel()
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.lexsort((high, low))
    new = np.r_[True, (low[order][1:] != low[order][:-1]) | (high[order][1:] != high[order][:-1])]
    starts = np.flatnonzero(new)
    shared = np.diff(np.r_[starts, len(order)])
    first = order[starts[shared == 2]]
    second = order[starts[shared == 2] + 1]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).ravel()
    rim = float(lengths[order[starts[shared == 1]]].sum())
    return np.stack([first // 3, second // 3], axis=1), begin[first] == begin[second], rim


def _wound_alike(pairs: Integers, opposed: Flags, areas: Floats) -> tuple[Integers, Flags]:
    """Connected piece (T,) of each triangle, and which (T,) to turn so that all of a piece are wound as most of it is.

    In a graph with both sides of each triangle, the two sides of a piece that can be wound alike are not connected.
    """
    count = len(areas)
    one, other = pairs.T
    link = coo_matrix((np.ones(len(pairs)), (one, other)), shape=(count, count))
    pieces, piece = connected_components(link, directed=False)
    rows = np.concatenate([one, one + count])
    columns = np.concatenate([other + count * opposed, other + count * ~opposed])
    both = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(2 * count, 2 * count))
    _, side = connected_components(both, directed=False)
    leader = np.full(pieces, count)
    np.minimum.at(leader, piece, np.arange(count))
    one_sided = side[leader] == side[leader + count]  # a Moebius strip
    turned = (side[:count] != side[leader][piece]) & ~one_sided[piece]
    against = np.bincount(piece, areas * turned, pieces) > 0.5 * np.bincount(piece, areas, pieces)
    return piece.astype(np.int64), turned ^ against[piece]


def _outer_lead(tree: RayTree, corners: Floats, normals: Floats, areas: Floats, piece: Integers) -> Floats:
    """For each piece how much larger the fraction of free ways is before its facets than behind them; zero where that
    was not asked."""
    totals = np.bincount(piece, areas)
    lead = np.zeros(len(totals))
    asked = np.argsort(-totals, kind="stable")[:ASKED_PIECES]
    each = int(np.clip(ASKED_RAYS / (DIRECTIONS * len(asked)), 4, ASKED_POINTS))
    order = np.argsort(piece, kind="stable")
    bounds = np.searchsorted(piece[order], np.arange(len(totals) + 1))
    places, up, owner = [], [], []
    for one in asked:
        members = order[bounds[one] : bounds[one + 1]]
        points, facet = spread_points(corners[members], each)
        places.append(points)
        up.append(normals[members[facet]])
        owner.append(np.full(len(points), one))
    points, facing, whose = np.concatenate(places), np.concatenate(up), np.concatenate(owner)
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    ways = 2 * diagonal * sphere(DIRECTIONS)
    for sign in (1.0, -1.0):
        row, way = np.nonzero(sign * (facing @ ways.T) > COS_ASKED * 2 * diagonal)
        free = ~blocked(tree, (points + 1e-5 * diagonal * sign * facing)[row], ways[way])
        tried = np.bincount(whose[row], minlength=len(totals))
        lead += sign * np.bincount(whose[row], free, len(totals)) / np.maximum(tried, 1)
    return lead


def sphere(count: int) -> Floats:
    """So many unit directions (N, 3), spread evenly by Fibonacci's spiral."""
    height = 1 - (2 * np.arange(count) + 1) / count
    azimuth = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    flat = np.sqrt(1 - height**2)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height])
