"""Where two surfaces meet or part: small patches of a scan that two planes fit far better than one.

Around every surfel the normals of its neighbours are split into two groups. Where they form two tight groups, the
planes of the groups meet in a line, a *crease*; where all normals agree but the heights form two groups, one surface
ends above the other, a *step*. A bent surface forms no groups: its normals are spread evenly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import within_radius
from grindvision.records import by_content
from grindvision.vision.seam.pair_kernels import MIN_GROUP, Around, classify_pairs
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Neighbours within so many cells: the planes of surfels less than two cells from a crease are mixed.
RADIUS_CELLS = 3.5
#: A surfel across a crease is rougher than the usual one; only such are looked at.
MIN_ROUGHNESS = 1.1


@by_content
@dataclass(frozen=True)
class SurfacePairs:
    """Places (K, 3) in mm where two surfaces meet, on the line in which their planes intersect.

    ``kind`` (K,) is one of ``CONCAVE``, ``CONVEX``, ``STEP``; ``along`` (K, 3) the unit direction of the line, of any
    sign; ``first`` and ``second`` (K, 3) the two unit normals, facing the scanner; ``dihedral_rad`` (K,) the angle
    between them; ``step_mm`` (K,) the height of a step, whose ``first`` holds the unit direction from the upper surface
    to the lower one across the line.
    """

    places: Floats
    kind: Integers
    along: Floats
    first: Floats
    second: Floats
    dihedral_rad: Floats
    step_mm: Floats

    def of(self, kind: int) -> SurfacePairs:
        """Only the pairs of one kind."""
        kept = self.kind == kind
        return SurfacePairs(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))

    def __len__(self) -> int:
        return len(self.kind)


def find_pairs(surfels: Surfels, normals: Floats, usable: NDArray[np.bool_]) -> SurfacePairs:
    """Pairs of surfaces around the surfels.

    Args:
        surfels: M planes of the scan.
        normals: (M, 3), facing the scanner.
        usable: (M,) which surfels take part.
    """
    size = surfels.grid.size_mm
    rows = np.flatnonzero(usable & (np.abs(normals).sum(axis=1) > 0))
    points, facing = np.ascontiguousarray(surfels.points[rows]), np.ascontiguousarray(normals[rows])
    if len(rows) < 2 * MIN_GROUP:
        return SurfacePairs(np.empty((0, 3)), np.empty(0, np.int64), *(np.empty((0, 3)),) * 3, np.empty(0), np.empty(0))
    rough = surfels.roughness_mm[rows]
    usual = float(np.median(rough)) + 0.004 * size
    weights = 1 / (rough**2 + usual**2)
    radius = RADIUS_CELLS * size
    centres = np.flatnonzero(rough >= MIN_ROUGHNESS * usual)
    found = within_radius(build_cells(points, radius), points[centres], radius)
    around = Around(found.starts, found.indices)
    kind, values = classify_pairs(points, facing, weights, around, centres, size, usual)
    at = np.flatnonzero(kind)
    values = values[at]
    return SurfacePairs(
        values[:, 0:3], kind[at], values[:, 3:6], values[:, 6:9], values[:, 9:12], values[:, 12], values[:, 13]
    )
