"""What a comparison could not show: surface that was not compared, and how high a bead must be to be told, by place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import InputError
from grindvision.geometry import inverse, move_points
from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.records import by_content
from grindvision.vision.change.change_detection import Difference
from grindvision.vision.registration.icp import FineRegistration
from grindvision.vision.surface.clustering import euclidean_clusters
from grindvision.vision.surface.scan import Scan, surface_in_frame
from grindvision.words import rounded

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

MIN_PATCH_CELLS = 10
"""Places of fewer surfels that were not compared are not told one by one: a piece must have as many."""

RIM_CELLS = 3.0
"""Nothing within so many cells of a scan's rim can be compared, wherever it is; that is not told place by place."""

AREA_PER_CELL = 1 / 1.5
"""A surface of one square cell passes through so many cubic cells in the mean (inverse)."""

SAME_CELLS = 0.06
"""Nine of ten points of a copy lie within so many cells of a point of the other scan."""


@by_content
@dataclass(frozen=True)
class Patch:
    """A connected place: its middle (3,) in mm, frame of the test scan, and its area."""

    middle_mm: Floats
    area_mm2: float

    def __str__(self) -> str:
        return f"{rounded(self.area_mm2)} mm2 about ({', '.join(f'{value:.0f}' for value in self.middle_mm)}) mm"


@by_content
@dataclass(frozen=True)
class Coverage:
    """What was compared, frame of the test scan.

    ``test_fraction`` of the test scan's surface was compared; ``test_missed`` are the larger places that were not,
    largest first, ``test_missed_mm2`` their and all other's area. ``sample_fraction``, ``sample_missed``,
    ``sample_missed_mm2``: of the sample's surface, where the test scan showed nothing. ``height_mm`` (median) and
    ``height_95_mm`` (of 95 % of what was compared) from which a bead at least ``width_mm`` wide is told;
    ``sideways_mm``: how far flash in line with a face must stand out beyond its edge to be told.
    """

    test_fraction: float
    test_missed: tuple[Patch, ...]
    test_missed_mm2: float
    sample_fraction: float
    sample_missed: tuple[Patch, ...]
    sample_missed_mm2: float
    height_mm: float
    height_95_mm: float
    width_mm: float
    sideways_mm: float

    def __str__(self) -> str:
        return (
            f"{self.test_fraction:.0%} of the test scan and {self.sample_fraction:.0%} of the sample were compared;"
            f" beads {self.width_mm:.2g} mm wide are told from {self.height_mm:.2g} mm high on half of it, from"
            f" {self.height_95_mm:.2g} mm on 95 %; flash in line with a face is told from {self.sideways_mm:.2g} mm"
        )


def find_coverage(source: Scan, target: Scan, registration: FineRegistration, difference: Difference) -> Coverage:
    """Where the comparison of ``find_change`` says something, and what; ``registration`` is T_target_source."""
    size = difference.cell_mm
    surface = surface_in_frame(target.surfels, inverse(registration.T_target_source)).points
    at, _ = nearest(build_cells(difference.surfels, 2 * size), surface, 2 * size)
    shown = at >= 0  # under what stands out higher than that, the foot is shown, too
    if (~shown).any() and difference.clusters:
        feet = np.concatenate([one.points - one.signed_mm[:, None] * one.normals for one in difference.clusters])
        shown |= nearest(build_cells(feet, 2 * size), surface, 2 * size)[0] >= 0
    heights = difference.min_height_mm[difference.comparable]
    told = len(heights) > 0
    return Coverage(
        float(difference.comparable.mean()),
        patches(difference.surfels[~difference.comparable], size, _unlike_a_rim(difference)),
        float((~difference.comparable).sum()) * size**2 * AREA_PER_CELL,
        float(shown.mean()),
        patches(surface[~shown], size),
        float((~shown).sum()) * size**2 * AREA_PER_CELL,
        float(np.median(heights)) if told else np.inf,
        float(np.quantile(heights, 0.95)) if told else np.inf,
        difference.min_width_mm,
        difference.min_sideways_mm,
    )


def _unlike_a_rim(difference: Difference) -> Flags:
    """Which of the surfels (K,) that were not compared are no mere rim: far from all that were, or standing out."""
    missed, size = ~difference.comparable, difference.cell_mm
    if not difference.comparable.any():
        return np.ones(int(missed.sum()), dtype=bool)
    reach = RIM_CELLS * size
    at, _ = nearest(build_cells(difference.surfels[difference.comparable], reach), difference.surfels[missed], reach)
    return (at < 0) | (np.nan_to_num(difference.signed_mm) > 2 * difference.firm_level_mm)[missed]


def patches(places: Floats, size_mm: float, counted: Flags | None = None) -> tuple[Patch, ...]:
    """Connected places of surfels (N, 3) of a cell size, largest first; those of few ``counted`` ones are left out."""
    if len(places) == 0:
        return ()
    labels = euclidean_clusters(places, 2 * size_mm)
    counts = np.bincount(labels)
    enough = counts if counted is None else np.bincount(labels, counted)
    return tuple(
        Patch(places[labels == label].mean(axis=0), float(counts[label]) * size_mm**2 * AREA_PER_CELL)
        for label in np.flatnonzero(enough >= MIN_PATCH_CELLS)
    )


def cannot_show(difference: Difference, height_mm: float) -> tuple[float, tuple[Patch, ...]]:
    """Fraction of the test scan on which a bead of this height would not be told, and the larger places, largest first.

    Raises:
        InputError: the height is not above zero.
    """
    if not 0 < height_mm < np.inf:
        raise InputError(f"a height of {height_mm} mm was asked for; it must be above zero")
    blind = difference.min_height_mm > height_mm
    return float(blind.mean()), patches(difference.surfels[blind], difference.cell_mm)


def same_scan(source: Scan, target: Scan, registration: FineRegistration, asked: int = 500) -> bool:
    """Whether the points of both scans fall on one another, as those of two measurements never do: they are copies."""
    size = target.surfels.grid.size_mm
    some = source.points[:: -(-len(source.points) // asked)]
    moved = move_points(registration.T_target_source, some)
    at, _ = nearest(build_cells(target.points, size / 2), moved, SAME_CELLS * size)
    return bool((at >= 0).mean() > 0.9)
