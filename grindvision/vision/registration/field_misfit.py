"""What a deformation field leaves, place by place: bending that it has no term for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.geometry.neighbours import nearest
from grindvision.records import by_content

Floats = NDArray[np.float64]

EVERY = 8
"""One of so many samples is the middle of a neighbourhood."""

WAVES = 1.0
"""Radius of a neighbourhood in waves of the field: stock less than half a wave wide covers less than half of it, so the
median over it tells what is left beside the stock."""

NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution in medians of its sizes."""


@by_content
@dataclass(frozen=True)
class FieldMisfit:
    """Standard deviations ``sigma_mm`` (K,) of what a field leaves around ``middles`` (K, 3), frame of the test scan,
    and ``usual_mm``, that over the whole part."""

    middles: Floats
    sigma_mm: Floats
    usual_mm: float

    def variances(self, points: Floats) -> Floats:
        """Variances (N,) in mm2 at points (N, 3)."""
        apart = max(float(np.ptp(self.middles, axis=0).max()) / 20, 1e-6)
        at, _ = nearest(build_cells(self.middles, apart), points, 100 * apart)
        return np.where(at >= 0, self.sigma_mm[at] ** 2, self.sigma_mm.max() ** 2)

    def beyond_usual(self, points: Floats) -> Floats:
        """Variances (N,) in mm2 at points (N, 3) beyond the usual one, which the scans' own disagreement tells."""
        return np.maximum(self.variances(points) - self.usual_mm**2, 0.0)


def field_misfit(points: Floats, residuals: Floats, wave_mm: float) -> FieldMisfit:
    """What a field leaves of a test scan's points (N, 3): ``residuals`` (N,) in mm, NaN where nothing is met.

    ``wave_mm``: length of the field's shortest wave. A neighbourhood of which half meets nothing has the largest
    residual of all for its spread.
    """
    sizes = np.where(np.isfinite(residuals), np.abs(residuals), np.nanmax(np.abs(residuals)))
    middles = points[::EVERY]
    near = ((middles[:, None] - points[None]) ** 2).sum(axis=2) < (WAVES * wave_mm) ** 2
    sigma = np.array([NORMAL_MAD * np.median(sizes[row]) for row in near])
    return FieldMisfit(middles, sigma, NORMAL_MAD * float(np.median(sizes)))
