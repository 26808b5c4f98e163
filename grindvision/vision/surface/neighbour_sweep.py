"""Visiting every point's neighbours without ever listing them: cell by cell, on all cores that may be used.

Points are sorted into cells of half the radius. A kernel is called with a range of cells; for each cell it
copies the candidates of the 125 cells around into a small buffer once, and every point of the cell then runs over that
buffer. Coordinates are float32 relative to the cell, which keeps them exact to a tenth of a micrometre.

Cells are numbered by their keys, z fastest: a column of cells along z is one run of points, and from one cell to the
next the run at a given offset only moves on. So no cell is looked for.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from grindvision.geometry.hash_grid import build_cells
from grindvision.kernels import njit
from grindvision.parallel import usable_cores

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Values = NDArray[np.floating]

#: Ranges of cells handed out per core, so that no core waits long for the last one.
_RANGES_PER_CORE = 8


class CellSweep(NamedTuple):
    """Points cell by cell for neighbours within ``radius_mm``: their places (3, N), mm, and which they were (N,).

    A named tuple, so that kernels take it whole. Cell c, of key ``keys[c]``, has the points ``starts[c]`` to
    ``starts[c + 1]``; a last key that none can reach ends the list. The neighbours of a cell's points are in the cells
    whose keys lie from ``lower[o]`` to ``upper[o]`` above its own, for one of the offsets o.
    """

    radius_mm: float
    places: Floats
    order: Integers
    keys: Integers
    starts: Integers
    lower: Integers
    upper: Integers

    def __hash__(self) -> int:
        return id(self)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __str__(self) -> str:
        points, cells = len(self.order), len(self.starts) - 1
        return f"sweep of {points:,} points in {cells:,} cells for neighbours within {self.radius_mm:.3g} mm"


class Cursor(NamedTuple):
    """Where the visit of the cells stands: for each offset the first cell around and the one behind the last (O,), and
    the runs of points (O, 2) that these are, without the empty ones."""

    begin: Integers
    end: Integers
    runs: Integers


def build_sweep(points: ArrayLike, radius_mm: float) -> CellSweep:
    """Prepare points (N, 3) for visits of all neighbours within ``radius_mm``."""
    # One part in a million more, so that rounding loses no neighbour at exactly the radius.
    grid = build_cells(points, radius_mm / 2 * (1 + 1e-6))
    places = np.ascontiguousarray(grid.points[grid.order].T)
    keys = np.append(grid.keys, np.iinfo(np.int64).max)
    across = np.arange(-2, 3)
    column = ((across[:, None] << 42) + (across << 21)).ravel()
    return CellSweep(float(radius_mm), places, grid.order, keys, grid.starts, column - 2, column + 2)


def sweep(kernel: Callable[..., None], cells: CellSweep, *arguments: object) -> None:
    """Call ``kernel(first_cell, last_cell, cells, *arguments)`` for ranges of cells that together make up all of them.

    The kernel must release the interpreter lock and write only what belongs to the points of its own cells.
    """
    count = len(cells.starts) - 1
    cores = usable_cores()
    cuts = np.linspace(0, count, min(count, cores * _RANGES_PER_CORE) + 1).astype(int)
    if cores == 1 or count < 64:
        kernel(0, count, cells, *arguments)
        return
    with ThreadPoolExecutor(cores) as pool:
        for done in [pool.submit(kernel, int(a), int(b), cells, *arguments) for a, b in pairwise(cuts)]:
            done.result()


@njit(cache=True, nogil=True)
def cursor_before(cell: int, cells: CellSweep) -> Cursor:
    """A cursor for visits from ``cell`` on, in rising order."""
    begin = np.empty(len(cells.lower), np.int64)
    for o in range(len(begin)):
        begin[o] = np.searchsorted(cells.keys, cells.keys[cell] + cells.lower[o])
    return Cursor(begin, begin.copy(), np.empty((len(begin), 2), np.int64))


@njit(cache=True, nogil=True)
def move_to(cell: int, cells: CellSweep, cursor: Cursor) -> tuple[int, int]:
    """Move the cursor on to ``cell``: how many runs of points lie around it, and how many points these are."""
    keys, starts = cells.keys, cells.starts
    key = keys[cell]
    used = count = 0
    for o in range(len(cursor.begin)):
        a, lowest, highest = cursor.begin[o], key + cells.lower[o], key + cells.upper[o]
        while keys[a] < lowest:
            a += 1
        b = max(a, cursor.end[o])
        while keys[b] <= highest:
            b += 1
        cursor.begin[o], cursor.end[o] = a, b
        if b > a:
            cursor.runs[used, 0], cursor.runs[used, 1] = starts[a], starts[b]
            count += starts[b] - starts[a]
            used += 1
    return used, count


@njit(cache=True, nogil=True)
def copy_runs(values: Values, runs: Integers, used: int, zero: float, copies: Values) -> None:
    """Values (N,) of the points of the first ``used`` runs, relative to ``zero``, one behind the other."""
    count = 0
    for run in range(used):
        first, last = runs[run, 0], runs[run, 1]
        copy_shifted(values[first:last], zero, copies[count : count + last - first])
        count += last - first


@njit(cache=True, nogil=True)
def copy_shifted(values: Values, zero: float, copies: Values) -> None:
    """Values (N,) relative to ``zero``."""
    for m in range(len(values)):
        copies[m] = values[m] - zero
