"""Smoothing values along a seam: least squares with penalised bends, its stiffness given or taken from the noise.

Whittaker's smoother is the smoothing spline of evenly spaced stations. Its stiffness is stated as a length: waves
longer than about ``2 pi length_mm`` pass, shorter ones are taken for noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]

#: Cross-validation leaves out ``GAP`` stations, or more, keeps ``KEPT``, or more in proportion, before the next gap and
#: judges the middle ``JUDGED`` of each gap.
GAP, KEPT, JUDGED = 11, 7, 3
#: Lengths tried per doubling, from half a step up to the whole seam and more.
LENGTHS_PER_DOUBLING = 2
#: A prediction is off by at most so many times the median of the best curve's; more counts as that.
OUTLIER = 6.0
#: A median absolute deviation times this is a standard deviation; Tukey's biweight gives up beyond so many of them.
MAD_TO_STD, TUKEY = 1.4826, 4.7
#: Rounds of lowering the weights of values that stand out.
ROBUST_ROUNDS = 5
#: Added to all weights, the largest of which is 1: where nothing is known, the curve is still a number.
RIDGE = 1e-9


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
    base = np.asarray(weights, dtype=float)
    base = base / max(base.max(), 1e-300)
    columns = np.ascontiguousarray(values.reshape(len(values), -1).T)
    stiffness, rounds = (length_mm / step_mm) ** 4, ROBUST_ROUNDS if robust else 1
    result = [_robust(column, base, stiffness, rounds) for column in columns]
    return np.stack(result, axis=-1).reshape(values.shape)


def smooth_to_noise(
    values: ArrayLike, weights: ArrayLike, step_mm: float, sure: float = 1.0, gap: int = GAP
) -> tuple[Floats, float]:
    """Smooth values (S,) as stiffly as their own noise asks for; returns them and the length (mm) that was taken.

    Cross-validation by stretches: in turns, stretches of ``gap`` stations here and there are left out and bridged by
    the curve through the others; the length taken is the largest whose curves come as near to the middles of the gaps
    as the nearest ones, within a standard error. A curve that follows the noise predicts badly, and so does one too
    stiff for the seam. Stretches, not single stations, because noise is alike on neighbouring stations and would be
    taken for the seam. Values far off do not count.

    Args:
        values: (S,), one per station.
        weights: (S,) inverse variances up to a common factor, 0 where nothing is known.
        step_mm: distance of neighbouring stations.
        sure: a softer curve is taken where it predicts better by so many standard errors.
        gap: stations left out together: over half as many noise should no longer be alike, or it is predicted too.
    """
    values, weights = np.asarray(values, dtype=float), np.asarray(weights, dtype=float)
    doublings = int(np.ceil(np.log2(2 * len(values))))
    lengths = step_mm / 2 * 2 ** np.arange(0, doublings + 1e-9, 1 / LENGTHS_PER_DOUBLING)
    place = np.arange(len(values))
    off = _misses(values, weights / max(weights.max(), 1e-300), (lengths / step_mm) ** 4, gap)
    scaled = off * np.sqrt(weights / max(weights.max(), 1e-300))
    # The same limit for all lengths, or a bad one would shut out more of what it misses.
    limit = OUTLIER * np.median(scaled[:, weights > 0], axis=1).min(initial=np.inf)
    best = _stiffest(np.minimum(scaled, limit) ** 2, sure, gap)
    # The first and the last gap are not bridged but reached from one side: there no prediction tells an outlier.
    known = np.flatnonzero(weights > 0)
    bridged = (place >= known.min(initial=len(place)) + gap) & (place <= known.max(initial=0) - gap)
    trusted = np.where(bridged & (scaled[best] > limit), 0.0, weights)
    return smooth_along(values, trusted, lengths[best], step_mm), float(lengths[best])


def _stiffest(squares: Floats, sure: float, gap: int) -> int:
    """The stiffest of L curves that predicts as well as the best one, within ``sure`` standard errors, from squares
    (L, S).

    The standard error is that of the difference between both, from sums over stretches of ``gap`` stations.
    """
    best = int(np.argmin(squares.sum(axis=1)))
    starts = np.arange(0, squares.shape[1], gap)
    worse = np.add.reduceat(squares[best:] - squares[best], starts, axis=1)
    doubt = worse.std(axis=1) * np.sqrt(len(starts) ** 2 / max(len(starts) - 1, 1))
    return best + int(np.flatnonzero(worse.sum(axis=1) <= sure * doubt)[-1])


@njit(cache=True, nogil=True)
def _robust(values: Floats, base: Floats, stiffness: float, rounds: int) -> Floats:
    """Smoothed values (S,), the weights of those that stand out lowered from round to round."""
    smooth, bands, weight = np.empty(len(values)), np.empty((3, len(values))), base.copy()
    for number in range(rounds):
        _smooth(values, weight, stiffness, smooth, bands)
        if number < rounds - 1:
            off = np.abs(values - smooth)
            scale = max(TUKEY * MAD_TO_STD * np.median(off[base > 0]) if (base > 0).any() else 0.0, 1e-9)
            weight = base * np.maximum(1 - (off / scale) ** 2, 0) ** 2
    return smooth


@njit(cache=True, nogil=True)
def _misses(values: Floats, weights: Floats, stiffnesses: Floats, gap: int) -> Floats:
    """How far (L, S) the curve of each of L stiffnesses misses a value when it and those around it are left out."""
    count = len(values)
    smooth, bands, kept = np.empty(count), np.empty((3, count)), np.empty(count)
    off = np.empty((len(stiffnesses), count))
    period = gap + gap * KEPT // GAP
    for turn in range(-(-period // JUDGED)):
        for s in range(count):
            kept[s] = 0.0 if (s + turn * JUDGED) % period < gap else weights[s]
        for trial in range(len(stiffnesses)):
            _smooth(values, kept, stiffnesses[trial], smooth, bands)
            for s in range(count):
                if abs((s + turn * JUDGED) % period - gap // 2) <= JUDGED // 2:
                    off[trial, s] = abs(values[s] - smooth[s])
    return off


@njit(cache=True, nogil=True)
def _smooth(values: Floats, weights: Floats, stiffness: float, smooth: Floats, bands: Floats) -> None:
    """Solve (W + stiffness D^T D) x = W y into ``smooth``; D takes second differences, so the matrix has five bands.

    Factorised as L diag(d) L^T; ``bands`` (3, S) takes the two bands of L and 1 / d.
    """
    count = len(values)
    per_before = per_last = 0.0
    for s in range(count):
        bending = (s < count - 2) + 4 * (0 < s < count - 1) + (s > 1)
        far = stiffness if s > 1 else 0.0
        near = -2 * stiffness * ((s < count - 1) + (s > 1)) - far * bands[0, s - 1] if s > 0 else 0.0
        bands[0, s], bands[1, s] = near * per_last, far * per_before
        pivot = weights[s] + stiffness * bending - bands[0, s] * near - bands[1, s] * far
        smooth[s] = weights[s] * values[s]
        if s > 0:
            smooth[s] -= bands[0, s] * smooth[s - 1]
        if s > 1:
            smooth[s] -= bands[1, s] * smooth[s - 2]
        per_before, per_last = per_last, 1 / (max(pivot, 0.0) + RIDGE)
        bands[2, s] = per_last
    for s in range(count - 1, -1, -1):
        smooth[s] *= bands[2, s]
        if s < count - 1:
            smooth[s] -= bands[0, s + 1] * smooth[s + 1]
        if s < count - 2:
            smooth[s] -= bands[1, s + 2] * smooth[s + 2]
