"""Compiled kernels of the parabolas beside a seam: sums over the points of each station, and how the points miss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from grindvision.kernels import njit

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@njit(cache=True, nogil=True)
def station_sums(at: Integers, powers: Floats, e: Floats, weights: Floats, count: int) -> tuple[Floats, Floats]:
    """Weighted sums (K, S) of the ``powers`` (K, N) of points, and of their products with ``e`` (N,), over the points
    of each of S stations: point n belongs to station ``at[n]``."""
    level, right = np.zeros((len(powers), count)), np.zeros((len(powers), count))
    for p in range(len(at)):
        s, weighted = at[p], weights[p] * e[p]
        for k in range(len(powers)):
            level[k, s] += weights[p] * powers[k, p]
            right[k, s] += weighted * powers[k, p]
    return level, right


@njit(cache=True, nogil=True)
def misses(
    at: Integers, powers: Floats, e: Floats, weights: Floats, coefficients: Floats, terms: int
) -> tuple[Floats, Floats]:
    """How far (N,) ``e`` lies off polynomials (S, K) of so many terms, and the weighted sums (S,) of its squares."""
    off, squares = np.empty(len(at)), np.zeros(len(coefficients))
    for p in range(len(at)):
        s, value = at[p], 0.0
        for k in range(terms):
            value += coefficients[s, k] * powers[k, p]
        off[p] = e[p] - value
        squares[s] += weights[p] * (off[p] * off[p])
    return off, squares


@njit(cache=True, nogil=True)
def biweights(at: Integers, off: Floats, limit: Floats) -> Floats:
    """Tukey's weights (N,) of points that are ``off`` (N,) by the ``limit`` (S,) of their station or less; else 0."""
    weights = np.empty(len(at))
    for p in range(len(at)):
        share = off[p] / max(limit[at[p]], 1e-9)
        kept = max(1 - share * share, 0.0)
        weights[p] = kept * kept
    return weights
