"""Visiting every point's neighbours without ever listing them: cell by cell, on all cores that may be used.

Points are sorted into cells of half the radius. A kernel is called with a range of cells; for each cell it copies the
candidates of the 125 cells around into a small buffer once, and every point of the cell then runs over that buffer.
Coordinates are float32 relative to the cell, which keeps them exact to a tenth of a micrometre.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.hash_grid import CellGrid, build_cells, cell_key, find_slot
from grindvision.kernels import njit
from grindvision.parallel import usable_cores

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Ranges of cells handed out per core, so that no core waits long for the last one.
_RANGES_PER_CORE = 8


@dataclass(frozen=True)
class CellSweep:
    """Cells of half of ``radius_mm`` over points (N, 3)."""

    grid: CellGrid
    radius_mm: float

    def __str__(self) -> str:
        return f"sweep of {self.grid} for neighbours within {self.radius_mm:.3g} mm"


def build_sweep(points: ArrayLike, radius_mm: float) -> CellSweep:
    """Prepare points (N, 3) for visits of all neighbours within ``radius_mm``."""
    # One part in a million more, so that rounding loses no neighbour at exactly the radius.
    return CellSweep(build_cells(points, radius_mm / 2 * (1 + 1e-6)), float(radius_mm))


def sweep(kernel: Callable[..., None], grid: CellGrid, *arguments: object) -> None:
    """Call ``kernel(first_cell, last_cell, grid, *arguments)`` for ranges of cells that together make up the grid.

    The kernel must release the interpreter lock and write only what belongs to the points of its own cells.
    """
    cells = len(grid.starts) - 1
    cores = usable_cores()
    cuts = np.linspace(0, cells, min(cells, cores * _RANGES_PER_CORE) + 1).astype(int)
    if cores == 1 or cells < 64:
        kernel(0, cells, grid, *arguments)
        return
    with ThreadPoolExecutor(cores) as pool:
        for done in [pool.submit(kernel, int(a), int(b), grid, *arguments) for a, b in pairwise(cuts)]:
            done.result()


@njit(cache=True, nogil=True)
def gather(
    cell: int,
    grid: CellGrid,
    found: Integers,
) -> tuple[Integers, int]:
    """Write the indices of all points of the 125 cells around a cell into ``found``, grown when too small.

    Returns the array and the number of points.
    """
    points, order, starts = grid.points, grid.order, grid.starts
    table_keys, table_cells = grid.table_keys, grid.table_cells
    origin, per_mm = grid.origin_mm, 1.0 / grid.size_mm
    p = order[starts[cell]]
    i = int((points[p, 0] - origin[0]) * per_mm)
    j = int((points[p, 1] - origin[1]) * per_mm)
    k = int((points[p, 2] - origin[2]) * per_mm)
    count = 0
    for di in range(-2, 3):
        for dj in range(-2, 3):
            for dk in range(-2, 3):
                if i + di < 0 or j + dj < 0 or k + dk < 0:
                    continue
                key = cell_key(i + di, j + dj, k + dk)
                slot = find_slot(table_keys, key)
                if table_keys[slot] != key:
                    continue
                other = table_cells[slot]
                size = starts[other + 1] - starts[other]
                if count + size > len(found):
                    bigger = np.empty(2 * (count + size), np.int64)
                    bigger[:count] = found[:count]
                    found = bigger
                found[count : count + size] = order[starts[other] : starts[other + 1]]
                count += size
    return found, count
