"""Rows that contradict the others: a slipped reflector, a sphere paired with the wrong scan."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from grindvision.calibration.statistics import whitening

#: Chance that a good row is dropped, per row.
FALSE_ALARM = 1e-5


def consistent_rows(
    residuals_mm: ArrayLike, covariances_mm2: ArrayLike, directions: ArrayLike = 3
) -> NDArray[np.bool_]:
    """Flags (M,) of the rows whose residuals (M, 3) fit their covariances (M, 3, 3) up to a common scale.

    ``directions`` (M,): in how many directions each row says something, its degrees of freedom. The scale comes from
    the median squared Mahalanobis distance, so up to half of the rows may be wrong.
    """
    residuals = np.asarray(residuals_mm, dtype=float)
    squared = (np.einsum("mij,mj->mi", whitening(covariances_mm2), residuals) ** 2).sum(axis=1)
    directions = np.broadcast_to(np.asarray(directions), squared.shape)
    scale = max(float(np.median(squared / chdtri(directions, 0.5))), 1e-300)
    size = np.linalg.norm(residuals, axis=1)
    return (squared <= scale * chdtri(directions, FALSE_ALARM)) | (size < 1e-6)
