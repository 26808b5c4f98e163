"""Random inputs that the exercises are tried on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry import random_rotation, rigid

Floats = NDArray[np.float64]


def poses(rng: np.random.Generator, count: int, shift_mm: float = 400.0) -> list[Floats]:
    """Rigid transforms (4, 4) with any rotation and shifts of that size."""
    return [rigid(random_rotation(rng), rng.normal(0, shift_mm, 3)) for _ in range(count)]


def clouds(
    rng: np.random.Generator, count: int, points: int = 20, extent_mm: float | Sequence[float] = 50.0
) -> list[Floats]:
    """Clouds (points, 3), each about a centre of its own far from the origin."""
    return [rng.normal(0, 200, 3) + rng.normal(0, 1, (points, 3)) * np.asarray(extent_mm) for _ in range(count)]


def units(rng: np.random.Generator, *shape: int) -> Floats:
    """Unit vectors (..., 3) in all directions."""
    vectors = rng.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
