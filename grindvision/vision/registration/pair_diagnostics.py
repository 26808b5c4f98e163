"""What two scans give away by themselves before they are registered: another unit, or a table larger than the part."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from grindvision.errors import UnitError
from grindvision.geometry.bounds import bounds
from grindvision.vision.surface.dominant_plane import plane_fraction
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]

#: Where a plane takes up more of both scans than this, the rest has a fifth of the cells: too few for a narrow bead.
#: Above the second fraction there is no part beside it.
MAX_PLANE, ONLY_PLANE = 0.8, 0.99

#: Scans whose extents differ by more than this factor do not show the same part in the same unit.
MAX_SIZE_RATIO = 5.0


class PairNames(NamedTuple):
    """What the two scans are called in messages."""

    source: str
    target: str


def check_same_unit(source: Floats, target: Floats, names: PairNames) -> None:
    """Refuse two scans (N, 3) and (M, 3) of which one is so much larger that its numbers have another unit.

    Raises:
        UnitError: the diagonals differ by more than ``MAX_SIZE_RATIO``.
    """
    sizes = [float(np.linalg.norm(np.subtract(*bounds(points)))) for points in (source, target)]
    if max(sizes) > MAX_SIZE_RATIO * min(sizes) > 0:
        raise UnitError(
            f"the {names.target} is {sizes[1]:.4g} mm across, the {names.source} {sizes[0]:.4g} mm: one of the files"
            " has another unit, or shows more than the part; export both in one unit, cropped to the part"
        )


def diagnose_table(source: Surfels, target: Surfels, names: PairNames, seed: int) -> str:
    """In words, that the scans show a table more than the part; empty where they do not. Coarse surfels of each."""
    fractions = plane_fraction(source, seed), plane_fraction(target, seed)
    if min(fractions) < MAX_PLANE or max(fractions) > ONLY_PLANE:
        return ""
    return (
        f"one plane takes up {fractions[1]:.0%} of the {names.target} and {fractions[0]:.0%} of the {names.source}"
        " scan; if it is a table, crop it away in both: what is left for the part is too coarse to show every bead, and"
        " the pose follows the table"
    )
