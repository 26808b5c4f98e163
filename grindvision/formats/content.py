"""What a cloud file says, its numbers as they stand in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

POINT, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
PCD_NORMAL = ("normal_x", "normal_y", "normal_z")


@by_content
@dataclass(frozen=True)
class Content:
    """Points (N, 3) and, where the file has them, normals (N, 3), in the file's own unit.

    ``grid``: (rows, columns) of an organised cloud. ``unit``: ``mm``, ``cm``, ``m`` or ``in``, if it names one.
    ``note``: what the reader had to decide, for the user to see. ``triangles`` (T, 3): rows of ``points`` that are
    corners of the surface's facets, where the file holds a mesh and not points as a scanner saw them.
    """

    points: Floats
    normals: Floats | None = None
    grid: tuple[int, int] | None = None
    unit: str | None = None
    note: str = ""
    triangles: Integers | None = None

    def __str__(self) -> str:
        faces = "" if self.triangles is None else f", {len(self.triangles):,} triangles"
        return f"{len(self.points):,} points{faces} in {self.unit or 'an unnamed unit'}"


def chosen_columns(names: Sequence[str]) -> tuple[list[int] | None, list[int] | None]:
    """Where x y z and the three normal columns stand among a file's columns; None where one of them is missing."""
    point, normal, other = (
        [names.index(name) for name in wanted] if set(wanted) <= set(names) else None
        for wanted in (POINT, NORMAL, PCD_NORMAL)
    )
    return point, normal or other
