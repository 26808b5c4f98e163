"""Statistics of residuals: how far measured and predicted points lie apart, and in which unit of noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class ErrorStatistics:
    """Lengths of residuals in mm: mean, root mean square, maximum and standard deviation over ``count`` points."""

    mean: float
    rms: float
    max: float
    std: float
    count: int

    def __str__(self) -> str:
        return (
            f"mean {self.mean:.3f} mm, rms {self.rms:.3f}, max {self.max:.3f}, std {self.std:.3f} ({self.count} points)"
        )


def error_statistics(residuals_mm: ArrayLike) -> ErrorStatistics:
    """Statistics of the lengths of residuals (N, 3); NaN where there are none."""
    residuals = np.asarray(residuals_mm, dtype=float)
    if not len(residuals):
        return ErrorStatistics(np.nan, np.nan, np.nan, np.nan, 0)
    lengths = np.linalg.norm(residuals, axis=1)
    rms = np.sqrt((lengths**2).mean())
    return ErrorStatistics(float(lengths.mean()), float(rms), float(lengths.max()), float(lengths.std()), len(lengths))


def whitening(covariances_mm2: ArrayLike) -> NDArray[np.float64]:
    """Lower triangular matrices (..., 3, 3) that scale residuals of these covariances (..., 3, 3) to unit noise."""
    lower = np.linalg.cholesky(np.asarray(covariances_mm2, dtype=float))
    first, second, third = (1 / lower[..., i, i] for i in range(3))
    matrices = np.zeros_like(lower)
    matrices[..., 0, 0], matrices[..., 1, 1], matrices[..., 2, 2] = first, second, third
    matrices[..., 1, 0] = -lower[..., 1, 0] * first * second
    matrices[..., 2, 1] = -lower[..., 2, 1] * second * third
    matrices[..., 2, 0] = (lower[..., 1, 0] * lower[..., 2, 1] * second - lower[..., 2, 0]) * first * third
    return matrices
