"""Experiment 4's twin of a part where the robot finds it: both solids to scan, the true bead, and a path against it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from grindvision.cell import Target
from grindvision.cell.experiment4 import printed_path, twin_part
from grindvision.cell.grinding_part import Bead
from grindvision.geometry import move_points, rotate_vectors
from grindvision_book.chapter_08.offsets import square_to

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Workplace:
    """The twin's part where the robot finds it: ``bead`` in the base frame, both solids to scan, ``T_base_part``.

    ``T_base_scanner`` is the pose that Tables 3 and 4 imply.
    """

    bead: Bead
    good: Target
    faulty: Target
    T_base_part: Floats
    T_base_scanner: Floats

    def compared(self, found: Floats) -> tuple[Floats, Floats, Floats]:
        """Found path points (n, 3), base frame and in order, against the true ridge.

        Returns the vectors (n, 3) from the ridge to the points, square to it; how far (n,) each point lies along the
        ridge from the middle of its equal part of the bead, where at least half as high; the true normals (n, 3).
        """
        ridge = self.bead.ridge_mm
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ridge, axis=0), axis=1))])
        tangents = np.gradient(ridge, arc, axis=0)
        _, near = cKDTree(ridge).query(found)
        along = np.einsum("ij,ij->i", found - ridge[near], tangents[near])
        rounded = self.bead.width_mm / 2 * (1 - np.sqrt(0.75))
        middles = rounded + (arc[-1] - 2 * rounded) * (np.arange(len(found)) + 0.5) / len(found)
        return square_to(ridge, found), arc[near] + along - middles, self.bead.normals[near]


@cache
def workplace(bead_height_mm: float = 1.5) -> Workplace:
    """Experiment 4's twin with a bead of the height given, in the base frame."""
    path = printed_path()
    part, T_scanner_part = twin_part(path, height_mm=bead_height_mm)
    T_base_part = path.T_base_scanner @ T_scanner_part
    bead = replace(
        part.bead,
        ridge_mm=move_points(T_base_part, part.bead.ridge_mm),
        normals=rotate_vectors(T_base_part, part.bead.normals),
    )
    return Workplace(bead, Target(part.sample), Target(part.test), T_base_part, path.T_base_scanner)
