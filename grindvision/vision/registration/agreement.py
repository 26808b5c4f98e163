"""What a pose says about each surfel of the source: it agrees with the target's surface, contradicts it, or lies where
the target shows nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.vision.registration.plane_icp import MAX_LATERAL_OFFSET, plane_residuals
from grindvision.vision.surface.surfels import Surfels

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """What a pose says about the source's surfels, as fractions of all: ``agreeing``, ``contradicting``; the rest lies
    where the target shows nothing."""

    agreeing: float
    contradicting: float

    @property
    def overlap(self) -> float:
        """Fraction of the source over the target's surface."""
        return self.agreeing + self.contradicting

    @property
    def fraction_of_overlap(self) -> float:
        """Fraction of the overlap that agrees."""
        return self.agreeing / self.overlap if self.overlap > 0 else 0.0

    @property
    def score(self) -> float:
        """Agreeing less contradicting fraction; the best pose has the largest."""
        return self.agreeing - self.contradicting

    def __str__(self) -> str:
        return f"overlap {self.overlap:.0%}, of it {self.fraction_of_overlap:.0%} in agreement"


def agreement(points: Floats, normals: Floats, target: Surfels, T_target_source: Floats, within_mm: float) -> Agreement:
    """Judge a pose on source points (N, 3) with normals (N, 3): agreement means a distance along the target's normal of
    at most ``within_mm`` and normals less than 45 degrees apart."""
    residuals, facing = plane_residuals(points, normals, target, T_target_source, 3 * target.grid.size_mm)
    good = facing & (np.abs(residuals) <= within_mm)
    return Agreement(float(good.mean()), float((~np.isnan(residuals) & ~good).mean()))


def agreeing_fraction(
    points: Floats, normals: Floats, target: Surfels, T_target_source: Floats, within_mm: float
) -> float:
    """The ``agreeing`` of ``agreement`` alone, sooner: nothing is sought farther away than what agrees can be."""
    max_mm = float(np.hypot(within_mm, MAX_LATERAL_OFFSET * target.grid.size_mm))
    residuals, facing = plane_residuals(points, normals, target, T_target_source, max_mm)
    return float((facing & (np.abs(residuals) <= within_mm)).mean())
