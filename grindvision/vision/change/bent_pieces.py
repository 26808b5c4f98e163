"""Which pieces of a difference may be bending of a deformed part that its field has no term for, and not stock.

A bend has no boundary on its surface: it goes on to the rim of the face, or is as wide as the field's own waves. Stock
is narrow, and its surface agrees with the sample on both sides of it. And what a field leaves goes either way, as
bending does, while stock only stands out: where as much is missing elsewhere, what stands out may be the field's error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.registration.deformed_registration import DeformedPart
from grindvision.vision.surface.clustering import euclidean_clusters
from grindvision.words import rounded

Floats = NDArray[np.float64]

ASKED = 400
"""So many points of a piece are asked what lies on either side of them."""

FAR_CELLS = 20.0
"""Surface farther from a piece than so many cells is not beside it."""

SAME_FACE, RISING = 0.7, 0.5
"""Cosine between the normals of one face; and sine above a piece's face from which another one rises out of a corner,
where a weld has it on its other side. What falls away beyond an edge is no side of a piece."""

OPPOSITE = -0.5
"""Cosine to the mean direction of the agreeing surface about a point below which some lies on its other side, too."""

MIN_SURFELS = 10
"""So many connected surfels twice the level of detection deep are as sure to be missing as a piece is to stand out."""

MIN_BETWEEN = 0.5
"""Least fraction of a piece that lies between agreeing surface on both sides."""


def bending_doubts(difference: Difference, normals: Floats, deformed: DeformedPart) -> dict[int, str]:
    """Reasons, by the number of the piece from 0, why pieces on a deformed part may be bent and not stock; ``normals``
    (M, 3) of the difference's surfels."""
    found = {}
    deepest = deepest_missing(difference) if difference.clusters else (0.0, np.zeros(3))
    for number, cluster in enumerate(difference.clusters):
        said = _too_wide(cluster, deformed) or _at_a_rim(cluster, difference, normals) or _no_higher(cluster, *deepest)
        if said:
            found[number] = f"{_place(cluster)} on a deformed part: {said}, so it is stock only if you know it to be"
    return found


def deepest_missing(difference: Difference) -> tuple[float, Floats]:
    """Depth in mm and middle (3,) of the deepest connected place where material is missing, by the rule for a piece."""
    depths = np.nan_to_num(-difference.signed_mm)
    missing = np.flatnonzero(difference.comparable & (depths > difference.level_mm))
    depth_mm, middle = 0.0, np.zeros(3)
    if len(missing) == 0:
        return depth_mm, middle
    labels = euclidean_clusters(difference.surfels[missing], 2 * difference.cell_mm)
    strong = depths[missing] > 2 * difference.firm_level_mm[missing]
    for label in np.flatnonzero(np.bincount(labels, strong) >= MIN_SURFELS):
        members = missing[labels == label]
        depth = float(np.quantile(depths[members], 0.98))
        if depth > depth_mm:
            depth_mm, middle = depth, difference.surfels[members].mean(axis=0)
    return depth_mm, middle


def fraction_between(cluster: Cluster, difference: Difference, normals: Floats) -> float:
    """Fraction of a piece on whose two sides the test scan agrees with the sample, within the level of detection."""
    cell = difference.cell_mm
    agrees = np.abs(difference.signed_mm) <= difference.level_mm  # NaN does not
    if not agrees.any():
        return 0.0
    some = slice(None, None, -(-len(cluster.points) // ASKED))
    up = cluster.normals[some]
    feet = cluster.points[some] - cluster.signed_mm[some, None] * up
    places, faces = difference.surfels[agrees], normals[agrees]
    reach = min(_width(cluster) + 2 * cell, FAR_CELLS * cell)
    around = within_radius(build_cells(places, reach), feet, reach)
    sides = []
    for one in range(len(feet)):
        near = around.indices[around.starts[one] : around.starts[one + 1]]
        arms = places[near] - feet[one]
        rises = arms @ up[one]
        beside = arms - rises[:, None] * up[one]
        counts = (faces[near] @ up[one] > SAME_FACE) | (rises > RISING * np.linalg.norm(arms, axis=1))
        sides.append(beside[counts & (np.linalg.norm(beside, axis=1) > 0)])
    return _between(sides, cell)


def _between(sides: list[Floats], cell: float) -> float:
    """Fraction of the points about which arms (K, 3) along the surface lead to agreement on two opposite sides, of each
    no farther away than a strip is wide: twice as far as its middle lies from the nearer side."""
    lengths = [np.linalg.norm(arms, axis=1) for arms in sides]
    nearest_side = np.array([one.min(initial=np.inf) for one in lengths])
    reach = 2 * float(np.quantile(nearest_side, 0.9, method="lower")) + 2 * cell
    between = np.zeros(len(sides), dtype=bool)
    for one, (arms, sizes) in enumerate(zip(sides, lengths, strict=True)):
        directions = arms[sizes < reach] / sizes[sizes < reach, None]
        if len(directions) > 1:
            mean = directions.mean(axis=0)
            between[one] = (directions @ mean).min() < OPPOSITE * np.linalg.norm(mean)
    return float(between.mean())


def _width(cluster: Cluster) -> float:
    """Width in mm of a piece, by the second of its principal axes."""
    _, sizes, _ = np.linalg.svd(cluster.points - cluster.points.mean(axis=0), full_matrices=False)
    return float(np.sqrt(12) * sizes[1] / np.sqrt(len(cluster.points)))


def _too_wide(cluster: Cluster, deformed: DeformedPart) -> str:
    """In words, that a piece is as wide as half a wave of the field; empty where it is not."""
    widest, width = deformed.field.scale_mm / (2 * deformed.field.order), _width(cluster)
    if width <= widest:
        return ""
    return f"it is {width:.3g} mm wide and may be bent there more finely than the field tells ({widest:.3g} mm)"


def _at_a_rim(cluster: Cluster, difference: Difference, normals: Floats) -> str:
    """In words, that nothing of its face agrees on one of the sides of a piece; empty where it does on both."""
    between = fraction_between(cluster, difference, normals)
    if between >= MIN_BETWEEN:
        return ""
    return (
        f"only {between:.0%} of it lies between surface of its face that agrees with the sample on both sides; a rim or"
        " a face that is bent looks the same"
    )


def _no_higher(cluster: Cluster, depth_mm: float, middle: Floats) -> str:
    """In words, that a piece is no higher than material is missing about a place (3,); empty where it is higher."""
    if cluster.peak_mm > depth_mm:
        return ""
    return (
        f"it is {cluster.peak_mm:.2g} mm high where {depth_mm:.2g} mm are missing about"
        f" ({', '.join(f'{v:.0f}' for v in middle)}) mm: what the field leaves goes either way"
    )


def _place(cluster: Cluster) -> str:
    """Area and place of a piece, in words."""
    return f"{rounded(cluster.area_mm2)} mm2 about ({', '.join(f'{v:.0f}' for v in cluster.points.mean(axis=0))}) mm"
