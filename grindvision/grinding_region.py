"""Where the engineer says that there is something to be ground: the stock of a part that the scans alone leave open.

A deformed part has no good surface but the one bent like it, and a field that explains the bending explains wide stock
as well. Where is stock is then known to the engineer only. In a ``region`` pieces that may be bending count as stock;
and a ``skin`` of asked thickness can be taken off the surface as it lies, whatever the sample says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from grindvision.errors import DegenerateError, InputError
from grindvision.geometry import move_points
from grindvision.geometry.height_map import HeightMap
from grindvision.vision.change.comparison import Comparison
from grindvision.vision.change.height_maps import empty_map, flat_parts, map_frame
from grindvision.vision.change.local_datum import LocalDatum, NoiseField, plane_terms
from grindvision.vision.change.stock import SPACINGS, MeasureStockOptions, Stock, StockPiece, point_spacing
from grindvision.vision.change.stock_sums import piece_sums
from grindvision.vision.registration.datum import in_datum
from grindvision.vision.surface.scan import Scan

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

MIN_SURFELS = 50
"""A region of fewer surfels is another frame or another unit."""

MOSTLY = 0.5
"""A piece of which so much lies in the region belongs to it."""

SHEET = 2.0
"""Neighbouring nodes whose ground differs by so many of their spacings lie on two faces, one over the other: a face of
the map leans by 45 degrees at most."""

TWO_THIRDS = (0.16, 0.5, 0.84)
"""Quantiles of a median and of the middle two thirds."""


def in_region(points: Floats, region_mm: ArrayLike, cell_mm: float) -> Flags:
    """Which points (N, 3) lie in a region: the corners (2, 3) of a box, or points (K, 3) on it.

    Raises:
        InputError: the region is neither.
    """
    try:
        return in_datum(points, region_mm, cell_mm)
    except InputError as error:
        raise InputError(str(error).replace("datum", "region")) from None


def check_region(compared: Comparison, region_mm: ArrayLike) -> Flags:
    """Which surfels (M,) of the test scan lie in the region.

    Raises:
        InputError: next to none.
    """
    source = compared.registration.source
    inside = in_region(source.surfels.points, region_mm, source.surfels.grid.size_mm)
    if inside.sum() < MIN_SURFELS:
        raise InputError(
            f"the region holds only {int(inside.sum())} cells of the test scan, {MIN_SURFELS} are needed; give it in"
            " TEST's frame and in mm"
        )
    return inside


def difference_there(compared: Comparison, inside: Flags) -> str:
    """In words, how much of the difference in the region was given to deformation, and what is left."""
    difference, deformed = compared.difference, compared.deformed
    left = difference.signed_mm[inside]
    left = left[np.isfinite(left)]
    if len(left) == 0:
        return "in the region the sample shows nothing to compare with"
    level = float(np.median(difference.level_mm[inside]))
    stands = float((left > level).mean())
    said = (
        f"in the region the test scan lies {_spread(left)} above the sample, and {stands:.0%} of it above the level of"
        f" detection of {level:.2g} mm"
    )
    if deformed is None:
        return said
    at = cKDTree(difference.surfels).query(deformed.points)[1]
    given = deformed.sizes_mm[inside[at]]
    if len(given) == 0:
        return said
    widest = deformed.field.scale_mm / (2 * deformed.field.order)
    return (
        f"of the difference in the region {_spread(given)} were given to deformation; above the sample bent like the"
        f" part the test scan lies {_spread(left)}, and {stands:.0%} of it above the level of detection of {level:.2g}"
        f" mm; stock wider than {widest:.3g} mm the deformation would have taken for its own"
    )


def outside_region(points: ArrayLike, region_mm: ArrayLike, cell_mm: float) -> Floats:
    """Points (N, 3) that do not lie in the region."""
    points = np.asarray(points, dtype=float)
    return points[~in_region(points, region_mm, cell_mm)]


def piece_in_region(piece: StockPiece, region_mm: ArrayLike, cell_mm: float) -> bool:
    """Whether a piece lies mostly in the region."""
    feet = piece.map.feet_mm[piece.inside & piece.map.shown]
    return bool(len(feet) and in_region(move_points(piece.map.T_scan_map, feet), region_mm, cell_mm).mean() >= MOSTLY)


def skin_stock(
    compared: Comparison, inside: Flags, region_mm: ArrayLike, skin_mm: float, options: MeasureStockOptions
) -> Stock:
    """A skin of equal thickness on the surface in a region, as the test scan shows it, as stock.

    Args:
        compared: the scans; the sample says nothing here.
        inside: surfels (M,) of the test scan in the region.
        region_mm: the region itself, as in ``in_region``.
        skin_mm: thickness along the normals.
        options: spacing of the nodes, margin around.

    Raises:
        DegenerateError: the scan shows no surface there.
    """
    scan = compared.registration.source
    spacing_mm = options.spacing_mm or SPACINGS * point_spacing(scan)
    places, normals = scan.surfels.points[inside], scan.surfels.normals[inside]
    usable = np.linalg.norm(normals, axis=1) > 0
    places, normals = places[usable], normals[usable]
    parts = [part for part in flat_parts(places, normals) if len(part) >= MIN_SURFELS]
    owner = np.full(len(places), -1)
    for number, part in enumerate(parts):
        owner[part] = number
    tree, points = cKDTree(places), cKDTree(scan.points)
    pieces = []
    for number, part in enumerate(parts):
        T_scan_map, size_mm = map_frame(places[part], normals[part], options.margin_mm)
        ground = _shown_ground(empty_map(scan.surfels, T_scan_map, size_mm, spacing_mm), points)
        feet = move_points(T_scan_map, ground.feet_mm[ground.shown])
        away, at = tree.query(feet)
        region, own = np.zeros((2, *ground.shape), dtype=bool)
        region[ground.shown] = in_region(feet, region_mm, spacing_mm)
        own[ground.shown] = (away <= scan.surfels.grid.size_mm) & (owner[at] == number)
        # the step down to the new surface lies between two nodes: both are of the region
        lowered = region & ~binary_dilation(~region, np.ones((3, 3)))
        if (lowered & own).any():
            pieces.append(_skin_piece(ground, lowered, own, scan, skin_mm))
    if not pieces:
        raise DegenerateError("the test scan shows no surface in the region that is smooth enough to be ground")
    pieces.sort(key=lambda one: -one.volume_mm3)
    return Stock(tuple(pieces), (), (), pieces[0].level_mm, (-1,) * len(pieces))


def _shown_ground(ground: HeightMap, points: cKDTree) -> HeightMap:
    """A map without the nodes beside which the scan has no points, as the planes of surfels reach beyond the part, and
    without those between two faces."""
    shown = ground.shown
    away, _ = points.query(move_points(ground.T_scan_map, ground.feet_mm[shown]))
    near = shown.copy()
    near[shown] = away <= ground.spacing_mm
    elevation, step = np.where(near, ground.ground_mm, np.nan), SHEET * ground.spacing_mm
    for axis in (0, 1):
        apart = np.abs(np.diff(elevation, axis=axis)) > step
        ends = [(0, 1), (0, 0)], [(1, 0), (0, 0)]
        for pad in ends:
            near &= ~np.pad(apart, pad if axis == 0 else pad[::-1])
    return replace(
        ground,
        ground_mm=np.where(near, ground.ground_mm, np.nan),
        normals=np.where(near[..., None], ground.normals, np.nan),
    )


def _skin_piece(ground: HeightMap, lowered: Flags, own: Flags, scan: Scan, skin_mm: float) -> StockPiece:
    """A piece of stock on its ``own`` of the nodes (R, C) at which the good surface lies a skin under that shown."""
    inside = lowered & own
    facing = np.where(ground.shown, ground.normals[..., 2], 1.0)
    heights = replace(
        ground,
        ground_mm=ground.ground_mm - np.where(lowered, skin_mm / facing, 0.0),
        heights_mm=np.where(ground.shown, np.where(lowered, skin_mm, 0.0), np.nan),
    )
    noise = scan.surfels.noise_mm**2
    excess = np.maximum(scan.surfels.roughness_mm**2 - noise, 0)
    variance = float(np.median(noise / scan.surfels.counts + excess / 4))
    level_mm, shape = 1.96 * float(np.sqrt(variance)), ground.shape
    datum = LocalDatum(plane_terms(shape), np.zeros(3), np.zeros((3, 3)), NoiseField(np.array([variance])), 0)
    sigma, hidden = np.full(shape, np.sqrt(variance)), np.zeros(shape, dtype=bool)
    sums = piece_sums(heights, inside, hidden, datum, min(level_mm, skin_mm / 2), sigma, 0.0)
    unchanged = ground.shown & ~lowered
    return StockPiece(
        heights, sigma, inside, hidden, unchanged, datum, level_mm, **sums, hidden_mm2=0.0, unshown_mm2=0.0,
        asked_mm=skin_mm,
    )  # fmt: skip


def _spread(values_mm: Floats) -> str:
    """A median and the middle two thirds of lengths, in words."""
    low, middle, high = np.quantile(values_mm, TWO_THIRDS)
    return f"{middle:+.2f} mm (two thirds from {low:+.2f} to {high:+.2f} mm)"
