"""The voxel grid filter: every occupied cell of a lattice becomes the centroid of its points (Eqs 1-2, diao2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points
from grindvision.geometry.bounds import bounds
from grindvision.geometry.hash_grid import find_slot, grown_table
from grindvision.kernels import njit
from grindvision.records import by_content

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@by_content
@dataclass(frozen=True)
class VoxelGrid:
    """Occupied voxels of a cloud, ordered by their cell: x slowest, z fastest.

    ``centroids`` (M, 3) mm; ``counts`` (M,) points in each; ``cells`` (M, 3) lattice indices: the voxel spans
    ``origin_mm + size_mm * cells`` to ``+ size_mm``. ``voxel_of_point`` (N,) is the row of each input point's voxel.
    """

    centroids: Floats
    counts: Integers
    cells: Integers
    voxel_of_point: NDArray[np.int32]
    size_mm: float
    origin_mm: Floats

    @property
    def centres(self) -> Floats:
        """Geometric centres (M, 3) of the voxels, mm."""
        return self.origin_mm + self.size_mm * (self.cells + 0.5)

    def mean(self, values: ArrayLike) -> Floats:
        """Average values (N, ...) of the points over each voxel: (M, ...)."""
        return _means(np.asarray(values, dtype=float), self.voxel_of_point, self.counts)

    def __len__(self) -> int:
        return len(self.centroids)

    def __str__(self) -> str:
        return f"{len(self.voxel_of_point):,} points in {len(self):,} voxels of {self.size_mm} mm"


def voxel_grid(points: ArrayLike, size_mm: float, origin_mm: ArrayLike = (0.0, 0.0, 0.0)) -> VoxelGrid:
    """Replace the points of every voxel by their centroid (Eq 2).

    The lattice passes through ``origin_mm``. The default, the frame's own origin, is PCL's lattice; the cloud's lowest
    corner minus half a voxel is Open3D's. A cloud that moves against the lattice gets other centroids: choose the
    origin, do not let it follow the data, when two clouds are to be compared.

    Args:
        points: (N, 3) mm.
        size_mm: edge of a voxel.
        origin_mm: corner (3,) of the lattice.

    Raises:
        InputError: NaN points, a size that is not positive, or so small that the lattice has no room for the cloud.
        DegenerateError: no point.
    """
    points = check_points(points, "points")
    origin = np.asarray(origin_mm, dtype=float)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"origin_mm is {origin.tolist()}; it must be three finite numbers")
    if not (np.isfinite(size_mm) and size_mm > 0):
        raise InputError(f"the voxel size is {size_mm} mm; it must be above zero")
    points = np.ascontiguousarray(points)
    low, high = (np.floor((corner - origin) / size_mm) for corner in bounds(points))
    extent = high - low + 1
    if np.prod(extent) >= 2.0**62 or max(np.abs(low).max(), np.abs(high).max()) >= 2.0**53:
        raise InputError(
            f"voxels of {size_mm} mm over {np.ptp(points, axis=0).max():.3g} mm are too many to number; use larger ones"
        )
    lattice = _Lattice(origin, float(size_mm), low.astype(np.int64), extent.astype(np.int64))
    voxel_of_point = np.empty(len(points), dtype=np.int32)
    keys, count = np.empty(1 << 14, dtype=np.int64), -1
    while count < 0:
        keys = np.empty(4 * len(keys), dtype=np.int64)
        table_keys, table_cells = grown_table(keys, 0, 2 * len(keys))
        count = _number_cells(points, lattice, voxel_of_point, keys, table_keys, table_cells)
    order = np.argsort(keys[:count])
    rank = np.empty(count, dtype=np.int32)
    rank[order] = np.arange(count)
    counts, sums = _gather(points, voxel_of_point, rank)
    cells = np.column_stack(np.unravel_index(keys[order], lattice.extent)) + lattice.low
    return VoxelGrid(points[0] + sums / counts[:, None], counts, cells, voxel_of_point, float(size_mm), origin)


class _Lattice(NamedTuple):
    """Cells of ``size_mm`` from ``origin_mm`` (3,): those of a cloud begin at ``low`` (3,), ``extent`` (3,) a side."""

    origin_mm: Floats
    size_mm: float
    low: Integers
    extent: Integers


@njit(cache=True, nogil=True)
def _number_cells(
    points: Floats,
    lattice: _Lattice,
    numbers: NDArray[np.int32],
    keys: Integers,
    table_keys: Integers,
    table_cells: NDArray[np.int32],
) -> int:
    """Number the lattice cells of the points in order of first appearance: how many; -1 when ``keys`` is full.

    A key counts the cells of the cloud's box, x slowest. Scan neighbours share a cell: the table is asked when it
    changes.
    """
    origin, size, low, extent = lattice
    count = cell = 0
    last = np.int64(-1)
    for p in range(len(points)):
        i = np.int64(np.floor((points[p, 0] - origin[0]) / size)) - low[0]
        j = np.int64(np.floor((points[p, 1] - origin[1]) / size)) - low[1]
        k = np.int64(np.floor((points[p, 2] - origin[2]) / size)) - low[2]
        key = (i * extent[1] + j) * extent[2] + k
        if key != last:
            slot = find_slot(table_keys, key)
            if table_keys[slot] < 0:
                if count == len(keys):
                    return -1
                keys[count] = table_keys[slot] = key
                table_cells[slot] = count
                count += 1
            last, cell = key, table_cells[slot]
        numbers[p] = cell
    return count


@njit(cache=True, nogil=True)
def _gather(points: Floats, numbers: NDArray[np.int32], rank: NDArray[np.int32]) -> tuple[Integers, Floats]:
    """Renumber the cells by ``rank``, in place: points per cell (M,), and their sums (M, 3) about the first point."""
    counts, sums = np.zeros(len(rank), dtype=np.int64), np.zeros((len(rank), 3))
    x, y, z = points[0]
    for p in range(len(points)):
        cell = rank[numbers[p]]
        numbers[p] = cell
        counts[cell] += 1
        sums[cell, 0] += points[p, 0] - x
        sums[cell, 1] += points[p, 1] - y
        sums[cell, 2] += points[p, 2] - z
    return counts, sums


def _means(values: Floats, voxel_of_point: NDArray[np.int32], counts: Integers) -> Floats:
    columns = values.reshape(len(values), -1).T
    sums = np.stack([np.bincount(voxel_of_point, column, len(counts)) for column in columns], axis=1)
    return (sums / counts[:, None]).reshape(-1, *values.shape[1:])
