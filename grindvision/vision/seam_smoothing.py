"""Smoothing values along a seam: least squares with penalised bends, its stiffness given or taken from the noise.

Whittaker's smoother is the smoothing spline of evenly spaced stations. Its stiffness is stated as a length: waves
longer than about ``2 pi length_mm`` pass, shorter ones are taken for noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solveh_banded

Floats = NDArray[np.float64]

#: Cross-validation leaves out ``GAP`` stations of every ``PERIOD`` and judges the middle ``JUDGED`` of each gap.
GAP, PERIOD, JUDGED = 11, 18, 3
#: Lengths tried per doubling, from half a step up to the whole seam and more.
LENGTHS_PER_DOUBLING = 2
#: A prediction is off by at most so many times the median of the best curve's; more counts as that.
OUTLIER = 6.0
#: A median absolute deviation times this is a standard deviation; Tukey's biweight gives up beyond so many of them.
MAD_TO_STD, TUKEY = 1.4826, 4.7
#: Rounds of lowering the weights of values that stand out.
ROBUST_ROUNDS = 5


def smooth_along(
    values: ArrayLike, weights: ArrayLike, length_mm: float, step_mm: float, robust: bool = False
) -> Floats:
    """Whittaker smoothing of evenly spaced values (S, K): least squares with penalised second differences.

    Values of weight zero are bridged, ends continued straight. ``robust`` lowers the weight of values that stand out
    (Tukey's biweight).

    Args:
        values: (S,) or (S, K).
        weights: (S,), not negative.
        length_mm: stiffness as a length.
        step_mm: distance of neighbouring values.
        robust: whether to distrust values that stand out.
    """
    values = np.asarray(values, dtype=float)
    columns = values.reshape(len(values), -1)
    base = np.asarray(weights, dtype=float)
    base = base / max(base.max(), 1e-300)
    bending = (length_mm / step_mm) ** 4 * _bending_bands(len(columns))
    result = np.empty_like(columns)
    for k in range(columns.shape[1]):
        weight = base.copy()
        for _ in range(ROBUST_ROUNDS if robust else 1):
            system = bending.copy()
            system[2] += weight + 1e-9
            result[:, k] = solveh_banded(system, weight * columns[:, k], check_finite=False)
            off = np.abs(columns[:, k] - result[:, k])
            scale = TUKEY * MAD_TO_STD * np.median(off[base > 0]) if (base > 0).any() else 0.0
            weight = base * np.clip(1 - (off / max(scale, 1e-9)) ** 2, 0, 1) ** 2
    return result.reshape(values.shape)


def smooth_to_noise(values: ArrayLike, weights: ArrayLike, step_mm: float) -> tuple[Floats, float]:
    """Smooth values (S,) as stiffly as their own noise asks for; returns them and the length (mm) that was taken.

    Cross-validation by stretches: in turns, stretches of ``GAP`` stations here and there are left out and bridged by
    the curve through the others; the length taken is the one whose curves come nearest to the middles of the gaps. A
    curve that follows the noise predicts badly, and so does one too stiff for the seam. Stretches, not single
    stations, because noise is alike on neighbouring stations and would be taken for the seam. Values far off do not
    count.

    Args:
        values: (S,), one per station.
        weights: (S,) inverse variances up to a common factor, 0 where nothing is known.
        step_mm: distance of neighbouring stations.
    """
    values, weights = np.asarray(values, dtype=float), np.asarray(weights, dtype=float)
    doublings = int(np.ceil(np.log2(2 * len(values))))
    lengths = step_mm / 2 * 2 ** np.arange(0, doublings + 1e-9, 1 / LENGTHS_PER_DOUBLING)
    place = np.arange(len(values))
    off = np.empty((len(lengths), len(values)))
    for turn in range(PERIOD // JUDGED):
        in_period = (place + turn * JUDGED) % PERIOD
        judged = np.abs(in_period - GAP // 2) <= JUDGED // 2
        kept = np.where(in_period < GAP, 0.0, weights)
        for trial, length in enumerate(lengths):
            off[trial, judged] = np.abs(values - smooth_along(values, kept, length, step_mm))[judged]
    scaled = off * np.sqrt(weights / max(weights.max(), 1e-300))
    # The same limit for all lengths, or a bad one would shut out more of what it misses.
    limit = OUTLIER * np.median(scaled[:, weights > 0], axis=1).min(initial=np.inf)
    best = int(np.argmin((np.minimum(scaled, limit) ** 2).sum(axis=1)))
    # The first and the last gap are not bridged but reached from one side: there no prediction tells an outlier.
    known = np.flatnonzero(weights > 0)
    bridged = (place >= known.min(initial=len(place)) + GAP) & (place <= known.max(initial=0) - GAP)
    trusted = np.where(bridged & (scaled[best] > limit), 0.0, weights)
    return smooth_along(values, trusted, lengths[best], step_mm), float(lengths[best])


def _bending_bands(size: int) -> Floats:
    """Upper bands (3, size) of the matrix whose quadratic form sums the squared second differences."""
    bands = np.zeros((3, size))
    for offset, factor in enumerate((1.0, -2.0, 1.0)):
        bands[2, offset : size - 2 + offset] += factor**2
        if offset < 2:
            bands[1, 1 + offset : size - 1 + offset] += -2.0
    bands[0, 2:] += 1.0
    return bands
