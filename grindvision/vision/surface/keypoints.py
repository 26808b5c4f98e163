"""Keypoints of a scan, and which of them have the most similar histograms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.kernels import njit
from grindvision.parallel import parallel_map
from grindvision.records import by_content

Floats = NDArray[np.float64]


@by_content
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
    half_squares = 0.5 * np.einsum("ij,ij->i", b, b)
    columns = np.ascontiguousarray(b.T)
    result = np.empty((len(a), count), dtype=np.int64)
    parallel_map(
        lambda rows, found: _nearest_columns(rows, columns, half_squares, found),
        np.array_split(a, 2),
        np.array_split(result, 2),
    )
    return result


@njit(cache=True, nogil=True)
def _nearest_columns(rows: Floats, columns: Floats, half_squares: Floats, result: Floats) -> None:
    """For each of ``rows`` (N, F) the ``columns`` (F, M) of least distance, nearest first, into ``result`` (N, count).

    Products are summed four features at a time. A linear algebra library is hardly faster, and in two threads that
    share their processors with others its own threads wait for each other.
    """
    features, number = columns.shape
    count = result.shape[1]
    away, best = np.empty(number, dtype=np.float32), np.empty(count, dtype=np.float32)
    whole = features - features % 4
    for row in range(len(rows)):
        r = rows[row]
        for c in range(number):
            away[c] = half_squares[c]
        for k in range(0, whole, 4):
            r0, r1, r2, r3 = r[k], r[k + 1], r[k + 2], r[k + 3]
            for c in range(number):
                away[c] -= r0 * columns[k, c] + r1 * columns[k + 1, c] + r2 * columns[k + 2, c] + r3 * columns[k + 3, c]
        for k in range(whole, features):
            for c in range(number):
                away[c] -= r[k] * columns[k, c]
        best[:] = np.inf
        for c in range(number):
            if away[c] < best[count - 1]:
                at = count - 1
                while at > 0 and best[at - 1] > away[c]:
                    best[at] = best[at - 1]
                    result[row, at] = result[row, at - 1]
                    at -= 1
                best[at] = away[c]
                result[row, at] = c
