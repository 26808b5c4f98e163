"""Keypoints of a scan, and which of them have the most similar histograms."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Keypoints:
    """Points (N, 3) in mm with unit normals (N, 3) and FPFH (N, 33), ``spacing_mm`` apart."""

    points: Floats
    normals: Floats
    features: Floats
    spacing_mm: float

    def __len__(self) -> int:
        return len(self.points)


def most_similar(features: ArrayLike, among: ArrayLike, count: int) -> NDArray[np.int64]:
    """Indices (N, count) of the rows of ``among`` (M, F) nearest to each row of ``features`` (N, F), nearest first."""
    a, b = np.asarray(features, dtype=np.float32), np.asarray(among, dtype=np.float32)
    if count > len(b):
        raise InputError(f"{count} similar points asked for, {len(b)} there")
    middle = b.mean(axis=0)
    a, b = a - middle, b - middle
    half = 0.5 * np.einsum("ij,ij->i", b, b)
    result = np.empty((len(a), count), dtype=np.int64)

    def search(first: int) -> None:
        rows = slice(first, first + 64)  # few enough for their products to stay in the cache
        scores = a[rows] @ b.T
        _least_per_row(np.subtract(half, scores, out=scores), result[rows])

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(search, range(0, len(a), 64)))
    return result


@njit(cache=True, nogil=True)
def _least_per_row(values, result):
    count = result.shape[1]
    best = np.empty(count, dtype=np.float32)
    for row in range(len(values)):
        best[:] = np.inf
        for column in range(values.shape[1]):
            value = values[row, column]
            if value < best[count - 1]:
                at = count - 1
                while at > 0 and best[at - 1] > value:
                    best[at] = best[at - 1]
                    result[row, at] = result[row, at - 1]
                    at -= 1
                best[at] = value
                result[row, at] = column
