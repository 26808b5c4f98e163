"""How far points stand beside a line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]


def square_to(line_mm: Floats, points_mm: Floats) -> Floats:
    """Vectors (N, 3), square to a finely sampled line (M, 3), from the line to points (N, 3) beside it."""
    tangents = np.gradient(line_mm, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    _, near = cKDTree(line_mm).query(points_mm)
    away = points_mm - line_mm[near]
    return away - np.einsum("ij,ij->i", away, tangents[near])[:, None] * tangents[near]
