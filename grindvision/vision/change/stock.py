"""The stock: how much stands above the good surface and where, as height maps with their uncertainty.

Each piece of the difference is laid out over the good surface, along its normals. Three errors are told apart: noise,
which is alike over short distances only; what the registration and the scanner's distortion leave, common to a piece;
and what the scan does not show. Missing material is reported and is no stock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, uniform_filter

from grindvision.errors import InputError
from grindvision.geometry import inverse, move_points, orthonormalised, rotate_vectors
from grindvision.geometry.height_map import HeightMap
from grindvision.parallel import one_blas_thread
from grindvision.records import by_content
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.change.coverage import Patch
from grindvision.vision.change.diagnostics import missing_pieces
from grindvision.vision.change.height_maps import empty_map, flat_parts, map_frame, measure_heights
from grindvision.vision.change.local_datum import LocalDatum, fit_datum, plane_terms
from grindvision.vision.change.pieces import Cluster
from grindvision.vision.change.stock_sums import FLAT, bridged_heights, piece_sums, sampling_variance
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.scan import Scan, surface_in_frame
from grindvision.vision.surface.surfels import Surfels
from grindvision.words import counted, rounded

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]

SPACINGS = 1.5
"""Nodes stand so many spacings of the scan's points apart: some points fall to each."""

RIM_CELLS = 1.5
"""The volume is taken over the piece and so many surfels around it: its foot is lower than what is told."""

CLEAR_CELLS = 3.0
"""What is nearer to a piece, in surfels, does not count as unchanged surface."""

ALIKE_CELLS = 5.0
"""Noise is alike over no more surfels."""


@dataclass(frozen=True)
class MeasureStockOptions:
    """Settings of ``measure_stock``: ``spacing_mm`` of the maps' nodes (left out: one and a half of the points'), and
    the ``margin_mm`` of good surface that is mapped around each piece."""

    spacing_mm: float | None = None
    margin_mm: float = 12.0

    def __post_init__(self) -> None:
        if self.spacing_mm is not None and not 0 < self.spacing_mm < np.inf:
            raise InputError(f"nodes {self.spacing_mm} mm apart were asked for; give a length above zero")
        if not 0 < self.margin_mm < np.inf:
            raise InputError(f"a margin of {self.margin_mm} mm was asked for; give a length above zero")


class _Scans(NamedTuple):
    """Points (N, 3) of the source, and of the target brought to it, whose surfels are the ``surface``."""

    source: Floats
    target: Floats
    surface: Surfels


class MappedPlace(NamedTuple):
    """A place on the part: a map, the nodes (R, C) ``inside`` a piece and those ``unchanged``, and how high the piece
    stands at most."""

    map: HeightMap
    inside: Flags
    unchanged: Flags
    highest_mm: float


@by_content
@dataclass(frozen=True)
class StockPiece:
    """One piece of stock over the good surface, with standard deviations (``sigma``).

    ``map``: heights along the normals of the good surface, in the frame of the test scan, freed from the ``datum``,
    which the ground holds: it is where the good surface lies in that scan;
    ``sigma_mm`` (R, C) of each node; ``inside`` (R, C) the nodes over which the volume is taken; ``hidden`` (R, C)
    those of them that the test scan does not show and whose height is interpolated; ``unchanged`` (R, C) the surface
    around, of no piece. ``area_mm2``: of the good surface under what stands above ``level_mm``, the level of detection.
    ``hidden_mm2``: area of what is hidden; ``unshown_mm2``: that in and beside the piece of which one of the scans
    shows nothing: what may stand there is not in the stock. ``asked_mm``: thickness of a layer that was asked for and
    not measured.
    """

    map: HeightMap
    sigma_mm: Floats
    inside: Flags
    hidden: Flags
    unchanged: Flags
    datum: LocalDatum
    level_mm: float
    volume_mm3: float
    volume_sigma_mm3: float
    area_mm2: float
    area_sigma_mm2: float
    height_max_mm: float
    height_max_sigma_mm: float
    height_mean_mm: float
    height_mean_sigma_mm: float
    hidden_mm2: float
    unshown_mm2: float
    asked_mm: float | None = None

    @property
    def place(self) -> MappedPlace:
        """Where the piece is, to be measured again."""
        facing = np.where(self.map.shown, self.map.normals[..., 2], 1.0)
        ground = self.map.ground_mm - self.datum.heights_mm / facing
        return MappedPlace(replace(self.map, ground_mm=ground), self.inside, self.unchanged, self.height_max_mm)

    @property
    def ground_sigma_mm(self) -> float:
        """Standard deviation of the good surface under the piece: the datum's and one node's noise."""
        common = float(self.datum.variances_mm2[self.inside].mean()) if self.inside.any() else 0.0
        return float(np.sqrt(common + self.datum.noise.covariance_mm2[0]))

    @property
    def above(self) -> Flags:
        """Nodes (R, C) of the piece that stand above the level of detection."""
        return self.inside & (np.nan_to_num(self.map.heights_mm) > self.level_mm)

    def __str__(self) -> str:
        hidden = f", {rounded(self.hidden_mm2)} mm2 hidden" if self.hidden_mm2 else ""
        unshown = f", {rounded(self.unshown_mm2)} mm2 beside it not shown" if self.unshown_mm2 else ""
        return (
            f"{self.volume_mm3:.4g} +- {rounded(self.volume_sigma_mm3, 2)} mm3 on {self.area_mm2:.4g} +-"
            f" {rounded(self.area_sigma_mm2, 2)} mm2, at most {self.height_max_mm:.3g} +-"
            f" {self.height_max_sigma_mm:.2g} mm high{hidden}{unshown}"
        )


@by_content
@dataclass(frozen=True)
class Stock:
    """All ``pieces`` that stand above the good surface, largest first; ``pits`` where material is missing, which is
    never ground, with their ``pit_depths_mm``; ``level_mm`` the level of detection (median). ``numbers``: the piece of
    the difference, from 0, on which each was measured: a piece round an edge is several of stock."""

    pieces: tuple[StockPiece, ...]
    pits: tuple[Patch, ...]
    pit_depths_mm: tuple[float, ...]
    level_mm: float
    numbers: tuple[int, ...]

    @property
    def volume_mm3(self) -> float:
        """Volume of all pieces."""
        return float(sum(piece.volume_mm3 for piece in self.pieces))

    @property
    def volume_sigma_mm3(self) -> float:
        """Its standard deviation; the pieces' errors count as independent."""
        return float(np.sqrt(sum(piece.volume_sigma_mm3**2 for piece in self.pieces)))

    def __str__(self) -> str:
        places = counted(len(self.pits), "place")
        pits = f"; material is missing in {places}, the largest {self.pits[0]}" if self.pits else ""
        if not self.pieces:
            return f"no stock above {self.level_mm:.2g} mm{pits}"
        volume = f"{self.volume_mm3:.4g} +- {rounded(self.volume_sigma_mm3, 2)} mm3"
        if (asked_mm := self.pieces[0].asked_mm) is not None:
            return f"a layer of {asked_mm:g} mm as asked for, {volume} in {counted(len(self.pieces), 'piece')}"
        return f"{counted(len(self.pieces), 'piece')} of stock, {volume} above {self.level_mm:.2g} mm{pits}"


@one_blas_thread()
def measure_stock(
    source: Scan,
    target: Scan,
    registration: FineRegistration,
    difference: Difference,
    options: MeasureStockOptions | None = None,
) -> Stock:
    """Height, volume and area of what ``find_change`` found, and where material is missing.

    Args:
        source: the test scan, as a ``Detection`` has it under ``test``.
        target: the sample.
        registration: pose T_target_source, with its covariance.
        difference: the pieces, in the frame of the test scan.
        options: spacing of the nodes, margin.
    """
    options = MeasureStockOptions() if options is None else options
    back = inverse(registration.T_target_source)
    surface = surface_in_frame(target.surfels, back)
    scans = _Scans(source.points, move_points(back, target.points), surface)
    spacing = options.spacing_mm or SPACINGS * point_spacing(source)
    numbered = [(number, one) for number, cluster in enumerate(difference.clusters) for one in _outlines(cluster)]
    outlines = [outline for _, outline in numbered]
    pieces = []
    for at, (feet, normals, highest_mm) in enumerate(outlines):
        T_scan_map, size_mm = map_frame(feet, normals, options.margin_mm)
        empty = empty_map(surface, T_scan_map, size_mm, spacing)
        others = [outline[0] for other, outline in enumerate(outlines) if other != at]
        inside, unchanged = _inside(empty, feet, others, difference.cell_mm)
        place = MappedPlace(_smoothed(empty, scans, difference), inside, unchanged, highest_mm)
        pieces.append(_measured(scans, registration, difference, place))
    pits = missing_pieces(source, target, registration)
    return Stock(
        tuple(pieces),
        tuple(Patch(move_points(back, pit.points.mean(axis=0)), pit.area_mm2) for pit in pits),
        tuple(pit.peak_mm for pit in pits),
        difference.level_of_detection_mm,
        tuple(number for number, _ in numbered),
    )


@one_blas_thread()
def measure_again(
    source: Scan,
    target: Scan,
    registration: FineRegistration,
    difference: Difference,
    places: Sequence[MappedPlace],
    T_source_scan: Floats,
) -> tuple[StockPiece, ...]:
    """What stands at the same places, over the same nodes, in a new scan of the part, the ``source``.

    ``places`` are in the frame of an earlier scan, from which ``T_source_scan`` (4, 4) leads to the new one.
    """
    back = inverse(registration.T_target_source)
    scans = _Scans(source.points, move_points(back, target.points), surface_in_frame(target.surfels, back))
    found = []
    for place in places:
        T_source_map = orthonormalised(T_source_scan @ place.map.T_scan_map)
        empty = replace(place.map, T_scan_map=T_source_map, heights_mm=np.full(place.map.shape, np.nan))
        highest_mm = max(place.highest_mm, difference.level_of_detection_mm)
        there = MappedPlace(empty, place.inside, place.unchanged, highest_mm)
        found.append(_measured(scans, registration, difference, there))
    return tuple(found)


def point_spacing(scan: Scan) -> float:
    """Spacing of a scan's points in mm, from their number in a surfel's cell."""
    return float(scan.surfels.grid.size_mm / np.sqrt(max(float(np.median(scan.surfels.counts)), 1.0)))


def _outlines(cluster: Cluster) -> list[tuple[Floats, Floats, float]]:
    """Feet (N, 3), normals (N, 3) and greatest height of the parts of a piece that are flat enough for one map."""
    feet = cluster.points - cluster.signed_mm[:, None] * cluster.normals
    parts = flat_parts(feet, cluster.normals)
    return [(feet[part], cluster.normals[part], float(cluster.signed_mm[part].max())) for part in parts]


def _inside(empty: HeightMap, feet: Floats, others: Sequence[Floats], cell_mm: float) -> tuple[Flags, Flags]:
    """Nodes (R, C) of a piece with its rim, and nodes that belong to no piece: the unchanged surface around it."""
    own = _away(empty, feet)
    away = np.minimum.reduce([np.full(empty.shape, np.inf), *(_away(empty, other) for other in others)])
    return (own <= RIM_CELLS * cell_mm) & (own < away), np.minimum(own, away) > CLEAR_CELLS * cell_mm


def _away(empty: HeightMap, feet: Floats) -> Floats:
    """Distance (R, C) in mm over the map of each node from the nearest foot; infinite where none lies on it."""
    places = move_points(inverse(empty.T_scan_map), feet)
    at = np.rint(places[:, :2] / empty.spacing_mm).astype(np.int64)
    there = ((at >= 0) & (at < empty.shape)).all(axis=1)
    # feet under or over this part of the surface are none of its own
    rows, columns = np.where(there, at.T, 0)
    off = np.abs(places[:, 2] - empty.ground_mm[rows, columns])
    there &= ~(off > empty.spacing_mm * max(empty.shape) / 4)
    free = np.ones(empty.shape, dtype=bool)
    free[tuple(at[there].T)] = False
    if free.all():
        return np.full(empty.shape, np.inf)
    return np.asarray(distance_transform_edt(free)) * empty.spacing_mm


def _smoothed(empty: HeightMap, scans: _Scans, difference: Difference) -> HeightMap:
    """The ground freed from how planes of surfels cut a curved surface, by the mean over a surfel."""
    below = measure_heights(scans.target, scans.surface, empty, 4 * difference.level_of_detection_mm)
    cells = 2 * int(difference.cell_mm / empty.spacing_mm / 2) + 1
    smooth = uniform_filter(np.nan_to_num(below.heights_mm), cells)
    return replace(empty, ground_mm=empty.ground_mm + smooth / np.where(empty.shown, empty.normals[..., 2], 1.0))


def _measured(
    scans: _Scans,
    registration: FineRegistration,
    difference: Difference,
    there: MappedPlace,
) -> StockPiece:
    """A piece over an ``empty`` map, given the nodes ``inside`` it, those ``unchanged``, and how high it may be.

    Both scans are measured over the planes of the sample's surfels: how planes cut a curved surface drops out.
    """
    empty, inside, unchanged, highest_mm = there
    level_mm = difference.level_of_detection_mm
    measured = measure_heights(scans.source, scans.surface, empty, 1.3 * highest_mm + 4 * level_mm)
    below = measure_heights(scans.target, scans.surface, empty, 4 * level_mm)
    raw = measured.heights_mm - np.nan_to_num(below.heights_mm)
    seen = measured.weights > 0
    usual_square = float(np.median(measured.squares_mm2[seen])) if seen.any() else level_mm**2
    scatter = np.sqrt(usual_square / np.median(measured.weights[seen])) if seen.any() else level_mm
    prior = _prior(registration, empty, difference)
    reach = int(np.ceil(ALIKE_CELLS * difference.cell_mm / empty.spacing_mm))
    datum = fit_datum(raw, unchanged & empty.shown, prior, max(float(scatter), 1e-6), reach)
    inside_visible = inside & empty.shown
    hidden = inside_visible & ~np.isfinite(raw)
    heights = raw - datum.heights_mm
    if hidden.any():
        heights = np.where(hidden, bridged_heights(heights, inside_visible), heights)
    usual = float(np.median(measured.weights[inside_visible & ~hidden])) if (inside_visible & ~hidden).any() else 1.0
    noise = datum.noise.sigma_mm * np.sqrt(usual / np.maximum(measured.weights, 1e-9))
    noise = np.where(hidden, FLAT * np.abs(np.nan_to_num(heights)) + datum.noise.sigma_mm, noise)
    sigma = np.where(inside_visible | np.isfinite(raw), np.sqrt(noise**2 + datum.variances_mm2), np.nan)
    facing = np.where(empty.shown, empty.normals[..., 2], 1.0)
    filled = replace(
        empty,
        ground_mm=empty.ground_mm + datum.heights_mm / facing,
        heights_mm=np.where(empty.shown, heights, np.nan),
    )
    sampling = sampling_variance(measured, filled, inside_visible, usual_square)
    return StockPiece(
        filled, sigma, inside_visible, hidden, unchanged & empty.shown, datum, level_mm,
        **piece_sums(filled, inside_visible, hidden, datum, level_mm, sigma, sampling),
        hidden_mm2=float(filled.areas_mm2[hidden].sum()),
        unshown_mm2=float((~unchanged & ~inside_visible & ~np.isfinite(raw)).sum() * empty.spacing_mm**2),
    )  # fmt: skip


def _prior(registration: FineRegistration, empty: HeightMap, difference: Difference) -> Floats:
    """Covariance (3, 3) of the plane's terms: the pose's, and what the scanner's distortion may leave."""
    field = np.diag(np.full(3, (difference.level_of_detection_mm / 1.96) ** 2))
    covariance = registration.total_covariance
    if not np.isfinite(covariance).all() or empty.shown.sum() < 3:
        return field
    transform = registration.T_target_source @ empty.T_scan_map
    feet, up = move_points(transform, empty.feet_mm[empty.shown]), empty.normals[empty.shown]
    up = rotate_vectors(transform, up)
    jacobian = np.column_stack([up, np.cross(feet - registration.centre_mm, up)])
    terms = plane_terms(empty.shape)[:, empty.shown].T
    plane = np.linalg.lstsq(terms, jacobian, rcond=1e-6)[0]
    return plane @ covariance @ plane.T + field
