"""The voxel grid filter: every occupied cell of a lattice becomes the centroid of its points (Eqs 1-2, diao2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.errors import InputError
from grindvision.geometry import check_points

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class VoxelGrid:
    """Occupied voxels of a cloud, ordered by their cell: x slowest, z fastest.

    ``centroids`` (M, 3) mm; ``counts`` (M,) points in each; ``cells`` (M, 3) lattice indices: the voxel spans
    ``origin_mm + size_mm * cells`` to ``+ size_mm``. ``voxel_of_point`` (N,) is the row of each input point's voxel.
    """

    centroids: Floats
    counts: Integers
    cells: Integers
    voxel_of_point: Integers
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
        raise InputError(f"origin_mm is {origin_mm}; it must be three finite numbers")
    if not (np.isfinite(size_mm) and size_mm > 0):
        raise InputError(f"the voxel size is {size_mm} mm; it must be above zero")
    # Column by column: NumPy's minima along contiguous rows are many times faster than along columns.
    scaled = np.floor((np.ascontiguousarray(points.T) - origin[:, None]) / size_mm)
    low, high = scaled.min(axis=1), scaled.max(axis=1)
    extent = high - low + 1
    if np.prod(extent) >= 2.0**62 or max(np.abs(low).max(), np.abs(high).max()) >= 2.0**53:
        raise InputError(
            f"voxels of {size_mm} mm over {np.ptp(points, axis=0).max():.3g} mm are too many to number; use larger ones"
        )
    i, j, k = (scaled - low[:, None]).astype(np.int64)
    keys = (i * int(extent[1]) + j) * int(extent[2]) + k
    order = np.argsort(keys)
    sorted_keys = keys[order]
    first = np.concatenate([[True], sorted_keys[1:] > sorted_keys[:-1]])
    starts = np.flatnonzero(first)
    counts = np.diff(np.append(starts, len(keys)))
    voxel_of_point = np.empty(len(keys), dtype=np.int64)
    voxel_of_point[order] = np.cumsum(first) - 1
    centroids = points[0] + _means(points - points[0], voxel_of_point, counts)
    cells = np.column_stack([axis[order[starts]] for axis in (i, j, k)]) + low.astype(np.int64)
    return VoxelGrid(centroids, counts, cells, voxel_of_point, float(size_mm), origin)


def _means(values: Floats, voxel_of_point: Integers, counts: Integers) -> Floats:
    columns = values.reshape(len(values), -1).T
    sums = np.stack([np.bincount(voxel_of_point, column, len(counts)) for column in columns], axis=1)
    return (sums / counts[:, None]).reshape(-1, *values.shape[1:])
