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
    curve, bands, weight = np.zeros((len(values), 1)), np.zeros((3, len(values), 1)), base.copy()
    smooth, stiffnesses = curve[:, 0], np.array([stiffness])
    for number in range(rounds):
        _smooth(values, weight, stiffnesses, curve, bands)
        if number < rounds - 1:
            off = np.abs(values - smooth)
            scale = max(TUKEY * MAD_TO_STD * np.median(off[base > 0]) if (base > 0).any() else 0.0, 1e-9)
            weight = base * np.maximum(1 - (off / scale) ** 2, 0) ** 2
    return smooth.copy()


@njit(cache=True, nogil=True)
def _misses(values: Floats, weights: Floats, stiffnesses: Floats, gap: int) -> Floats:
    """How far (L, S) the curve of each of L stiffnesses misses a value when it and those around it are left out."""
    count, trials = len(values), len(stiffnesses)
    curves, bands, kept = np.zeros((count, trials)), np.zeros((3, count, trials)), np.empty(count)
    off = np.empty((trials, count))
    period = gap + gap * KEPT // GAP
    for turn in range(-(-period // JUDGED)):
        for s in range(count):
            kept[s] = 0.0 if (s + turn * JUDGED) % period < gap else weights[s]
        _smooth(values, kept, stiffnesses, curves, bands)
        for s in range(count):
            if abs((s + turn * JUDGED) % period - gap // 2) <= JUDGED // 2:
                for trial in range(trials):
                    off[trial, s] = abs(values[s] - curves[s, trial])
    return off


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth(values: Floats, weights: Floats, stiffnesses: Floats, curves: Floats, bands: Floats) -> None:
    """Solve (W + stiffness D^T D) x = W y for each of L stiffnesses into the columns of ``curves`` (S, L).

    D takes second differences, so the matrix has five bands. It is factorised as L diag(d) L^T; ``bands`` (3, S, L)
    takes the two bands of L and 1 / d. Both arrays come with finite numbers. One system is a chain of divisions that
    wait for each other; several side by side take hardly longer.
    """
    count, trials = curves.shape
    for s in range(count):
        bending = float((s < count - 2) + 4 * (0 < s < count - 1) + (s > 1))
        side = -2.0 * ((s < count - 1) + (s > 1)) if s > 0 else 0.0
        beyond, first, second = 1.0 * (s > 1), max(s - 1, 0), max(s - 2, 0)
        here, last, before = curves[s], curves[first], curves[second]
        near_last, per_last, per_before = bands[0, first], bands[2, first], bands[2, second]
        for trial in range(trials):
            far = beyond * stiffnesses[trial]
            near = side * stiffnesses[trial] - far * near_last[trial]
            of_near, of_far = near * per_last[trial], far * per_before[trial]
            pivot = weights[s] + stiffnesses[trial] * bending - of_near * near - of_far * far
            here[trial] = weights[s] * values[s] - of_near * last[trial] - of_far * before[trial]
            bands[0, s, trial], bands[1, s, trial] = of_near, of_far
            bands[2, s, trial] = 1 / (max(pivot, 0.0) + RIDGE)
    for s in range(count - 1, -1, -1):
        after, behind = min(s + 1, count - 1), min(s + 2, count - 1)
        any_after, any_behind = 1.0 * (after == s + 1), 1.0 * (behind == s + 2)
        for trial in range(trials):
            total = curves[s, trial] * bands[2, s, trial]
            total -= any_after * bands[0, after, trial] * curves[after, trial]
            curves[s, trial] = total - any_behind * bands[1, behind, trial] * curves[behind, trial]
