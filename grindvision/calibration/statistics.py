"""Statistics of residuals: how far measured and predicted points lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


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
    return ErrorStatistics(*(float(v) for v in (lengths.mean(), rms, lengths.max(), lengths.std())), len(lengths))
